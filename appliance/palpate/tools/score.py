"""Compares the answers that the robot read with the true materials."""

from __future__ import annotations

import statistics
from collections import Counter
from dataclasses import dataclass, field

from palpate.client.answers import Answer
from palpate.core.statistics import wilson
from palpate.core.status import Status
from palpate.sim.rig import Act


@dataclass(slots=True)
class AnswerScore:
    """Counts of the answers so far.

    labels: labels of the bundle. right, total: by material; the right answer for other materials is
    `unknown`. objects: whether the last answer for each object was right, if NEW OBJECT was
    signalled. early: answers that did not need the whole window. slide_frames: frames from START to
    STOP, of all sweeps.
    """

    labels: frozenset[str]
    right: Counter[str] = field(default_factory=Counter)
    total: Counter[str] = field(default_factory=Counter)
    objects: list[bool] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    early: int = 0
    slide_frames: int = 0

    def add(self, act: Act, answer: Answer) -> bool:
        """Count an answer. Returns whether it is right: the status that `act` wants, otherwise its
        material, or `unknown` for a material that the bundle does not have."""
        known = act.label in self.labels
        wanted = act.wanted or (Status.OK if known else Status.UNKNOWN)
        right = answer.status == wanted and (wanted != Status.OK or answer.label == act.label)
        self.total[act.label] += 1
        self.right[act.label] += right
        self.latency_ms.append(answer.latency_ms)
        self.early += answer.share < 1
        self.slide_frames += act.stop - act.start
        if not known:
            return right
        if act.new_object:
            self.objects.append(right)
        elif self.objects:
            self.objects[-1] = right
        return right

    @property
    def answers(self) -> int:
        return self.total.total()

    @property
    def summary(self) -> str:
        """How many answers were right."""
        return f"{self.right.total()} of {self.answers} answers are right"

    def table(self) -> list[str]:
        """Right answers and totals in lines: by material, of all sweeps, of all objects, of the
        bundle's materials; then the share of other materials that were called unknown."""
        rows = [
            (name, self.right[name], self.total[name])
            for name in sorted(self.total.keys() & self.labels)
        ]
        sums = (
            [("all sweeps", sum(right for _, right, _ in rows), sum(n for *_, n in rows))]
            if rows
            else []
        )
        if self.objects:
            sums.append(("all objects", sum(self.objects), len(self.objects)))
        lines = [f"  {name:<16}{right:>5} / {n}" for name, right, n in rows]
        for name, right, n in sums:
            low, high = wilson(right, n)
            percent = f"{100 * right / n:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
            lines.append(f"  {name:<16}{right:>5} / {n:<5} {percent}")
        if others := sorted(self.total.keys() - self.labels):
            right, n = (sum(counts[name] for name in others) for counts in (self.right, self.total))
            lines.append(
                f"  not in the bundle: {right} of {n} sweeps called unknown ({', '.join(others)})"
            )
        return ["  material        right / all", *lines]

    def touch(self, rate_hz: float) -> str:
        """Mean touch time, from start edge to stop edge, and the number of early answers."""
        n = self.answers
        return f"{self.slide_frames / n / rate_hz:.2f} s mean, {self.early} of {n} answered early"

    def latency(self) -> str:
        """Median and worst latency. In virtual time there is none."""
        if not any(self.latency_ms):
            return "not measured: --virtual lets no time pass"
        return (
            f"{statistics.median(self.latency_ms):.2f} ms median, {max(self.latency_ms):.2f} ms"
            " worst"
        )
