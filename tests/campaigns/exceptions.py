"""Throws an exception at every call that the loop makes, and counts the answers to the triggers.

The box runs on simulated devices in virtual time: sweeps by GPIO lines, with early answers, and by
commands. Proxies stand before all parts of the loop, and one of their calls raises instead of being
carried out. Each trigger must have exactly one answer, and a fault of the model or of an observer
must not end the program: `python -m tests.campaigns exceptions`.
"""

import argparse
import logging
import re
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from palpate.bundle import bundle
from palpate.core import config
from palpate.core.errors import ApplianceError, LineError, ModelError, SensorError
from palpate.core.log import log
from palpate.core.observer import Observer
from palpate.core.types import Edge, EdgeKind, Status
from palpate.io.robot_link import Command
from palpate.runtime import assembly
from palpate.runtime.loop import FAILURES, Box
from palpate.sim import devices, rig, skin
from tests.factories.paths import NO_SITE

ERRORS = (RuntimeError, MemoryError, OSError, ModelError, LineError, SensorError, ValueError)
PACKET = 64
SCENES = ("lines", "early", "commands")
SLIDE_S, PAUSE_S, END_S = 2.6, 0.4, 8.5
SURVIVES = re.compile(r"answerer|early|observer\..*")
"""Calls whose unexpected errors must not end the program."""
LASTING = re.compile(
    r"answerer|early|observer\..*|sensor\.read|trigger\.edges|lines\..*|port\.(?!say).*"
)
"""Calls that may fail again and again: devices, models, observers. Others only compute."""


class Planned(Exception):
    """Raised by no call: the number of the throwing call lies beyond the last."""


@dataclass(slots=True)
class ThrowingCalls:
    """Counts the calls to all parts of a loop; call number `at` raises `error`, and with `lasting`
    each later call of the same method, too. thrown: the method that raised, "" before."""

    at: int
    error: type[Exception] = Planned
    lasting: bool = False
    count: int = 0
    thrown: str = ""
    made: list[str] = field(default_factory=list)

    def enter(self, name: str) -> None:
        """A call begins."""
        self.count += 1
        self.made.append(name)
        if self.count == self.at or (self.lasting and name == self.thrown):
            self.thrown = name
            raise self.error(f"thrown at call {self.count}, {name}")


class ThrowingPart:
    """Stands before a part of the loop."""

    def __init__(self, part: Any, name: str, calls: ThrowingCalls) -> None:
        self._part, self._name, self._calls = part, name, calls

    def __getattr__(self, name: str) -> Any:
        if isinstance(getattr(type(self._part), name, None), property):
            self._calls.enter(f"{self._name}.{name}")
        value = getattr(self._part, name)
        if not callable(value):
            return value

        def call(*args: Any, **more: Any) -> Any:
            self._calls.enter(f"{self._name}.{name}")
            return value(*args, **more)

        return call

    def __call__(self, *args: Any) -> Any:
        self._calls.enter(self._name)
        return self._part(*args)


def throwing_observer(calls: ThrowingCalls) -> Observer:
    """An observer whose calls are counted."""

    def counted(name: str) -> Callable[..., None]:
        return lambda self, *args: calls.enter(f"observer.{name}")

    names = [name for name in vars(Observer) if not name.startswith("_")]
    made = type("ThrowingObserver", (Observer,), {name: counted(name) for name in names})
    return cast(Observer, made())


class EdgeLog:
    """A trigger that notes the edges that it has reported."""

    def __init__(self, trigger: Any) -> None:
        self._trigger, self.reported = trigger, list[Edge]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._trigger, name)

    @property
    def blind(self) -> bool:
        """As the trigger."""
        return bool(self._trigger.blind)

    def edges(self, now_ns: int) -> list[Edge]:
        """As the trigger."""
        edges: list[Edge] = self._trigger.edges(now_ns)
        self.reported += edges
        return edges


class RobotPort:
    """The robot's end of the serial line. answers: number and status of each RES."""

    name, dropped, trouble = "robot", 0, ""

    def __init__(self, clock: rig.VirtualClock, asks: list[tuple[float, str]]) -> None:
        self._clock, self._asks = clock, deque(asks)
        self.answers: list[tuple[int, str]] = []

    def say(self, line: bytes) -> None:
        """Note an answer; other sentences do not matter."""
        _, kind, number, _, status, *_ = [*line.decode().split(","), "", "", ""]
        if kind == "RES":
            self.answers.append((int(number), status))

    def commands(self) -> list[Command]:
        """The commands that are due."""
        due = []
        while self._asks and self._clock.now_ns() >= self._asks[0][0] * 1e9:
            due.append(Command(self._asks.popleft()[1]))
        return due

    def close(self) -> None:
        """Nothing to close."""


@dataclass(frozen=True, slots=True)
class PlayedScene:
    """A run: the call that raised, the expected number of answers, the answers, the end."""

    thrown: str
    triggers: int
    answers: list[tuple[int, str]]
    ended: BaseException | None
    error: type[Exception]

    def faults(self) -> Iterator[str]:
        """The faults of the answers."""
        numbers = [number for number, _ in self.answers]
        if numbers != sorted(set(numbers)) or len(numbers) != self.triggers:
            yield f"{self.triggers} triggers, answers {self.answers}"
        expected = issubclass(self.error, ApplianceError) and self.thrown.startswith("observer")
        failed = sum(status == Status.FAILED for _, status in self.answers)
        expected |= isinstance(self.ended, ModelError) and failed >= FAILURES
        if SURVIVES.fullmatch(self.thrown) and self.ended and not expected:
            yield f"the program ended: {self.ended!r}"


