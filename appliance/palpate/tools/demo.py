"""`palpate demo`: a line for each sweep with its answer, at the end their sum."""

from __future__ import annotations

import os
import select
import statistics
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import IO

from palpate.client.answers import Answer
from palpate.core.statistics import wilson
from palpate.core.status import REASONS, Status
from palpate.runtime.loop import Box
from palpate.sim.rig import Act

ARRIVAL_S = 1.0
"""Longest time of a sentence from one end of the serial line to the other."""
HEAD = f"{'':5}{'felt':<20}{'answer':<16}{'sure':>8}"
"""Heads of the columns."""
GREEN, YELLOW, RED, GREY, PLAIN = "\033[32m", "\033[33m", "\033[31m", "\033[90m", "\033[0m"


@dataclass(slots=True)
class AnswerScore:
    """Counts of the answers so far.

    labels: labels of the bundle. right, total: by material; the right answer for other materials is
    `unknown`. early: answers that did not need the whole window. slide_frames: frames from START to
    STOP, of all sweeps.
    """

    labels: frozenset[str]
    right: Counter[str] = field(default_factory=Counter)
    total: Counter[str] = field(default_factory=Counter)
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
        return right

    @property
    def answers(self) -> int:
        return self.total.total()

    @property
    def summary(self) -> str:
        """How many answers were right."""
        return f"{self.right.total()} of {self.answers} answers are right"

    def table(self) -> list[str]:
        """Right answers and totals in lines: by material, and of all sweeps, of the bundle's
        materials; then the share of other materials that were called unknown."""

        def both(names: list[str]) -> tuple[int, int]:
            return sum(self.right[name] for name in names), sum(self.total[name] for name in names)

        names = sorted(self.total.keys() & self.labels)
        lines = [f"  {name:<16}{self.right[name]:>5} / {self.total[name]}" for name in names]
        if names:
            right, n = both(names)
            low, high = wilson(right, n)
            percent = f"{100 * right / n:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
            lines.append(f"  {'all sweeps':<16}{right:>5} / {n:<5} {percent}")
        if others := sorted(self.total.keys() - self.labels):
            right, n = both(others)
            called = f"{right} of {n} sweeps called unknown ({', '.join(others)})"
            lines.append(f"  not in the bundle: {called}")
        return ["  material        right / all", *lines]

    def touch(self, rate_hz: float) -> str:
        """Mean touch time, from start edge to stop edge, and the number of early answers."""
        n = self.answers
        return f"{self.slide_frames / n / rate_hz:.2f} s mean, {self.early} of {n} answered early"

    def latency(self) -> str:
        """Median and worst latency. In virtual time there is none."""
        if not any(self.latency_ms):
            return "not measured: --virtual lets no time pass"
        median, worst = statistics.median(self.latency_ms), max(self.latency_ms)
        return f"{median:.2f} ms median, {worst:.2f} ms worst"


class Demo:
    """Steps a box until the robot's end of its serial line has enough answers, and shows them.
    played: the acts of the simulated robot, with the true materials. far_end: non-blocking file
    descriptor of the robot's end. labels: labels of the bundle. raw: print the sentences alone."""

    def __init__(
        self,
        played: Sequence[Act],
        far_end: int,
        out: IO[str],
        labels: Collection[str],
        *,
        raw: bool,
    ) -> None:
        self.score = AnswerScore(frozenset(labels))
        self._played, self._out = played, out
        self._far_end, self._raw = far_end, raw
        self._colours = not raw and out.isatty()
        self._ticks = "✓✗" if str(getattr(out, "encoding", "")).lower().startswith("utf") else "+-"
        self._rest = b""

    def run(self, box: Box, sweeps: int, stopped: Callable[[], bool]) -> None:
        """Step `box` until `sweeps` answers were read or `stopped()`."""
        sent = 0
        if not self._raw:
            self._print("", HEAD)
        while self.score.answers < sweeps and not stopped():
            sent += len(box.step())
            self._read(sent, sweeps)
        if not self._raw and self.score.answers:
            self._print("", *self._ending(box))

    def _ending(self, box: Box) -> list[str]:
        """The sum of the answers: a table by material, or a sentence after the script."""
        counters = box.counters
        sent = counters.frames + counters.lost_frames
        lines = [
            f"  frames lost     {counters.lost_frames:,} of {sent:,}",
            f"  latency         {self.score.latency()}",
        ]
        if self.score.early:
            lines.append(f"  touch time      {self.score.touch(box.format.rate_hz)}")
        if any(act.about for act in self._played):
            return [f"  {self.score.summary}", *lines]
        return [*self.score.table(), "", *lines]

    def _read(self, sent: int, wanted: int) -> None:
        """Read the sentences at the robot's end, up to `wanted` answers."""
        while select.select([self._far_end], [], [], ARRIVAL_S * (self.score.answers < sent))[0]:
            *lines, self._rest = (self._rest + os.read(self._far_end, 65536)).split(b"\r\n")
            for line in lines:
                self._show(line.decode("ascii"))
                if self.score.answers == wanted:
                    return

    def _show(self, line: str) -> None:
        if self._raw:
            self._print(line)
        answer = Answer.read(line)
        if answer is None:
            return
        act = self._played[answer.sweep - 1]
        right = self.score.add(act, answer)
        if not self._raw:
            self._print(self._row(act, answer, right=right))

    def _row(self, act: Act, answer: Answer, *, right: bool) -> str:
        """A line: the touched material, the answer and its probability, right or wrong, and why."""
        named = answer.label if answer.status == Status.OK else answer.status
        sure = f"{100 * answer.probability:.1f} %" if answer.status == Status.OK else ""
        early = f"after {answer.share:.0%} of the window" if answer.share < 1 else ""
        told = REASONS.get(answer.status, "") if not (right or named == answer.label) else ""
        unknown = "" if act.wanted or act.label in self.score.labels else "not in the bundle"
        why = "; ".join(filter(None, (act.about, unknown, early, told)))
        tone = {Status.OK: GREEN, Status.UNSURE: YELLOW, Status.UNKNOWN: YELLOW}
        name = self._coloured(f"{named:<16}", tone.get(answer.status, RED))
        tick = self._coloured(self._ticks[not right], GREEN if right else RED)
        row = f"{answer.sweep:>3}  {act.label:<16} -> {name}{sure:>8}  {tick}"
        return f"{row}  {self._coloured(why, GREY)}" if why else row

    def _coloured(self, text: str, colour: str) -> str:
        return f"{colour}{text}{PLAIN}" if self._colours else text

    def _print(self, *lines: str) -> None:
        self._out.write("\n".join(lines) + "\n")
        self._out.flush()
