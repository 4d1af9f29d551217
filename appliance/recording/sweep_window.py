"""Cuts the window of each sweep from the stream of frames.

Each trigger gives one Sweep, with a complete window or with a status that explains why it has none.
For early answers the open sweep is returned while it goes on. The window is the middle of the sweep
(paper, sec. II.B). It is located by time and cut by sequence number.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.config import SweepConfig
from appliance.core.types import EPOCH_BITS, Edge, EdgeKind, Frames, Status, Sweep, SweepFormat

MAX_GAP = 2
"""Largest number of consecutive missing frames that are interpolated; for more the status is
`gap`."""


@dataclass(slots=True)
class _Open:
    """A sweep between its edges.

    start: its start edge, or the edge that was answered without one. answered: it was answered
    already, and only its stop edge is still expected. first: number of the first frame for early
    answers, None until that frame has arrived. step: number of steps that `so_far` has returned.
    """

    id: int
    object: int
    start: Edge
    answered: bool = False
    first: int | None = None
    step: int = 0

    @property
    def start_ns(self) -> int:
        """Time of the start edge, host monotonic."""
        return self.start.t_ns

    def sweep(
        self,
        stop_ns: int,
        status: Status,
        frames: Frames,
        missing: tuple[int, ...],
        now_ns: int,
        share: float = 1.0,
    ) -> Sweep:
        """The Sweep that the answer is about, complete at `now_ns`. missing: indices of the frames
        of the window that never arrived."""
        return Sweep(
            self.id,
            self.start_ns,
            stop_ns,
            status,
            frames,
            len(missing),
            now_ns,
            self.object,
            share=share,
            speed_mm_s=self.start.speed_mm_s,
            force_n=self.start.force_n,
            filled=missing if missing and len(frames) else None,
        )


class SweepCutter:
    """Cuts windows. It holds the frames of the last `max_duration_s` and a margin, and the sweeps
    that were not answered yet."""

    def __init__(self, format: SweepFormat, config: SweepConfig) -> None:
        self._format = format
        self._max_duration_ns = round(config.max_duration_s * 1e9)
        self._late_ns, self._lead_ns = config.late_ms * 1_000_000, config.lead_ms * 1_000_000
        self._size = (
            format.window
            + 2 * MAX_GAP
            + int((config.max_duration_s + config.late_ms / 1000 + 1) * format.rate_hz)
        )
        # slot = seq % size: a frame is found without searching, and stays until it is overwritten
        self._seq = np.full(self._size, -1, np.int64)
        self._t_ns = np.zeros(self._size, np.int64)
        self._taxels = np.zeros((self._size, *format.shape), format.numpy_type)
        self._newest = -1
        self._open: _Open | None = None
        self._closing: list[
            tuple[_Open, int]
        ] = []  # (sweep, stop ns) whose window may still lack frames
        self._done: list[Sweep] = []
        self._count = self._object = 0

    @property
    def sweeping(self) -> bool:
        """True between a start edge and the answer to it."""
        return bool(self._closing) or (self._open is not None and not self._open.answered)

    def put(self, frames: Frames, now_ns: int) -> None:
        """Put frames into the ring. Frames of a new enumeration end the open sweep."""
        if not len(frames):
            return
        if self._newest >= 0 and frames.seq[-1] >> EPOCH_BITS != self._newest >> EPOCH_BITS:
            self.interrupt(Status.SENSOR_LOST, now_ns)
        n = len(frames)
        at = int(frames.seq[0]) % self._size
        slots: slice | NDArray[np.int64] = slice(at, at + n)
        if at + n > self._size or frames.seq[-1] - frames.seq[0] != n - 1:
            slots = frames.seq % self._size
        self._seq[slots], self._t_ns[slots], self._taxels[slots] = (
            frames.seq,
            frames.t_ns,
            frames.taxels,
        )
        self._newest = int(frames.seq[-1])

    def trigger(self, edges: Iterable[Edge], ready: bool, now_ns: int) -> None:
        """Process the trigger edges of one turn in order. ready: whether the box could take a sweep
        when they came."""
        before = self._count
        for edge in edges:
            if edge.kind is EdgeKind.START:
                self._start(edge, ready, now_ns)
            elif edge.kind is EdgeKind.STOP:
                self._stop(edge, now_ns)
            elif edge.kind is EdgeKind.NEW_OBJECT:
                self.new_object()
            elif not self.interrupt(Status.EDGES_LOST, now_ns) and self._count == before:
                # else a sweep of this turn was answered, and the robot expects one answer for it
                self._answer(self._begin(edge), edge.t_ns, Status.EDGES_LOST, now_ns)

    def new_object(self) -> None:
        """Sweeps that start from now on belong to another object."""
        self._object += 1

    def interrupt(self, status: Status, now_ns: int) -> bool:
        """Answer all unanswered sweeps with `status`. Returns whether there were any. A later stop
        edge gives no answer."""
        had = self.sweeping
        if self._open and not self._open.answered:
            self._answer(self._open, now_ns, status, now_ns)
        for sweep, stop_ns in self._closing:
            self._answer(sweep, stop_ns, status, now_ns)
        self._closing = []
        return had

    def finished(self, now_ns: int) -> list[Sweep]:
        """The sweeps that can be answered at `now_ns`, in order of their numbers."""
        if (
            self._open
            and not self._open.answered
            and now_ns - self._open.start_ns > self._max_duration_ns
        ):
            self._answer(self._open, now_ns, Status.LONG, now_ns)
        waiting = []
        for item in self._closing:
            sweep = self._cut(*item, now_ns)
            if sweep:
                self._done.append(sweep)
            else:
                waiting.append(item)
        self._closing = waiting
        done, self._done = self._done, []
        return sorted(done, key=lambda s: s.id)

    def so_far(self, steps: int, now_ns: int) -> Iterator[Sweep]:
        """The open sweep at each step that was reached since the last call, until `settle` marks it
        as answered.

        steps: D. Step d = 1..D is reached with frame ceil(d * window / (D + 1)) of the window that
        begins `lead_ms` after the start edge. Its Sweep has exactly the frames up to this frame,
        independent of their grouping in transfers. After a gap that cannot be filled no further
        steps are returned.
        """
        sweep = self._open
        while sweep and not sweep.answered and not self._closing and sweep.step < steps:
            if sweep.first is None:
                begin_ns = sweep.start_ns + self._lead_ns
                if self._newest < 0 or self._t_ns[self._newest % self._size] < begin_ns:
                    return
                sweep.first = self._seq_at(begin_ns)
            n = -(-(sweep.step + 1) * self._format.window // (steps + 1))
            if self._newest < sweep.first + n - 1:
                return
            sweep.step += 1
            frames, missing = self._window(sweep.first, n)
            if len(frames):
                yield sweep.sweep(
                    int(frames.t_ns[-1]),
                    Status.OK,
                    frames,
                    missing,
                    now_ns,
                    share=sweep.step / (steps + 1),
                )

    def settle(self) -> None:
        """Mark the open sweep as answered early; its stop edge then gives no answer."""
        if self._open:
            self._open.answered = True

    def latest(self, n: int) -> NDArray[Any] | None:
        """The newest `n` frames as raw counts [n, R, C] or [n, R, C, A], for a tare; None if frames
        are missing."""
        window = np.arange(self._newest - n + 1, self._newest + 1)
        slots = window % self._size
        return (
            self._taxels[slots]
            if self._newest >= 0 and (self._seq[slots] == window).all()
            else None
        )

    def _begin(self, edge: Edge) -> _Open:
        self._count += 1
        return _Open(self._count, self._object, edge)

    def _start(self, edge: Edge, ready: bool, now_ns: int) -> None:
        if self._open and not self._open.answered:
            self._answer(self._open, edge.t_ns, Status.NO_STOP, now_ns)
        self._open = self._begin(edge)
        if not ready:
            self._answer(self._open, edge.t_ns, Status.NOT_READY, now_ns)

    def _stop(self, edge: Edge, now_ns: int) -> None:
        sweep, self._open = self._open, None
        t_ns = edge.t_ns
        if sweep is None:
            self._answer(self._begin(edge), t_ns, Status.NO_START, now_ns)
        elif not sweep.answered:
            length_ns = t_ns - sweep.start_ns
            if length_ns < self._format.window * self._format.period_ns:
                self._answer(sweep, t_ns, Status.SHORT, now_ns)
            elif length_ns > self._max_duration_ns:
                self._answer(sweep, t_ns, Status.LONG, now_ns)
            else:
                self._closing.append((sweep, t_ns))

    def _answer(self, sweep: _Open, stop_ns: int, status: Status, now_ns: int) -> None:
        """Finish a sweep with a status and without frames."""
        sweep.answered = True
        self._done.append(sweep.sweep(stop_ns, status, Frames.empty(self._format), (), now_ns))

    def _cut(self, sweep: _Open, stop_ns: int, now_ns: int) -> Sweep | None:
        """The sweep with its window, or None while its frames may still arrive."""
        window = self._format.window
        first = self._seq_at((sweep.start_ns + stop_ns) / 2) - window // 2
        late = now_ns > stop_ns + self._late_ns
        if self._newest < first + window - 1 and not late:
            return None
        frames, missing = self._window(first, window)
        status = Status.OK if len(frames) else Status.GAP
        return sweep.sweep(stop_ns, status, frames, missing, now_ns)

    def _window(self, first: int, n: int) -> tuple[Frames, tuple[int, ...]]:
        """Frames `first` to `first + n` with missing frames interpolated, and the indices of the
        missing frames. No frames if a gap is too wide."""
        pad = MAX_GAP
        seq = np.arange(first - pad, first + n + pad)
        slots = seq % self._size
        have = np.flatnonzero((self._seq[slots] == seq) & (seq >= 0))
        missing = np.setdiff1d(np.arange(pad, pad + n), have, assume_unique=True)
        frames = Frames(self._t_ns[slots], seq, self._taxels[slots])
        cut = slice(pad, pad + n) if interpolate(frames, have, missing) else slice(0)
        window = Frames(frames.t_ns[cut], frames.seq[cut], frames.taxels[cut])
        return window, tuple((missing - pad).tolist())

    def _seq_at(self, t_ns: float) -> int:
        """Number of the frame at `t_ns`, computed from the nearest frame in the ring."""
        k = int(np.abs(self._t_ns - round(t_ns)).argmin())
        return int(self._seq[k]) + round((t_ns - int(self._t_ns[k])) / self._format.period_ns)


def interpolate(frames: Frames, have: NDArray[np.int64], missing: NDArray[np.int64]) -> bool:
    """Interpolate the rows `missing` of `frames` in place from their neighbours in `have`; False if
    a gap is too wide.

    have, missing: int64, sorted row indices.
    """
    right = np.searchsorted(have, missing)
    if len(missing) and (right.min() == 0 or right.max() == len(have)):
        return False
    lo, hi = have[right - 1], have[right % max(len(have), 1)]
    if len(missing) and (hi - lo).max() > MAX_GAP + 1:
        return False
    part = (missing - lo) / (hi - lo)
    for values in (frames.t_ns, frames.taxels):
        a, b = values[lo].astype(np.float64), values[hi].astype(np.float64)
        between = a + (b - a) * part.reshape(-1, *[1] * (values.ndim - 1))
        values[missing] = between if values.dtype.kind == "f" else np.rint(between)
    return True
