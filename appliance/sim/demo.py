"""What a person sees: the skin live in the terminal while a sweep runs, then the verdict and its sentence, then a table.

In: a box on the rig and the far end of its serial line. Out: pictures where there is a terminal, else plain lines.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import IO

import numpy as np

from ..clock import Clock
from ..errors import SensorError
from ..sensor import Sensor, Tally
from ..sweep import Frames, Status
from ..wire import Identity
from .rig import Act

FRAME_NS = 66_000_000
"""Time between two pictures of the skin."""
BAR = 30
BRIGHT = 160
"""Digits that are shown white; the skin seldom gives more."""


@dataclass(frozen=True, slots=True)
class Answer:
    """A RES sentence as the robot read it."""

    sweep: int
    status: str
    label: str
    probability: float
    lost: int
    latency_ms: float

    @classmethod
    def read(cls, line: str) -> Answer | None:
        """The answer in a line, or None for another sentence."""
        parts = line.split("*")[0].split(",")
        if parts[:2] != ["$PPLP", "RES"]:
            return None
        return cls(int(parts[2]), parts[4], parts[5], float(parts[6]), int(parts[9]), float(parts[10]))


class Watched:
    """A sensor whose frames somebody else may look at on their way."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self.last: Frames | None = None

    @property
    def state(self) -> str:
        """The sensor's state."""
        return self._sensor.state

    @property
    def trouble(self) -> SensorError | None:
        """The sensor's trouble."""
        return self._sensor.trouble

    @property
    def identity(self) -> Identity | None:
        """The board's identity."""
        return self._sensor.identity

    @property
    def tally(self) -> Tally:
        """The sensor's counts."""
        return self._sensor.tally

    def read(self) -> Frames:
        """The sensor's frames."""
        frames = self._sensor.read()
        if len(frames):
            self.last = frames
        return frames


@dataclass(slots=True)
class Score:
    """What the demo has seen so far."""

    right: Counter[str] = field(default_factory=Counter)
    total: Counter[str] = field(default_factory=Counter)
    latency_ms: list[float] = field(default_factory=list)

    def add(self, truth: str, answer: Answer) -> bool:
        """Count an answer; True where it names the truth."""
        right = answer.label == truth and answer.status == Status.OK
        self.total[truth] += 1
        self.right[truth] += right
        self.latency_ms.append(answer.latency_ms)
        return right

    def table(self, tally: Tally) -> list[str]:
        """The closing table."""
        names = sorted(self.total)
        rows = [f"  {name:<16}{self.right[name]:>5} /{self.total[name]:>3}" for name in names]
        return [
            "",
            "  material        right / all",
            *rows,
            f"  {'all':<16}{self.right.total():>5} /{self.total.total():>3}",
            "",
            f"  frames lost     {tally.lost_frames} of {tally.frames + tally.lost_frames}",
            f"  latency         {np.median(self.latency_ms):.2f} ms median, {max(self.latency_ms):.2f} ms worst",
        ]


def bar(probability: float) -> str:
    """A probability as a bar."""
    full = round(probability * BAR)
    return "█" * full + "·" * (BAR - full) + f" {probability:6.1%}"


def picture(frames: Frames) -> list[str]:
    """The newest frame [R, C] as shaded cells with their digits, two lines a row."""
    lines = []
    for row in frames.taxels[-1].astype(int):
        level = [min(23, max(0, d) * 24 // BRIGHT) for d in row]
        shade = [f"\033[48;5;{232 + v}m\033[38;5;{16 if v > 11 else 250}m" for v in level]
        lines.append("  " + "".join(f"{s}{'':6}\033[0m" for s in shade))
        lines.append("  " + "".join(f"{s}{d:^6}\033[0m" for s, d in zip(shade, row, strict=True)))
    return lines


class Demo:
    """Steps a box until enough answers were read at the far end of its serial line, and shows what happens.

    played: the acts of the rig's robot, for the truth. far_end: descriptor of the line's other end, non-blocking.
    raw: print the sentences alone.
    """

    def __init__(self, played: Sequence[Act], far_end: int, clock: Clock, out: IO[str], *, raw: bool) -> None:
        self.score = Score()
        self._played, self._clock, self._out = played, clock, out
        self._far_end, self._raw = far_end, raw
        self._live = not raw and out.isatty()
        self._watched: Watched | None = None
        self._rest = b""
        self._drawn = 0
        self._next_ns = 0

    def watch(self, sensor: Sensor) -> Sensor:
        """The sensor, watched: give the box this one."""
        self._watched = Watched(sensor)
        return self._watched

    def run(self, step: Callable[[], object], sweeps: int, stopped: Callable[[], bool]) -> None:
        """Call `step` until `sweeps` were answered or `stopped()`."""
        assert self._watched
        while self.score.total.total() < sweeps and not stopped():
            step()
            self._listen()
            if self._live and self._clock.now_ns() >= self._next_ns and self._watched.last is not None:
                self._next_ns = self._clock.now_ns() + FRAME_NS
                self._draw(["", f"  under the finger: {self._played[-1].label}", "", *picture(self._watched.last), ""])
        if not self._raw and self.score.total:
            self._print(*self.score.table(self._watched.tally))

    def _listen(self) -> None:
        """Read what the box has said at the robot's end of the line."""
        try:
            self._rest += os.read(self._far_end, 65536)
        except BlockingIOError:
            return
        *lines, self._rest = self._rest.split(b"\r\n")
        for line in lines:
            self._hear(line.decode("ascii"))

    def _hear(self, line: str) -> None:
        if self._raw:
            self._print(line)
        answer = Answer.read(line)
        if answer is None:
            return
        truth = self._played[answer.sweep - 1].label
        mark = "right" if self.score.add(truth, answer) else "wrong"
        if not self._raw:
            said = answer.label or answer.status
            self._print(
                f"{answer.sweep:>3}  {truth:<15} -> {said:<15} {mark}  {bar(answer.probability)}", f"     {line}"
            )

    def _draw(self, lines: list[str]) -> None:
        """Paint over the picture before, in one write, so that nothing flickers."""
        self._out.write(self._back() + "".join(f"{line}\033[K\n" for line in lines))
        self._out.flush()
        self._drawn = len(lines)

    def _back(self) -> str:
        """Where the picture begins."""
        drawn, self._drawn = self._drawn, 0
        return f"\033[{drawn}A" if drawn else ""

    def _print(self, *lines: str) -> None:
        erase = "\033[J" if self._drawn else ""
        self._out.write(self._back() + erase + "\n".join(lines) + "\n")
        self._out.flush()
