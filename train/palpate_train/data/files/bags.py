"""Reads recordings of ROS: ROS 1 .bag, ROS 2 .mcap and .db3, with rosbags and without ROS."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.extras import library
from palpate_train.data.files import mcap_json
from palpate_train.data.files.table import (
    Array,
    ReadPlan,
    Table,
    asked_topics,
    from_columns,
    labelled,
    normal,
    only,
)

SUFFIXES = (".bag", ".mcap", ".db3")
WHAT = "a recording of ROS"
STAMP = "header.stamp"
TIME, RECEIVED = "time", "received"
"""Vectors of the times in the messages' headers, and of the times of their recording, in s."""
MOST = 100_000
"""Largest number of values of one message; camera images are larger."""
PIXELS = {
    "mono8": "u1", "8UC1": "u1", "8SC1": "i1", "mono16": "u2", "16UC1": "u2", "16SC1": "i2",
    "32SC1": "i4", "32FC1": "f4", "64FC1": "f8",
}  # fmt: skip
"""NumPy types of the pixels of an image with one channel, by the name of its encoding."""
IMAGE = "Image"
MENDED = {
    ".bag": "`rosbag reindex`",
    ".db3": "`sqlite3 FILE .recover`",
    ".mcap": "`mcap recover`",
}
"""What makes a recording whole that was cut off."""
MCAP_END = b"\x89MCAP0\r\n"


def read(path: Path, wanted: ReadPlan) -> Table:
    """The messages of the only topic with numbers, or of the topic `wanted.variable`, one frame
    each. Raises FormatError that lists the topics."""
    highlevel = library("rosbags.highlevel", WHAT)
    stores = library("rosbags.typesys", WHAT)
    source = path
    if path.suffix.lower() == ".db3":
        source = path.parent
        if not (source / "metadata.yaml").exists():
            raise FormatError(
                "lacks metadata.yaml next to it; run `ros2 bag reindex` on its folder"
            )
    kind = path.suffix.lower()
    if not WHOLE.get(kind, lambda _: True)(path):
        raise FormatError(f"has no end, as if it was cut off; {MENDED[kind]} makes it whole")
    if kind == ".mcap" and mcap_json.may_hold(path):
        return mcap_json.read(path, wanted)
    store = stores.get_typestore(stores.Stores.ROS2_JAZZY)
    with closing(_opened(highlevel, source, store, MENDED.get(kind, ""))) as bag:
        topics: dict[str, list[Any]] = {}
        for connection in bag.connections:
            topics.setdefault(normal(connection.topic), []).append(connection)
        types = {name: connections[0].msgtype for name, connections in topics.items()}
        name = only("topic", types, wanted.variable, lambda n: _fits(bag, topics[n]))
        labels = {n: topics[at] for n, at in asked_topics(topics, wanted).items()}
        return _table(bag, topics[name], labels)


def _opened(highlevel: Any, source: Path, store: Any, mends: str) -> Any:
    """The open recording. Raises FormatError if it was cut off."""
    try:
        bag = highlevel.AnyReader([source], default_typestore=store)
        bag.open()
    except KeyError as e:
        raise FormatError(
            f"holds messages in {e}, though it says that it is of ROS 2; record JSON or ROS 2"
        ) from e
    except Exception as e:  # its readers raise errors of several types for damaged files
        if not mends:
            raise
        raise FormatError(f"may be cut off ({e}); {mends} makes it whole") from e
    return bag


def _has_end(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-min(len(MCAP_END), path.stat().st_size), os.SEEK_END)
        return file.read() == MCAP_END


def _has_all_pages(path: Path) -> bool:
    """Whether an SQLite file is as long as its header says (sqlite.org/fileformat2.html, 1.3),
    since SQLite reads a file that was cut in its last page as if zeros followed."""
    with path.open("rb") as file:
        header = file.read(100)
    if len(header) < 100:
        return False
    page, change, pages, valid_for = (
        int.from_bytes(header[at : at + n], "big") for at, n in ((16, 2), (24, 4), (28, 4), (92, 4))
    )
    size = pages * (65536 if page == 1 else page)
    return change != valid_for or path.stat().st_size >= size