def answers_due(edges: list[Edge]) -> int:
    """Number of answers that a robot must get for these edges."""
    due, opened = 0, False
    for edge in edges:
        due += edge.kind is EdgeKind.START or (edge.kind is EdgeKind.STOP and not opened)
        opened = edge.kind is EdgeKind.START
    return due


def _devices(scene: str) -> tuple[devices.SimDevices, list[tuple[float, str]]]:
    """The simulated cell of a scene, and the commands of the robot with their times in s."""
    slide, pause = round(SLIDE_S * skin.FORMAT.rate_hz), round(PAUSE_S * skin.FORMAT.rate_hz)
    place, off = skin.placements("T-LAB", 3)[0], np.zeros((pause, 4, 4), np.uint8)
    acts = []
    for number, label in enumerate(("wood", "metal")):
        generator = np.random.default_rng(number)
        touched = skin.sweep(label, place, generator, rest_s=0, slide_s=SLIDE_S, after_s=0)
        frames = np.concatenate([off, touched, off])
        edges = (10**7, 10**7 + 1) if scene == "commands" else (pause, pause + slide)
        acts.append(rig.Act(frames, *edges, label))
    simulated = devices.build(skin.FORMAT, acts, rig.VirtualClock(), "sim", stops=False)
    simulated.backend.board = rig.ReadoutBoard(
        skin.FORMAT, simulated.robot, simulated.clock, packet_frames=PACKET
    )
    if scene != "commands":
        for name, at_s in ((devices.STOP, 7.9), (devices.START, 8.3)):
            for level in (True, False):
                at_ns = round((at_s + (not level) * 0.02) * 1e9)
                simulated.gpio.drive(name, level, at_ns)
        return simulated, [(7.8, "NEW"), (8.4, "ID")]
    asks = [(1.5, "START"), (4.2, "STOP"), (4.5, "START"), (4.8, "START"), (7.7, "STOP")]
    return simulated, [*asks, (7.8, "STOP"), (8.2, "START"), (8.2, "TARE")]


def play(scene: str, model: bundle.Bundle, calls: ThrowingCalls) -> PlayedScene:
    """Play a scene until END_S, or until the exception ends it."""
    simulated, asks = _devices(scene)
    sets = [f"classifier.early={str(scene == 'early').lower()}"]
    sets += ["trigger.mode=serial"] if scene == "commands" else []
    settings = config.load(None, sets, site=NO_SITE)
    port = RobotPort(simulated.clock, asks)
    ended: BaseException | None = None
    with ExitStack() as stack:
        box = assembly.box(
            settings, model, simulated, port, stack, observers=[throwing_observer(calls)]
        )
        edges = _stand_before(box, calls)
        try:
            box.run(lambda: simulated.clock.now_ns() > END_S * 1e9)
        except Exception as e:
            ended = e
    return PlayedScene(calls.thrown, answers_due(edges.reported), port.answers, ended, calls.error)


def _stand_before(box: Box, calls: ThrowingCalls) -> EdgeLog:
    """Put proxies before the parts of a box; its trigger, which notes its edges."""
    edges = EdgeLog(box._trigger)
    parts = {"sensor": box._sensor, "trigger": edges, "cutter": box._cutter, "port": box._port}
    parts |= {"answerer": box._answerer, "lines": box._lines, "clock": box._clock}
    parts |= {"early": box._early} if box._early else {}
    for name, part in parts.items():
        setattr(box, f"_{name}", ThrowingPart(part, name, calls))
    return edges


def sound(played: PlayedScene) -> None:
    """Fail if the scene goes wrong without any exception."""
    statuses = [Status(status) for _, status in played.answers]
    assert not played.ended
    assert not list(played.faults()), played
    assert sum(status.classified or status is Status.UNKNOWN for status in statuses) >= 1, statuses


def campaign(
    scene: str, every: int, *, lasting: bool, report: Callable[[str], object] = print
) -> tuple[int, int]:
    """The runs, and those with a fault; throws at each `every`-th call. lasting: from then on."""
    model = bundle.load(bundle.DEFAULT)
    calls = ThrowingCalls(at=0)
    sound(play(scene, model, calls))
    runs = wrong = 0
    for at in range(1, calls.count + 1, every):
        if lasting and not LASTING.fullmatch(calls.made[at - 1]):
            continue
        thrown = ThrowingCalls(at, ERRORS[at // every % len(ERRORS)], lasting)
        played = play(scene, model, thrown)
        runs += 1
        for fault in played.faults():
            wrong += 1
            report(f"{scene}: {thrown.error.__name__} at call {at}, {played.thrown}: {fault}")
    return runs, wrong


def main() -> None:
    """Print the count of each scene; the exit code is 1 if any answer is wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns exceptions")
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    parser.add_argument("--every", type=int, default=1, help="throw at each N-th call only")
    options = parser.parse_args()
    log.setLevel(logging.CRITICAL)
    total = 0
    for scene in options.scenes:
        for lasting in (False, True):
            runs, wrong = campaign(scene, options.every, lasting=lasting)
            how = "from a call on" if lasting else "at a call"
            print(f"{scene}, exception {how}: {runs} runs, wrong {wrong}", flush=True)
            total += wrong
    sys.exit(1 if total else 0)


if __name__ == "__main__":
    main()
