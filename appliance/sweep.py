"""The format that every room shares: SweepFormat, Frames, Sweep, Verdict, Status. In and out: recorded sweeps on disk.

Nothing here knows where frames come from. Times are nanoseconds of the host's `CLOCK_MONOTONIC`.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import FormatError
from .keys import typed

DIGITS = ("uint8", "int16", "uint16", "float32")
"""Digit types of a taxel; the position in this tuple is the code on the wire (PROTOCOL.md)."""

EPOCH_BITS = 40
"""An unwrapped sequence number is `(enumeration << EPOCH_BITS) + frame`: frames of two plug-ins never look adjacent."""


UNREADABLE = (ValueError, TypeError, EOFError, SyntaxError, TokenError, MemoryError)
"""What numpy makes of a broken .npy, beside OSError; the last where it names a size that no machine has."""


class Status(StrEnum):
    """What became of a sweep. One list for sentences, lines and files; PROTOCOL.md explains each, a test compares."""

    OK = "ok"
    UNSURE = "unsure"
    UNDECIDED = "undecided"
    UNKNOWN = "unknown"
    SHORT = "short"
    LONG = "long"
    GAP = "gap"
    NO_CONTACT = "no-contact"
    SATURATED = "saturated"
    STUCK_TAXEL = "stuck-taxel"
    DEAD_TAXEL = "dead-taxel"
    SENSOR_LOST = "sensor-lost"
    NO_START = "no-start"
    NO_STOP = "no-stop"
    NOT_READY = "not-ready"
    EDGES_LOST = "edges-lost"
    ABORTED = "aborted"

    @property
    def classified(self) -> bool:
        """True where a label was computed."""
        return self in (Status.OK, Status.UNSURE, Status.UNDECIDED)


@dataclass(frozen=True, slots=True)
class SweepFormat:
    """Form of a sweep: `rows` x `cols` taxels, `rate_hz` frames a second, `window` frames used, digits of type `dtype`.

    It belongs to a bundle: another skin is another format, not other code.
    Raises FormatError where a value makes no sense.
    """

    rows: int
    cols: int
    rate_hz: float
    window: int
    dtype: str

    def __post_init__(self) -> None:
        if self.dtype not in DIGITS:
            raise FormatError(f"digit type {self.dtype!r} is unknown; use one of {', '.join(DIGITS)}")
        if not (1 <= self.rows <= 255 and 1 <= self.cols <= 255):
            raise FormatError(f"a grid of {self.rows} x {self.cols} taxels is out of range; use 1 to 255 each way")
        if not 1e-3 <= self.rate_hz <= 1e6:  # a board tells thousandths
            raise FormatError(f"a rate of {self.rate_hz} Hz is out of range; use 0.001 to 1e6")
        if self.window < 1:
            raise FormatError(f"a window of {self.window} frames is empty; use at least 1")

    @property
    def digits(self) -> np.dtype[Any]:
        """numpy type of one taxel, little-endian."""
        return np.dtype(self.dtype).newbyteorder("<")

    @property
    def period_ns(self) -> float:
        """Time between two frames in nanoseconds."""
        return 1e9 / self.rate_hz

    @property
    def skin(self) -> tuple[int, int, str]:
        """What a readout board must agree to: rows, columns, digit type."""
        return self.rows, self.cols, self.dtype

    def __str__(self) -> str:
        return f"{self.rows}x{self.cols} {self.dtype} at {self.rate_hz:g} Hz, window {self.window}"


@dataclass(frozen=True, slots=True)
class Frames:
    """A run of frames: t_ns int64 [n] host monotonic, seq int64 [n] unwrapped, taxels [n, R, C] digits."""

    t_ns: NDArray[np.int64]
    seq: NDArray[np.int64]
    taxels: NDArray[Any]

    def __len__(self) -> int:
        return len(self.seq)

    @classmethod
    def empty(cls, fmt: SweepFormat) -> Frames:
        """No frames of this format."""
        none = np.empty(0, np.int64)
        return cls(none, none, np.empty((0, fmt.rows, fmt.cols), fmt.digits))

    @classmethod
    def joined(cls, runs: Sequence[Frames]) -> Frames:
        """Several runs as one."""
        return cls(*(np.concatenate([getattr(run, name) for run in runs]) for name in cls.__slots__))


@dataclass(frozen=True, slots=True)
class Sweep:
    """One sweep as the recorder cut it. `frames` is the middle window where `status` is ok, and empty otherwise.

    share: 1, or less for a sweep that still goes on: so much of a window's frames, counted from `sweep.lead_ms` after
    the start edge; `frames` are these, all that there are.
    start_ns, stop_ns: trigger edges, host monotonic (equal where one is missing; before the stop edge the last frame).
    lost: frames of the window that never came; where `status` is ok they were interpolated.
    complete_ns: when the last thing needed (stop edge or frame) was in hand.
    object: counts NEW OBJECT signals; 0 before the first, when sweeps stand alone and are not fused.
    """

    id: int
    start_ns: int
    stop_ns: int
    status: Status
    frames: Frames
    lost: int = 0
    complete_ns: int = 0
    object: int = 0
    material: str = ""
    position: str = ""
    session: str = ""
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer to one sweep.

    scores: float64 [C] probabilities of this sweep, or of all fused sweeps; empty where nothing was classified.
    margin: probability of the label minus that of the next one. detail: what the status is about ("taxel 2,3").
    latency_ns: from `Sweep.complete_ns` to the verdict. share: how much of the window was used: less
    than 1 in an early answer.
    """

    sweep: int
    time_ns: int
    status: Status
    label: str
    probability: float
    margin: float
    scores: NDArray[np.float64]
    fused: int
    lost: int
    latency_ns: int
    bundle: str
    detail: str = ""
    share: float = 1.0