WHOLE = {".mcap": _has_end, ".db3": _has_all_pages}
"""Whether a recording has its end, by the ending of its name, for formats that tell it."""


def _fits(bag: Any, connections: list[Any]) -> bool:
    """Whether the first message of a topic holds several numbers next to its header."""
    for connection, _, raw in bag.messages(connections=connections):
        try:
            message = bag.deserialize(raw, connection.msgtype)
        except Exception:  # a type whose definition the file lacks is not a topic of frames
            return False
        sizes = [np.size(v) for k, v in _numbers("", message) if STAMP not in k]
        return 1 < sum(sizes) <= MOST
    return False


def _table(bag: Any, connections: list[Any], labels: Mapping[str, list[Any]]) -> Table:
    """The messages of one topic as frames. labels: topics of texts by name; the last text before a
    frame is its text."""
    rows: list[Array] = []
    received: list[int] = []
    stamps: list[float] = []
    names: list[str] = []
    for connection, at, raw in bag.messages(connections=connections):
        try:
            message = bag.deserialize(raw, connection.msgtype)
        except KeyError as e:
            raise FormatError(
                f"holds no definition of {connection.msgtype}; record it as MCAP, which holds them"
            ) from e
        found = dict(_numbers("", message))
        stamp = [found.pop(f"{STAMP}.{part}", None) for part in ("sec", "nanosec")]
        if None not in stamp:
            stamps.append(float(np.asarray(stamp[0]) + 1e-9 * np.asarray(stamp[1])))
        found = {k: v for k, v in found.items() if not k.startswith(("header.", "layout."))}
        row = np.concatenate([np.ravel(v) for v in found.values()]) if found else np.empty(0)
        if rows and len(row) != len(rows[0]):
            raise FormatError(
                f"message {len(rows) + 1} holds {len(row)} numbers, message 1 holds {len(rows[0])}"
            )
        names = names or [
            k if np.ndim(v) == 0 else f"{k}.{i}"
            for k, v in found.items()
            for i in range(np.size(v))
        ]
        rows.append(row)
        received.append(at)
    if not rows or not names:
        raise FormatError(f"topic {connections[0].topic} holds no numbers")
    times = {RECEIVED: 1e-9 * (np.array(received) - received[0])}
    if len(stamps) == len(rows) and any(stamps):
        times[TIME] = np.array(stamps) - stamps[0]
    table = from_columns(list(zip(names, np.stack(rows).T, strict=True)))
    table = replace(table, vectors=times, beside=tuple(times))
    return labelled(table, received, {name: _texts(bag, name, labels[name]) for name in labels})


def _texts(bag: Any, topic: str, connections: list[Any]) -> list[tuple[int, str]]:
    """Times and texts of a topic. Raises FormatError for messages without a text or a number in
    `data`."""
    texts: list[tuple[int, str]] = []
    for connection, t_ns, raw in bag.messages(connections=connections):
        value = getattr(bag.deserialize(raw, connection.msgtype), "data", None)
        if not isinstance(value, str | int | float):
            raise FormatError(f"{topic} holds {connection.msgtype}; --field needs std_msgs/String")
        texts.append((t_ns, str(value)))
    return texts


def _numbers(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The numbers in a message, with the paths of their fields."""
    fields = getattr(value, "__dataclass_fields__", None)
    if type(value).__name__.endswith(IMAGE) and fields and "encoding" in fields:
        yield from _numbers("header", value.header)
        if value.encoding in PIXELS:
            yield "data", _pixels(value)
    elif fields is not None:
        for field in fields:
            if not field.startswith("__"):
                yield from _numbers(f"{name}.{field}" if name else field, getattr(value, field))
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from _numbers(f"{name}.{k}", inner)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "biuf":
            yield name, value
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, value


def _pixels(image: Any) -> Array:
    """The pixels [rows, columns] of an image with one channel. Lines may be padded."""
    kind = np.dtype((">" if image.is_bigendian else "<") + PIXELS[image.encoding])
    lines = np.asarray(image.data, np.uint8).reshape(image.height, image.step)
    width = image.width * kind.itemsize
    values: Array = np.ascontiguousarray(lines[:, :width]).view(kind)
    return values.astype(kind.newbyteorder("="))
