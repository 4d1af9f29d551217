"""Writes recorded sweeps, or a set, as MCAP with JSON, which Foxglove draws without a plug-in.

Schemas: foxglove.RawImage (docs.foxglove.dev/docs/sdk/schemas) for the normal axis; the others are
plain objects for the panels Plot and State Transitions.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core import storage
from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.core.types import normal
from palpate_train.data import readers, sets
from palpate_train.data.extras import library

PAUSE_NS = 1_000_000_000
"""Time from the end of a sweep to the next: a set knows no times between its sweeps."""
ENCODINGS = {"uint8": "mono8", "uint16": "16UC1", "int16": "16SC1", "float32": "32FC1"}
NUMBER, TEXT = {"type": "number"}, {"type": "string"}
TIME = {"type": "object", "properties": {"sec": NUMBER, "nsec": NUMBER}}
SIZES = ("width", "height", "step")
IMAGE = {
    "timestamp": TIME,
    **{name: TEXT for name in ("frame_id", "encoding")},
    **{name: {"type": "integer"} for name in SIZES},
    "data": {"type": "string", "contentEncoding": "base64"},
}
TOPICS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "/skin/image": ("foxglove.RawImage", IMAGE),
    "/skin": ("palpate.Frame", {"taxels": {"type": "array", "items": NUMBER}}),
    "/trigger": ("palpate.Trigger", {"data": TEXT}),
    "/material": ("palpate.Material", {"data": TEXT}),
    "/verdict": ("palpate.Verdict", {"status": TEXT, "label": TEXT}),
}
"""Schema and properties of each topic."""


Sweep = tuple[Array, Array, str, Mapping[str, Any]]
"""Raw counts [T, R, C] or [T, R, C, A], times [T] in ns from its first frame on, material, and the
verdict as the box wrote it, {} for none."""


def write(source: str, out: Path) -> tuple[int, int]:
    """Write a set, or a folder of recordings with their verdicts, as the new file `out`; returns
    the numbers of sweeps and frames. Raises FormatError, also without the library; OSError."""
    try:
        made = library("mcap.writer", "MCAP", "write")
    except FormatError as e:
        raise FormatError(f"{out} {e}") from e
    if out.exists():
        raise FormatError(f"{out} is there already; name a new file")
    sweeps = frames = begun_ns = 0
    with storage.file(out) as file:
        writer = made.Writer(file)
        writer.start(library="palpate")
        channels = {topic: _channel(writer, topic) for topic in TOPICS}
        for taxels, t_ns, material, verdict in _sweeps(source):
            for topic, at_ns, value in _messages(taxels, t_ns.tolist(), material, verdict):
                at_ns, data = begun_ns + at_ns, json.dumps(value).encode()
                writer.add_message(channels[topic], at_ns, data, at_ns)
            begun_ns += int(t_ns[-1]) + PAUSE_NS
            sweeps, frames = sweeps + 1, frames + len(taxels)
        writer.finish()
    return sweeps, frames


def _channel(writer: Any, topic: str) -> int:
    name, properties = TOPICS[topic]
    schema = {"title": name, "type": "object", "properties": properties}
    known = writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
    return int(writer.register_channel(topic, "json", known))


def _sweeps(source: str) -> Iterator[Sweep]:
    folder = Path(source)
    if folder.is_dir():
        for one in readers.read_recorded(folder):
            frames = one.sweep.frames
            if len(frames):
                t_ns = frames.t_ns - frames.t_ns[0]
                verdict = dict(one.about.get("verdict", {}))
                yield frames.taxels, t_ns, one.sweep.material, verdict
        return
    found = sets.load(source)
    t_ns = np.rint(1e9 / found.rate_hz * np.arange(found.format.window)).astype(np.int64)
    for taxels, label in zip(found.samples, found.labels, strict=True):
        yield taxels, t_ns, str(found.materials[label]), {}


def _messages(
    taxels: Array, t_ns: list[int], material: str, verdict: Mapping[str, Any]
) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Topic, time in ns and content, in the order of their times."""
    yield "/trigger", 0, {"data": "START"}
    if material:
        yield "/material", 0, {"data": material}
    for frame, at_ns in zip(taxels, t_ns, strict=True):
        yield "/skin", at_ns, {"taxels": _finite(frame).ravel().tolist()}
        yield "/skin/image", at_ns, _image(frame, at_ns)
    yield "/trigger", t_ns[-1], {"data": "STOP"}
    if verdict:
        yield "/verdict", t_ns[-1], dict(verdict)


def _finite(taxels: Array) -> Array:
    """NaN as null, since JSON has no NaN."""
    if taxels.dtype.kind != "f" or np.isfinite(taxels).all():
        return taxels
    values = taxels.astype(object)
    values[~np.isfinite(taxels)] = None
    return values


def _image(taxels: Array, t_ns: int) -> dict[str, Any]:
    grid = np.ascontiguousarray(normal(taxels, 0)).astype(taxels.dtype.newbyteorder("<"))
    sec, nsec = divmod(t_ns, 1_000_000_000)
    return {
        "timestamp": {"sec": sec, "nsec": nsec},
        "frame_id": "skin",
        "width": grid.shape[1],
        "height": grid.shape[0],
        "encoding": ENCODINGS[taxels.dtype.name],
        "step": grid.shape[1] * grid.itemsize,
        "data": base64.b64encode(grid.tobytes()).decode(),
    }
