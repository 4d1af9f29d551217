"""`palpate demo`: the skin live in the terminal during a sweep, then the verdict with its sentence,
at the end a table.

A terminal shows pictures; other outputs get plain lines.
"""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Collection, Sequence
from typing import IO, Any

from numpy.typing import NDArray

from appliance.client.answers import Answer
from appliance.core.clock import Clock
from appliance.core.types import normal
from appliance.runtime.loop import Box
from appliance.sim.rig import Act
from appliance.tools.score import AnswerScore

FRAME_NS = 66_000_000
"""Time between two pictures of the skin."""
ARRIVAL_S = 1.0
"""Longest time of a sentence from one end of the serial line to the other."""
BAR = 30
"""Characters of a full bar."""
BRIGHT = 160
"""Raw counts that are shown white; the skin seldom has more."""


def bar(probability: float) -> str:
    """A probability as a bar."""
    full = round(probability * BAR)
    return "█" * full + "·" * (BAR - full) + f" {probability:6.1%}"


def picture(frame: NDArray[Any]) -> list[str]:
    """A frame [R, C] or [R, C, A] of raw counts as shaded cells with numbers, two lines a row; of
    several axes, the normal axis."""
    lines = []
    for row in normal(frame, 0).astype(int):
        level = [min(23, max(0, count) * 24 // BRIGHT) for count in row]
        shade = [f"\033[48;5;{232 + v}m\033[38;5;{16 if v > 11 else 250}m" for v in level]
        lines.append("  " + "".join(f"{colour}{'':6}\033[0m" for colour in shade))
        lines.append(
            "  "
            + "".join(
                f"{colour}{count:^6}\033[0m" for colour, count in zip(shade, row, strict=True)
            )
        )
    return lines


class Demo:
    """Steps a box until the robot's end of its serial line has enough answers, and shows them.

    played: the acts of the simulated robot, with the true materials. far_end: non-blocking file
    descriptor of the robot's end. labels: labels of the bundle. raw: print the sentences alone.
    """

    def __init__(
        self,
        played: Sequence[Act],
        far_end: int,
        clock: Clock,
        out: IO[str],
        labels: Collection[str],
        *,
        raw: bool,
    ) -> None:
        self.score = AnswerScore(frozenset(labels))
        self._played, self._clock, self._out = played, clock, out
        self._far_end, self._raw = far_end, raw
        self._live = not raw and out.isatty()
        self._rest = b""
        self._drawn = 0
        self._next_ns = 0

    def run(self, box: Box, sweeps: int, stopped: Callable[[], bool]) -> None:
        """Step `box` until `sweeps` answers were read or `stopped()`."""
        sent = 0
        while self.score.answers < sweeps and not stopped():
            sent += len(box.step())
            self._read(sent, sweeps)
            if (
                self._live
                and self._clock.now_ns() >= self._next_ns
                and (frame := box.newest_frame()) is not None
            ):
                self._next_ns = self._clock.now_ns() + FRAME_NS
                self._draw(
                    ["", f"  under the finger: {self._played[-1].label}", "", *picture(frame), ""]
                )
        if not self._raw and self.score.answers:
            lost = (
                f"  frames lost     {box.counters.lost_frames} of"
                f" {box.counters.frames + box.counters.lost_frames}"
            )
            touch = (
                [f"  touch time      {self.score.touch(box.format.rate_hz)}"]
                if self.score.early
                else []
            )
            self._print(
                "",
                *self.score.table(),
                "",
                lost,
                f"  latency         {self.score.latency()}",
                *touch,
            )

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
        mark = (
            ("right" if right else "wrong")
            if act.label in self.score.labels
            else "not in the bundle"
        )
        if not self._raw:
            named = answer.label or answer.status
            used = f"  after {answer.share:.0%} of the window" if answer.share < 1 else ""
            text = (
                f"{answer.sweep:>3}  {act.label:<15} -> {named:<15} {mark} "
                f" {bar(answer.probability)}{used}"
            )
            self._print(text, f"     {line}")

    def _draw(self, lines: list[str]) -> None:
        """Draw over the previous picture, in one write against flicker."""
        self._out.write(self._back() + "".join(f"{line}\033[K\n" for line in lines))
        self._out.flush()
        self._drawn = len(lines)

    def _back(self) -> str:
        """The control sequence that returns to the picture's first line."""
        drawn, self._drawn = self._drawn, 0
        return f"\033[{drawn}A" if drawn else ""

    def _print(self, *lines: str) -> None:
        erase = "\033[J" if self._drawn else ""
        self._out.write(self._back() + erase + "\n".join(lines) + "\n")
        self._out.flush()
