"""Compares the answers that the robot read with what it did. In: sentences, acts. Out: counts and intervals."""

from __future__ import annotations

import statistics
from collections import Counter
from dataclasses import dataclass, field

from appliance.client.answers import Answer
from appliance.core.statistics import wilson
from appliance.core.status import Status
from appliance.sim.rig import Act


@dataclass(slots=True)
class AnswerScore:
    """Counts of the answers so far.

    right, total: by material. objects: whether the last answer for each object was right, where NEW OBJECT was
    signalled. early: answers that did not need the whole window. slide_frames: frames from START to STOP, of all
    sweeps.
    """

    right: Counter[str] = field(default_factory=Counter)
    total: Counter[str] = field(default_factory=Counter)
    objects: list[bool] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    early: int = 0
    slide_frames: int = 0

    def add(self, act: Act, answer: Answer) -> bool:
        """Count an answer; True where it names the material of `act`."""
        right = answer.label == act.label and answer.status == Status.OK
        self.total[act.label] += 1
        self.right[act.label] += right
        self.latency_ms.append(answer.latency_ms)
        self.early += answer.share < 1
        self.slide_frames += act.stop - act.start
        if act.new_object:
            self.objects.append(right)
        elif self.objects:
            self.objects[-1] = right
        return right

    def table(self) -> list[str]:
        """Lines with right answers and their number: by material, of all sweeps, of all objects."""
        rows = [(name, self.right[name], self.total[name]) for name in sorted(self.total)]
        sums = [("all sweeps", self.right.total(), self.total.total())]
        if self.objects:
            sums.append(("all objects", sum(self.objects), len(self.objects)))
        lines = [f"  {name:<16}{right:>5} / {n}" for name, right, n in rows]
        for name, right, n in sums:
            low, high = wilson(right, n)
            percent = f"{100 * right / n:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
            lines.append(f"  {name:<16}{right:>5} / {n:<5} {percent}")
        return ["  material        right / all", *lines]

    def touch(self, rate_hz: float) -> str:
        """Mean touch time, from the start edge to the stop edge, and how many answers came before it."""
        n = self.total.total()
        return f"{self.slide_frames / n / rate_hz:.2f} s mean, {self.early} of {n} answered early"

    def latency(self) -> str:
        """Median and worst latency."""
        return f"{statistics.median(self.latency_ms):.2f} ms median, {max(self.latency_ms):.2f} ms worst"
