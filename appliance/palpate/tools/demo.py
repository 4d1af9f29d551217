"""`palpate demo`: a line for each sweep with its answer, coloured on a terminal, at the end their
sum."""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Collection, Sequence
from typing import IO

from palpate.client.answers import Answer
from palpate.core.status import REASONS, Status
from palpate.runtime.loop import Box
from palpate.sim.rig import Act
from palpate.tools.score import AnswerScore

ARRIVAL_S = 1.0
"""Longest time of a sentence from one end of the serial line to the other."""
HEAD = f"{'':5}{'felt':<20}{'answer':<16}{'sure':>8}"
"""Heads of the columns."""
GREEN, YELLOW, RED, GREY, PLAIN = "\033[32m", "\033[33m", "\033[31m", "\033[90m", "\033[0m"


class Demo:
    """Steps a box until the robot's end of its serial line has enough answers, and shows them.

    played: the acts of the simulated robot, with the true materials. far_end: non-blocking file
    descriptor of the robot's end. labels: labels of the bundle. raw: print the sentences alone.
    """

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
        """The sum of the answers: a table by material, or a sentence after a tour."""
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
        """Read the sentences at the robot's end, up to `wanted` answers. Sent answers are waited
        for."""
        while select.select([self._far_end], [], [], ARRIVAL_S if self.score.answers < sent else 0)[
            0
        ]:
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
