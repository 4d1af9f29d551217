"""The types that all packages share: SweepFormat, Frames, Sweep, Verdict, Status. Times are
nanoseconds of the host's `CLOCK_MONOTONIC`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.status import Status as Status

DATA_TYPES = ("uint8", "int16", "uint16", "float32")
"""Data types of a raw count; the position is its code in packets (PROTOCOL.md)."""
LARGEST_READING = 1e12
"""Largest magnitude of a raw count. Larger ones come from a fault, and their squares overflow."""
MOST_AXES = 8
"""Largest number of values of a taxel."""

EPOCH_BITS = 40
"""An unwrapped sequence number is `(enumeration << EPOCH_BITS) + frame`, so that frames of two
enumerations of the skin are never adjacent."""
EPOCHS = 1 << 22
"""Enumerations are counted modulo this number, so that a frame number always fits int64."""


@dataclass(frozen=True, slots=True)
class SweepFormat:
    """Format of a sweep: `rows` x `cols` taxels, `rate_hz` frames per second, `window` frames used,
    counts of `dtype`.

    axes: values of each taxel; the last is along the skin's normal. The format is part of a bundle:
    another skin needs another bundle, not other code. Raises FormatError for a value out of range.
    """

    rows: int
    cols: int
    rate_hz: float
    window: int
    dtype: str
    axes: int = 1

    def __post_init__(self) -> None:
        if self.dtype not in DATA_TYPES:
            raise FormatError(
                f"data type {self.dtype!r} is unknown; use one of {', '.join(DATA_TYPES)}"
            )
        if not (1 <= self.rows <= 255 and 1 <= self.cols <= 255):
            raise FormatError(
                f"a grid of {self.rows} x {self.cols} taxels is out of range; use 1 to 255 each way"
            )
        if not 1e-3 <= self.rate_hz <= 1e6:  # a readout board sends thousandths of 1 Hz
            raise FormatError(f"a rate of {self.rate_hz} Hz is out of range; use 0.001 to 1e6")
        if self.window < 1:
            raise FormatError(f"a window of {self.window} frames is empty; use at least 1")
        if not 1 <= self.axes <= MOST_AXES:
            raise FormatError(
                f"{self.axes} axes of each taxel are out of range; use 1 to {MOST_AXES}"
            )

    @property
    def numpy_type(self) -> np.dtype[Any]:
        """numpy type of one raw count, little-endian."""
        return np.dtype(self.dtype).newbyteorder("<")

    @property
    def period_ns(self) -> float:
        """Time between two frames in nanoseconds."""
        return 1e9 / self.rate_hz

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one frame's raw counts: [R, C], or [R, C, A] if a taxel has several axes."""
        return shape(self.rows, self.cols, self.axes)

    @property
    def channels(self) -> int:
        """Numbers in one frame: R * C * A."""
        return self.rows * self.cols * self.axes

    @property
    def skin(self) -> tuple[tuple[int, ...], str]:
        """The part that a skin and a bundle must share: shape of a frame, data type."""
        return self.shape, self.dtype

    def json(self) -> dict[str, Any]:
        """All fields by name, for JSON, without a single axis."""
        return {name: value for name, value in asdict(self).items() if (name, value) != ("axes", 1)}

    def __str__(self) -> str:
        return f"{shown(self.shape)} {self.dtype} at {self.rate_hz:g} Hz, window {self.window}"


def shape(rows: int, cols: int, axes: int) -> tuple[int, ...]:
    """Shape of one frame: [R, C], or [R, C, A] if a taxel has several axes."""
    return (rows, cols) if axes == 1 else (rows, cols, axes)


def normal(counts: NDArray[Any], before: int) -> NDArray[Any]:
    """The axis along the skin's normal, which is the last: [..., R, C] of [..., R, C] or [..., R,
    C, A]. before: dimensions before the rows, 0 for one frame, 1 for a window."""
    return counts[..., -1] if counts.ndim == before + 3 else counts


def native(values: NDArray[Any]) -> NDArray[Any]:
    """The same numbers as a plain array in this machine's byte order; no copy if they are one.

    onnxruntime and torch take the bytes of an array as they lie, and the name of its type hides
    their order. Raises FormatError for masked numbers, which a plain array would show.
    """
    if hasattr(values, "mask") and np.ma.is_masked(values):  # numpy.ma takes 2 MiB
        raise FormatError("some of the numbers are masked; fill them in")
    return np.asarray(values.astype(values.dtype.newbyteorder("="), copy=False))


def digitized(x: NDArray[Any], kind: np.dtype[Any]) -> NDArray[Any]:
    """Counts as the converter gives them: whole, within their type. float32 stays unchanged."""
    if kind.kind == "f":
        return x.astype(kind)
    limits = np.iinfo(kind)
    counts: NDArray[Any] = np.clip(np.rint(x), limits.min, limits.max).astype(kind)
    return counts


