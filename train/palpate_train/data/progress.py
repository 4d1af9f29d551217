"""Progress lines of long work: how many tasks are done, and how long the rest will take."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping

Clock = Callable[[], float]
Tell = Callable[[str, float, float | None], None]
"""Takes the name of the step that begins, the share that is done, and the seconds that are left,
None if they are unknown."""


class ProgressLine(str):
    """A progress line with its numbers of tasks, `done` of `total`, from which a display can draw a
    bar."""

    done: int
    total: int

    @classmethod
    def of(cls, done: int, total: int, left_s: float | None, what: str) -> ProgressLine:
        """left_s: estimated time for the other tasks, None if unknown. what: the current task."""
        line = cls(
            f"{done}/{total} done{'' if left_s is None else f', {spoken(left_s)} left'} ({what})"
        )
        line.done, line.total = done, total
        return line


class StageLine(str):
    """A progress line of work in stages: `stage` of `stages` (counted from 1) is called `name`, and
    its share `within` [0, 1] is done, 0 if that is unknown."""

    stage: int
    stages: int
    name: str
    within: float

    @classmethod
    def of(cls, stage: int, stages: int, name: str, what: str) -> StageLine:
        """what: the present work in this stage; a training says `step 3/1200` in it."""
        line = cls(f"part {stage} of {stages}, {what}")
        line.stage, line.stages, line.name = stage, stages, name
        step = re.search(r"step (\d+)/(\d+)", what)
        line.within = int(step[1]) / int(step[2]) if step else 0.0
        return line


class Progress:
    """Logs how many tasks are done, and how long the others will take at the same average.

    clock: returns seconds. done: finished tasks.
    """

    def __init__(
        self, total: int, log: Callable[[str], None], clock: Clock = time.monotonic
    ) -> None:
        self._total, self._log, self._clock = total, log, clock
        self._start, self.done = clock(), 0

    def __call__(self, what: str) -> None:
        """The task `what` is done."""
        self.done += 1
        self._show(what)

    def begin(self, what: str) -> None:
        """The task `what` begins. It counts as done when the next task begins."""
        self._show(what)
        self.done += 1

    def _show(self, what: str) -> None:
        took = self._clock() - self._start
        left_s = took / self.done * (self._total - self.done) if self.done else None
        self._log(ProgressLine.of(self.done, self._total, left_s, what))


class StepTimes:
    """Tells the steps of some work with the time left, by the time that the steps before took.
    shares: of the time that each step takes, in their order."""

    def __init__(
        self, shares: Mapping[str, float], tell: Tell, clock: Clock = time.monotonic
    ) -> None:
        self._shares, self._tell, self._clock = shares, tell, clock
        self._start, self._done = clock(), 0.0

    def begin(self, step: str) -> None:
        """The step begins, and the one before is done."""
        took, done = self._clock() - self._start, self._done / sum(self._shares.values())
        self._tell(step, done, took * (1 - done) / done if done else None)
        self._done += self._shares[step]


def spoken(seconds: float) -> str:
    """A duration for a person: in s, in min from 100 s on, in h from 100 min on."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
