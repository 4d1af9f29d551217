"""Triggers for the bench and for robots without a spare GPIO line: commands on the serial line, the
space bar of a terminal, or the clock.

The time of an edge is the time at which the command or key was read, or at which the clock was due.
All are less exact than a GPIO line, whose edges the kernel stamps.
"""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import tty
from collections.abc import Callable, Mapping
from functools import partial

from palpate.core.clock import Clock
from palpate.core.config import TriggerConfig
from palpate.core.errors import ApplianceError, ConfigError, PortError
from palpate.core.observer import Health, Observer
from palpate.core.types import Edge, EdgeKind, Verdict
from palpate.io.trigger import EdgeCounters

SECOND = 1_000_000_000
COUNTDOWN = 3
"""Seconds before a timed start from which on each second is announced."""
SPACE = ord(" ")
SLIDE_VALUES = {
    "speed_mm_s": ("speed", "mm/s", 10_000.0, "30.5"),
    "force_n": ("force", "N", 1_000.0, "1.5"),
}
"""The values after START in their order, by the names of Edge's fields: word, unit, largest value,
example. No robot slides as fast or as hard as the largest values; larger ones have another unit."""
MOST_SHOWN = 12
"""Longest excerpt of a bad value in an error message, whose advice must fit into a sentence."""
_NUMBER = re.compile(r"[0-9]+\.?[0-9]*|\.[0-9]+")

Say = Callable[[str], object]
"""Shows a message to a person."""


class LinelessTrigger(Observer):
    """The common part of these triggers: edges are kept for the next turn of the loop, and none is
    lost. It observes the loop. about: for the sidecar of a recorded sweep, as in GpioTrigger."""

    blind = False
    due_ns: int = 0

    def __init__(self, mode: str, times: str) -> None:
        self.edge_counters = EdgeCounters()
        self.about = {"mode": mode, "times": times}
        self._edges: list[Edge] = []

    def edges(self, now_ns: int) -> list[Edge]:
        taken, self._edges = self._edges, []
        return taken


class CommandTrigger(LinelessTrigger):
    """START and STOP as commands on the serial line; `commands` has their handlers. START raises
    ApplianceError as `slide_values` does. told: is called with the time of each, for a simulated
    finger."""

    def __init__(self, clock: Clock, told: Callable[..., None] | None = None) -> None:
        super().__init__("serial", "arrival of the command")
        self._clock, self._told = clock, told
        self.commands: Mapping[str, Callable[[str], list[object]]] = {
            kind.name: partial(self._take, kind) for kind in (EdgeKind.START, EdgeKind.STOP)
        }

    def _take(self, kind: EdgeKind, text: str) -> list[object]:
        edge = Edge(kind, self._clock.now_ns(), **slide_values(text))
        self._edges.append(edge)
        if self._told:
            self._told(edge.t_ns, start=kind is EdgeKind.START)
        return []


def slide_values(text: str) -> dict[str, float]:
    """Speed in mm/s and force in N from the text of START ("30,1.5", ",1.5", ""), by the names of
    Edge's fields. An empty value is left out. Raises ApplianceError for a value that is not
    allowed, or for too many values."""
    values = text.replace(" ", ",").split(",")  # a person may type spaces for commas
    if len(values) > len(SLIDE_VALUES):
        raise ApplianceError(
            f"{len(values)} values are too many; send at most a speed in mm/s and a force in N"
        )
    found = {}
    for value, name in zip(values, SLIDE_VALUES, strict=False):
        if not value:
            continue
        word, unit, most, example = SLIDE_VALUES[name]
        number = float(value) if _NUMBER.fullmatch(value) else 0.0
        if not 0 < number <= most:
            allowed = f"send {unit} above 0 and up to {most:g} such as {example} or leave it empty"
            raise ApplianceError(f"{word} '{value[:MOST_SHOWN]}' is not valid; {allowed}")
        found[name] = number
    return found