def shown(shape: Sequence[int]) -> str:
    """A shape for a person: "3x3", "3x3x3"."""
    return "x".join(map(str, shape))


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """n frames: t_ns int64 [n] host monotonic, seq int64 [n] unwrapped numbers, taxels [n, R, C] or
    [n, R, C, A] raw counts."""

    t_ns: NDArray[np.int64]
    seq: NDArray[np.int64]
    taxels: NDArray[Any]

    def __len__(self) -> int:
        return len(self.seq)

    @classmethod
    def empty(cls, format: SweepFormat) -> Frames:
        """No frames of this format."""
        none = np.empty(0, np.int64)
        return cls(none, none, np.empty((0, *format.shape), format.numpy_type))

    @classmethod
    def joined(cls, runs: Sequence[Frames]) -> Frames:
        """Several runs of frames of one skin as one."""
        joined = zip(*((run.t_ns, run.seq, run.taxels) for run in runs), strict=True)
        return cls(*(np.concatenate(part) for part in joined))


def entries(record: Any) -> dict[str, Any]:
    """The fields of a dataclass with slots, by name, for code that runs with each sweep. At each
    call dataclasses.asdict makes a tuple of a generator. Python keeps up to 2,000 tuples of each
    length for later use, so memory would grow for hours."""
    return {name: getattr(record, name) for name in record.__slots__}


class EdgeKind(StrEnum):
    """Meaning of an edge. LOST: edges were dropped or came in a storm."""

    START = "start"
    STOP = "stop"
    NEW_OBJECT = "new-object"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Edge:
    """One debounced edge. t_ns: kernel time stamp, `CLOCK_MONOTONIC`, of the first edge of its
    burst.

    LOST has the time of the edge at which the loss or the storm was detected. Edges reported before
    it are certain. No edge follows it until every line has been quiet for `glitch_us`; the levels
    are then read again, without an edge. speed_mm_s, force_n: of the slide, as sent with
    the command START; None if not sent, and for each edge of a GPIO line.
    """

    kind: EdgeKind
    t_ns: int
    speed_mm_s: float | None = None
    force_n: float | None = None


@dataclass(frozen=True, slots=True)
class Sweep:
    """One sweep as SweepCutter cut it. frames: the middle window if `status` is ok, otherwise
    empty.

    share: 1 for a finished sweep. For a sweep that is still going on it is the share of a window's
    frames that has come, counted from half a second after the start edge; `frames` then are these
    frames. start_ns, stop_ns: trigger edges, host monotonic (equal if one is missing; before the
    stop edge the last frame). lost: frames of the window that never arrived; if `status` is ok they
    were interpolated. complete_ns: arrival of the last stop edge or frame that was needed. object:
    number of NEW OBJECT signals so far; 0 before the first, when sweeps are not fused. material,
    position, session: labels given while recording, "" for none. speed_mm_s, force_n: as in the
    start edge. filled: indices of the interpolated frames in `frames`; None if there are none.
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
    speed_mm_s: float | None = None
    force_n: float | None = None
    filled: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """The answer to one sweep.

    scores: float64 [K] probabilities of the K labels for this sweep, or for all fused sweeps; empty
    if nothing was classified. margin: probability of the label minus that of the next label.
    detail: the subject of the status ("taxel 2.3"). fused: number of sweeps in `scores`. lost: as
    in Sweep. latency_ns: from `Sweep.complete_ns` to the verdict. bundle: id of the bundle. share:
    share of the window that was used, less than 1 in an early answer. own: float64 [K]
    probabilities of this sweep alone, before an enrolled label needs its least probability
    (EnrolledLabels); empty if it has none. An unknown sweep has them if it is doubtful and belongs
    to an object (KnownMaterial). displacement: distance of the contact from its positions in
    training ("moved 2.1 mm too far towards row 4"); None if it is in place, or if the bundle does
    not have the positions. degraded: the broken taxels that were bridged ("silent taxel 2.3"); None
    for none. after: number of the last sweep before it that had probabilities, since NEW OBJECT; 0
    for none. speed_mm_s, force_n: as in Sweep. measured_mm_s: speed of the slide, measured from the
    window; None if that was not possible, and in early answers. direction: one of
    `directions.DIRECTIONS`; None without a measured speed.
    """

    sweep: int
    time_ns: int
    status: Status
    label: str = ""
    probability: float = 0.0
    margin: float = 0.0
    scores: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    fused: int = 0
    lost: int = 0
    latency_ns: int = 0
    bundle: str = ""
    detail: str = ""
    share: float = 1.0
    own: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    displacement: str | None = None
    degraded: str | None = None
    after: int = 0
    speed_mm_s: float | None = None
    force_n: float | None = None
    measured_mm_s: float | None = None
    direction: str | None = None

    @classmethod
    def of(cls, sweep: Sweep, status: Status, now_ns: int, bundle: str, **found: Any) -> Verdict:
        """The answer to a sweep, without a label unless that was found."""
        return cls(
            *(sweep.id, now_ns, status),
            lost=sweep.lost,
            latency_ns=now_ns - sweep.complete_ns,
            bundle=bundle,
            share=sweep.share,
            speed_mm_s=sweep.speed_mm_s,
            force_n=sweep.force_n,
            **found,
        )

    def as_dict(self, *, arrays: bool = True) -> dict[str, Any]:
        """All fields by name, for JSON, which keeps numbers bit for bit; without fields that are
        None. arrays: include `scores` and `own`, as lists."""
        values = {name: value for name, value in entries(self).items() if value is not None}
        # sidecars, the feed and the status file call the displacement `moved`
        values["moved"] = values.pop("displacement", "")
        values.setdefault("degraded", "")
        for name in ("scores", "own"):
            if arrays:
                values[name] = values[name].tolist()
            else:
                del values[name]
        return values
