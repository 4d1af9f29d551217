"""Reads MCAP whose messages are JSON, as the Foxglove SDK writes it."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.text import printable
from palpate_train.data.extras import library
from palpate_train.data.files.json_lines import flat, table_of
from palpate_train.data.files.table import ReadPlan, Table, normal

JSON = "json"
MAGIC_BYTES = 8
TIME = "received"
"""The vector of the times of recording, in s."""

Message = tuple[int, Any]
"""Time of recording in ns, and content."""


def may_hold(path: Path) -> bool:
    """Whether an MCAP file is of no version of ROS, as its header says (mcap.dev/spec)."""
    with path.open("rb") as file:
        head = file.read(MAGIC_BYTES + 1 + 8 + 4)
        if len(head) < MAGIC_BYTES + 13:
            return False
        (length,) = struct.unpack_from("<I", head, MAGIC_BYTES + 9)
        return not file.read(min(length, 16)).startswith(b"ros")


def read(path: Path, wanted: ReadPlan) -> Table | None:
    """The messages of the only topic with numbers, or of the topic `wanted.variable`, one frame
    each; None if no topic is JSON. Raises FormatError that lists the topics."""
    topics = _topics(path)
    if not topics:
        return None
    listed = ", ".join(f"{printable(name)} (JSON)" for name in topics)
    name = normal(wanted.variable)
    if name and name not in topics:
        raise FormatError(f"has no topic {name!r}; it holds {listed}")
    fitting = [name] if name else [n for n, messages in topics.items() if _numbers(messages) > 1]
    if len(fitting) != 1:
        raise FormatError(
            f"holds {len(fitting)} topics of frames; name one with --variable: it holds {listed}"
        )
    messages = topics[fitting[0]]
    at_ns = np.array([t_ns for t_ns, _ in messages], np.int64)
    labels = {n: _latest(n, topics[n], at_ns) for n in wanted.fields if n in topics}
    first = max((texts.count("") for texts in labels.values()), default=0)
    rows = [(i, dict(flat("", value))) for i, (_, value) in enumerate(messages, 1)][first:]
    if not rows:
        raise FormatError(f"{', '.join(labels)} says nothing before the last frame; say it earlier")
    notes = [f"{first} frames before the first label are left out"] * (first > 0)
    return replace(
        table_of(rows, "message", notes),
        vectors={TIME: 1e-9 * (at_ns[first:] - at_ns[first])},
        beside=(TIME,),
        labels={n: texts[first:] for n, texts in labels.items()},
    )


def _topics(path: Path) -> dict[str, list[Message]]:
    """The messages of each topic that is JSON, in the order of their times."""
    reader = library("mcap.reader", "MCAP with JSON")
    topics: dict[str, list[Message]] = {}
    with path.open("rb") as file:
        for _, channel, message in reader.make_reader(file).iter_messages():
            if channel.message_encoding == JSON:
                known = topics.setdefault(normal(channel.topic), [])
                try:
                    known.append((message.log_time, json.loads(message.data)))
                except ValueError as e:
                    raise FormatError(
                        f"message {len(known) + 1} of {printable(channel.topic)} is not JSON, as "
                        f"its encoding says: {e}; record it again"
                    ) from e
    return topics


def _numbers(messages: list[Message]) -> int:
    return sum(type(value) in (int, float) for _, value in flat("", messages[0][1]))


def _latest(name: str, messages: list[Message], at_ns: Any) -> list[str]:
    """The last text of a topic at each of these times, "" before the first."""
    texts: list[str] = []
    for _, value in messages:
        said = [text for _, text in flat("", value) if isinstance(text, str)]
        if len(said) != 1:
            raise FormatError(f"{name} holds {len(said)} texts in a message; --field needs one")
        texts += said
    which = np.searchsorted([t_ns for t_ns, _ in messages], at_ns, side="right") - 1
    return [texts[k] if k >= 0 else "" for k in which]
