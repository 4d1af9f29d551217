"""Writes recorded sweeps, or a set, as MCAP with JSON, which Foxglove draws without a plug-in.

Schemas: foxglove.RawImage (docs.foxglove.dev/docs/sdk/schemas) for the normal axis; the others are
plain objects for the panels Plot and State Transitions.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import storage
from palpate.core.errors import FormatError
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


@dataclass(frozen=True, slots=True, eq=False)
class SweepToWrite:
    """A sweep. taxels: [T, R, C] or [T, R, C, A] raw counts. t_ns: [T] from its first frame on.
    verdict: as the box wrote it, {} for none."""

    taxels: NDArray[Any]
    t_ns: NDArray[np.int64]
    material: str
    verdict: Mapping[str, Any]


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
        for sweep in _sweeps(source):
            for topic, at_ns, value in _messages(sweep):
                t_ns, data = begun_ns + at_ns, json.dumps(value).encode()
                writer.add_message(channels[topic], t_ns, data, t_ns)
            begun_ns += int(sweep.t_ns[-1]) + PAUSE_NS
            sweeps, frames = sweeps + 1, frames + len(sweep.taxels)
        writer.finish()
    return sweeps, frames


def _channel(writer: Any, topic: str) -> int:
    name, properties = TOPICS[topic]
    schema = {"title": name, "type": "object", "properties": properties}
    known = writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
    return int(writer.register_channel(topic, "json", known))


def _sweeps(source: str) -> Iterator[SweepToWrite]:
    folder = Path(source)
    if folder.is_dir():
        for one in readers.read_recorded(folder):
            frames = one.sweep.frames
            if len(frames):
                t_ns = frames.t_ns - frames.t_ns[0]
                verdict = dict(one.about.get("verdict", {}))
                yield SweepToWrite(frames.taxels, t_ns, one.sweep.material, verdict)
        return
    found = sets.load(source)
    t_ns = np.rint(1e9 / found.rate_hz * np.arange(found.format.window)).astype(np.int64)
    for taxels, label in zip(found.samples, found.labels, strict=True):
        yield SweepToWrite(taxels, t_ns, str(found.materials[label]), {})


def _messages(sweep: SweepToWrite) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Topic, time in ns and content, in the order of their times."""
    yield "/trigger", 0, {"data": "START"}
    if sweep.material:
        yield "/material", 0, {"data": sweep.material}
    for taxels, t_ns in zip(sweep.taxels, sweep.t_ns.tolist(), strict=True):
        yield "/skin", t_ns, {"taxels": _finite(taxels).ravel().tolist()}
        yield "/skin/image", t_ns, _image(taxels, t_ns)
    last_ns = int(sweep.t_ns[-1])
    yield "/trigger", last_ns, {"data": "STOP"}
    if sweep.verdict:
        yield "/verdict", last_ns, dict(sweep.verdict)


def _finite(taxels: NDArray[Any]) -> NDArray[Any]:
    """NaN as null, since JSON has no NaN."""
    if taxels.dtype.kind != "f" or np.isfinite(taxels).all():
        return taxels
    values = taxels.astype(object)
    values[~np.isfinite(taxels)] = None
    return values


def _image(taxels: NDArray[Any], t_ns: int) -> dict[str, Any]:
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