class KeyTrigger(LinelessTrigger):
    """The space bar of a terminal starts and stops a sweep. `close` restores the terminal.

    While it is open, keys are not echoed, and Ctrl-\\ and Ctrl-Z do nothing, since both would leave
    the terminal without echo. A sweep that was answered without a stop, for example `long`, is
    over, and the next space starts another. terminal: its file descriptor. Raises ConfigError if it
    is not a terminal, and `edges` raises PortError once it is closed.
    """

    def __init__(self, terminal: int, clock: Clock, say: Say) -> None:
        super().__init__("key", "arrival of the key")
        self._terminal, self._clock, self._say = terminal, clock, say
        self._sweeping, self._started = False, 0
        try:
            self._before = termios.tcgetattr(terminal)
            tty.setcbreak(terminal, termios.TCSANOW)
            changed = termios.tcgetattr(terminal)
            for key in (termios.VQUIT, termios.VSUSP):
                changed[6][key] = os.fpathconf(terminal, "PC_VDISABLE").to_bytes()
            termios.tcsetattr(terminal, termios.TCSANOW, changed)
        except (termios.error, OSError, ValueError) as e:
            raise ConfigError(
                'trigger.mode = "key" needs a terminal as standard input; use "serial" or "timed"'
            ) from e
        say("the space bar starts a sweep and stops it; Ctrl-C ends")

    def edges(self, now_ns: int) -> list[Edge]:
        """START or STOP for each space since the last call."""
        for _ in range(self._keys().count(SPACE)):
            kind = EdgeKind.STOP if self._sweeping else EdgeKind.START
            self._started += kind is EdgeKind.START
            self._sweeping = kind is EdgeKind.START
            self._edges.append(Edge(kind, self._clock.now_ns()))
            self._say(f"{kind}: the space bar stops the sweep" if self._sweeping else str(kind))
        return super().edges(now_ns)

    def answered(self, verdict: Verdict) -> None:
        """Note that a sweep is over."""
        if verdict.sweep == self._started:  # a late answer to an older sweep changes nothing
            self._sweeping = False

    def close(self) -> None:
        try:
            termios.tcsetattr(self._terminal, termios.TCSANOW, self._before)
        except termios.error:
            return

    def _keys(self) -> bytes:
        try:
            if not select.select([self._terminal], [], [], 0)[0]:
                return b""
            keys = os.read(self._terminal, 64)
        except OSError:
            keys = b""
        if not keys:
            raise PortError("the terminal whose space bar is the trigger was closed; start again")
        return keys


class TimedTrigger(LinelessTrigger):
    """Starts a sweep of `sweep_s` every `every_s` and announces it. Raises ConfigError if `every_s`
    is not longer. held: no sweep is started, while the skin sends nothing; afterwards the pause
    before a sweep begins again."""

    def __init__(self, config: TriggerConfig, clock: Clock, say: Say) -> None:
        super().__init__("timed", "clock of the box")
        if config.every_s <= config.sweep_s:
            times = f"a sweep of {config.sweep_s:g} s every {config.every_s:g} s"
            raise ConfigError(f"{times} leaves no pause; let --every be longer than --sweep")
        self._every_ns = round(config.every_s * SECOND)
        self._sweep_ns = round(config.sweep_s * SECOND)
        self._say = say
        self._next_ns = clock.now_ns() + self._every_ns - self._sweep_ns
        self._sweeping, self._announced = False, COUNTDOWN + 1
        self.held = True

    def turn(self, health: Health) -> None:
        self.held = not health.streams

    def edges(self, now_ns: int) -> list[Edge]:
        """START and STOP that are due, with the time at which each was due."""
        if self.held and not self._sweeping:
            self._next_ns, self._announced = now_ns + self._every_ns - self._sweep_ns, COUNTDOWN + 1
            self.due_ns = 0
            return super().edges(now_ns)
        # after a pause of the program, the starts that it missed are left out
        if not self._sweeping and now_ns - self._next_ns > self._every_ns:
            self._next_ns = now_ns
        while now_ns >= self._next_ns:
            kind = EdgeKind.STOP if self._sweeping else EdgeKind.START
            self._edges.append(Edge(kind, self._next_ns))
            self._next_ns += self._every_ns - self._sweep_ns if self._sweeping else self._sweep_ns
            self._sweeping, self._announced = not self._sweeping, COUNTDOWN + 1
            how = f": slide for {self._sweep_ns / 1e9:g} s" if self._sweeping else ""
            self._say(f"{kind}{how}")
        left = -(-(self._next_ns - now_ns) // SECOND)
        if not (self._sweeping or self.held) and left < self._announced:
            self._announced = left
            self._say(f"start in {left} s")
        self.due_ns = self._next_ns
        return super().edges(now_ns)


def standard_input() -> int:
    """The file descriptor of standard input, -1 if there is none."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):  # closed, or replaced by another object
        return -1
