"""Cuts the window of each sweep from the stream of frames.

Each trigger gives one Sweep, with a complete window or with a status that explains why it has none.
For early answers the open sweep is returned while it goes on. The window is the middle of the sweep
(paper, sec. II.B). It is located by time and cut by sequence number.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from palpate.core.config import SweepConfig
from palpate.core.types import Edge, EdgeKind, Frames, Status, Sweep, SweepFormat
from palpate.sweeps.frame_ring import FrameRing


@dataclass(slots=True)
class OpenSweep:
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
        start, filled = self.start, missing if missing and len(frames) else None
        what = self.id, start.t_ns, stop_ns, status, frames, len(missing), now_ns, self.object
        slide = Sweep(*what, share=share, filled=filled)
        return replace(slide, speed_mm_s=start.speed_mm_s, force_n=start.force_n)


class SweepCutter:
    """Cuts windows from the last `max_duration_s`, for sweeps that are not answered yet."""

    def __init__(self, format: SweepFormat, config: SweepConfig) -> None:
        self._format = format
        self._max_duration_ns = round(config.max_duration_s * 1e9)
        self._late_ns, self._lead_ns = config.late_ms * 1_000_000, config.lead_ms * 1_000_000
        self._least_ns = format.window * format.period_ns
        self._ring = FrameRing(format, config.max_duration_s + config.late_ms / 1000 + 1)
        self._open: OpenSweep | None = None
        # (sweep, stop ns) whose window may still lack frames
        self._closing: list[tuple[OpenSweep, int]] = []
        self._done: list[Sweep] = []
        self._count = self._object = 0

    @property
    def sweeping(self) -> bool:
        """True between a start edge and the answer to it."""
        return bool(self._closing) or (self._open is not None and not self._open.answered)

    def may_end(self, now_ns: int) -> bool:
        """Whether the open sweep has lasted the length of a window."""
        sweep = self._open
        return bool(sweep and not sweep.answered and now_ns - sweep.start_ns >= self._least_ns)

    def put(self, frames: Frames, now_ns: int) -> None:
        """Put frames into the ring. Frames of a new enumeration end the open sweep."""
        if not len(frames):
            return
        if self._ring.restarted(frames):
            self.interrupt(Status.SENSOR_LOST, now_ns)
        self._ring.put(frames)

    def trigger(self, edges: Iterable[Edge], ready: bool, now_ns: int) -> None:
        """Process the edges of a turn. ready: a sweep could be taken when they came."""
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
        """Answer all open sweeps with `status`; whether there were any."""
        had = self.sweeping
        if self._open and not self._open.answered:
            self._answer(self._open, now_ns, status, now_ns)
        for sweep, stop_ns in self._closing:
            self._answer(sweep, stop_ns, status, now_ns)
        self._closing = []
        return had

    def finished(self, now_ns: int) -> list[Sweep]:
        """The sweeps that can be answered at `now_ns`, in order of their numbers."""
        sweep = self._open
        if sweep and not sweep.answered and now_ns - sweep.start_ns > self._max_duration_ns:
            self._answer(sweep, now_ns, Status.LONG, now_ns)
        waiting: list[tuple[OpenSweep, int]] = []
        for item in self._closing:
            if cut := self._cut(*item, now_ns):
                self._done.append(cut)
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
                if self._ring.newest < 0 or self._ring.newest_ns < begin_ns:
                    return
                sweep.first = self._ring.seq_at(begin_ns)
            n = -(-(sweep.step + 1) * self._format.window // (steps + 1))
            if self._ring.newest < sweep.first + n - 1:
                return
            sweep.step += 1
            frames, missing = self._ring.window(sweep.first, n)
            if len(frames):
                stop_ns, share = int(frames.t_ns[-1]), sweep.step / (steps + 1)
                yield sweep.sweep(stop_ns, Status.OK, frames, missing, now_ns, share=share)

    def settle(self) -> None:
        """Mark the open sweep as answered early; its stop edge then gives no answer."""
        if self._open:
            self._open.answered = True

    def latest(self, n: int) -> NDArray[Any] | None:
        """The newest `n` frames, raw counts [n, R, C(, A)], for a tare; None if not whole."""
        return self._ring.latest(n)

    def _begin(self, edge: Edge) -> OpenSweep:
        self._count += 1
        return OpenSweep(self._count, self._object, edge)

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
            if length_ns < self._least_ns:
                self._answer(sweep, t_ns, Status.SHORT, now_ns)
            elif length_ns > self._max_duration_ns:
                self._answer(sweep, t_ns, Status.LONG, now_ns)
            else:
                self._closing.append((sweep, t_ns))

    def _answer(self, sweep: OpenSweep, stop_ns: int, status: Status, now_ns: int) -> None:
        """Finish a sweep with a status and without frames."""
        sweep.answered = True
        self._done.append(sweep.sweep(stop_ns, status, Frames.empty(self._format), (), now_ns))

    def _cut(self, sweep: OpenSweep, stop_ns: int, now_ns: int) -> Sweep | None:
        """The sweep with its window, or None while its frames may still arrive."""
        n = self._format.window
        first = self._ring.seq_at((sweep.start_ns + stop_ns) / 2) - n // 2
        if self._ring.newest < first + n - 1 and now_ns <= stop_ns + self._late_ns:
            return None
        frames, missing = self._ring.window(first, n)
        status = Status.OK if len(frames) else Status.GAP
        return sweep.sweep(stop_ns, status, frames, missing, now_ns)
