"""`palpate demo`: the skin live in the terminal during a sweep, then a line with the answer, at the
end their sum.

A terminal shows pictures and colours; other outputs get plain lines.
"""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext, redirect_stderr
from io import StringIO
from typing import IO, Any

from numpy.typing import NDArray

from palpate.client.answers import Answer
from palpate.core.clock import Clock
from palpate.core.status import REASONS, Status
from palpate.core.types import normal
from palpate.runtime.loop import Box
from palpate.sim.rig import Act
from palpate.tools.score import AnswerScore

FRAME_NS = 66_000_000
"""Time between two pictures of the skin."""
ARRIVAL_S = 1.0
"""Longest time of a sentence from one end of the serial line to the other."""
HEAD = f"{'':5}{'felt':<20}{'answer':<16}{'sure':>8}"
"""Heads of the columns."""
GREEN, YELLOW, RED, GREY, PLAIN = "\033[32m", "\033[33m", "\033[31m", "\033[90m", "\033[0m"
BRIGHT = 160
"""Raw counts that are shown white; the skin seldom has more."""


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


class LogLines(StringIO):
    """Takes the log while a picture is drawn, and prints its lines above the picture."""

    def __init__(self, show: Callable[[str], None]) -> None:
        super().__init__()
        self._show = show

    def write(self, text: str) -> int:
        """Print the lines of `text`."""
        for line in filter(None, text.splitlines()):
            self._show(f"     {GREY}{line}{PLAIN}")
        return len(text)


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
        self._ticks = "✓✗" if str(getattr(out, "encoding", "")).lower().startswith("utf") else "+-"
        self._rest = b""
        self._drawn = 0
        self._next_ns = 0

    def run(self, box: Box, sweeps: int, stopped: Callable[[], bool]) -> None:
        """Step `box` until `sweeps` answers were read or `stopped()`."""
        sent = 0
        if not self._raw:
            self._print("", HEAD)
        with redirect_stderr(LogLines(self._print)) if self._live else nullcontext():
            while self.score.answers < sweeps and not stopped():
                sent += len(box.step())
                self._read(sent, sweeps)
                if (frame := box.newest_frame()) is not None:
                    self._draw(frame)
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
        return f"{colour}{text}{PLAIN}" if self._live else text

    def _draw(self, frame: NDArray[Any]) -> None:
        """Draw a frame over the previous picture, in one write against flicker, if it is time."""
        if not self._live or self._clock.now_ns() < self._next_ns:
            return
        self._next_ns = self._clock.now_ns() + FRAME_NS
        felt = self._played[-1].label
        lines = ["", f"  under the finger: {felt}", "", *picture(frame), ""]
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