def _record_dtype(fmt: SweepFormat) -> np.dtype[Any]:
    return np.dtype([("t_ns", "<i8"), ("seq", "<i8"), ("taxels", fmt.digits, (fmt.rows, fmt.cols))])


def save(path: Path, sweep: Sweep, fmt: SweepFormat) -> None:
    """Write `sweep` as `path` (.npy, one record a frame) and a JSON sidecar beside it, whole or not at all.

    Both are written aside and synced, then renamed; the sidecar comes first, so an .npy never lacks its description.
    Raises OSError where that fails, and then leaves nothing behind.
    """
    table = np.zeros(len(sweep.frames), _record_dtype(fmt))
    table["t_ns"], table["seq"], table["taxels"] = sweep.frames.t_ns, sweep.frames.seq, sweep.frames.taxels
    about = {k: getattr(sweep, k) for k in Sweep.__slots__ if k != "frames"} | {"format": asdict(fmt), "schema": 1}
    packed = io.BytesIO()  # into a file np.save writes past Python, and a full disk has no errno then
    np.save(packed, table, allow_pickle=False)
    held = {path.with_suffix(".json"): json.dumps(about, indent=1).encode(), path: packed.getvalue()}
    asides = {target: target.with_name(target.name + ".part") for target in held}
    try:
        for target, data in held.items():
            with asides[target].open("wb") as f:
                f.write(data)
                f.flush()
                os.fsync(f.fileno())
        for target, aside in asides.items():
            aside.replace(target)
    except OSError:
        for left in (*asides.values(), *(target for target in held if not path.is_file())):
            with suppress(OSError):
                left.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load(path: Path) -> tuple[Sweep, SweepFormat]:
    """Read a sweep that `save` wrote. Raises FormatError where a file is missing, broken or of another form."""
    try:
        about = json.loads(path.with_suffix(".json").read_text())
        table = np.load(path, allow_pickle=False)
        fmt = typed(SweepFormat, about.pop("format"))
        schema = about.pop("schema")
        status = Status(about.pop("status"))
        if schema != 1:
            raise FormatError(f"schema {schema!r} is unknown to this version, which reads 1; update the appliance")
        if table.dtype != _record_dtype(fmt) or table.ndim != 1:
            raise FormatError(f"records of {table.dtype} do not fit the format {fmt} of its sidecar")
        frames = Frames(table["t_ns"].copy(), table["seq"].copy(), table["taxels"].copy())
        return typed(Sweep, about | {"status": status, "frames": frames}), fmt
    except (*UNREADABLE, OSError, KeyError, AttributeError, RecursionError, FormatError) as e:
        raise FormatError(f"{path}: not a recorded sweep ({e}); a recording is an .npy with its .json beside it") from e
