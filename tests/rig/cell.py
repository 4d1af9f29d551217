"""The robot cell around a guest: a robot that sweeps on request, and reads sentences and lines as a
controller does.

It returns the answers of the box, with the material and the times of each touch.
"""

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from palpate.client.answers import Answer
from palpate.core.clock import Clock
from palpate.sim import rig, script, skin
from tests.rig.lines import GuestLines
from tests.rig.machine import Guest

FIFO = 22_500
"""Frames that a board can hold: half a minute, so that the box causes every loss, and never a cable
that was plugged in late."""
IDLE = 75
"""Frames of an empty skin between two sweeps: a tenth of a second."""
BEHIND_NS = 50_000_000
"""A touch begins only while the newest frame of the box is at most this old. Edges follow the
clock: if the box were further behind, edges would overtake the frames and the sweep would be too
short."""
SEEN_S = 20
"""Longest wait until the box reports that the skin is gone."""
BEGUN_S = 60
"""Longest wait for a touch to begin, while a box that was busy catches up with its frames."""
ANSWER_S = 30
"""Longest wait for an answer after the stop edge, in the guest's time like all waits."""


@dataclass(slots=True)
class Touch:
    """One sweep of the robot: times of its edges; `played` once the board has reached it."""

    act: rig.Act
    start: bool = True
    stop: bool = True
    start_ns: int = 0
    stop_ns: int = 0
    played: threading.Event = field(default_factory=threading.Event)


class CellRobot:
    """The script that a board plays: an empty skin, and a touch on request (see sim.rig.Robot)."""

    def __init__(self, lines: GuestLines, clock: Clock, seed: int) -> None:
        self.skipped = None
        self.touches: queue.SimpleQueue[Touch] = queue.SimpleQueue()
        self._lines, self._clock, self._rng = lines, clock, np.random.default_rng(seed)

    def next_act(self, first: int, frame_ns: Callable[[int], int]) -> rig.Act:
        """The next touch with its edges scheduled, or an empty skin."""
        if self.touches.empty() or self._clock.now_ns() - frame_ns(first) > BEHIND_NS:
            return rig.Act(skin.idle(IDLE, self._rng), 0, 0, "")
        touch = self.touches.get_nowait()
        act = touch.act
        touch.start_ns, touch.stop_ns = frame_ns(first + act.start), frame_ns(first + act.stop)
        edges = ("START", touch.start_ns, touch.start), ("STOP", touch.stop_ns, touch.stop)
        for line, t_ns, wanted in edges:
            if wanted:
                self._lines.drive(line, True, t_ns)
                self._lines.drive(line, False, t_ns + rig.PULSE_NS)
        touch.played.set()
        return act


class Cell:
    """A guest with a robot around it. The skin is in the robot's hand, and plugged in by `plug`.

    acts: materials and motions of the sweeps in order; by default the simulator's six tubes, drawn
    from `seed`. packet_frames: frames in a packet of its boards; larger packets save half of the
    emulator's work.
    """

    def __init__(self, machine: Guest, seed: int = 1) -> None:
        self.machine, self.lines, self.serial = machine, machine.lines, machine.serial
        self.cable, self.clock = machine.skin, machine.clock
        self.hand = CellRobot(machine.lines, self.clock, seed)
        self.acts = script.tubes(seed)
        self.packet_frames = 6

    def board(self, **arguments: Any) -> rig.ReadoutBoard:
        """A board in the robot's hand; arguments as of sim.rig.ReadoutBoard."""
        usual = {"fifo_frames": FIFO, "packet_frames": self.packet_frames}
        return rig.ReadoutBoard(skin.FORMAT, self.hand, self.clock, **usual | arguments)

    def plug(self, board: rig.ReadoutBoard | None = None) -> rig.ReadoutBoard:
        """Plug in `board` or a working one; the earlier goes first, with FAULT of a running box."""
        board = board or self.board()
        if self.cable.board:
            self.unplug()
            self.lines.wait("FAULT", True, SEEN_S)
        self.cable.plug(board)
        return board

    def unplug(self) -> None:
        """Pull the skin's cable."""
        self.cable.unplug()

    def until(self, done: Callable[[], object], timeout_s: float, what: str) -> None:
        """Wait until `done()`. Raises AssertionError with `what` and the box's log."""
        if not self.clock.until(done, timeout_s):
            raise AssertionError(f"{what} within {timeout_s} s; the box says: {self.journal()}")

    def until_ready(self, timeout_s: float = 60) -> None:
        """Wait until the box reports READY. Raises AssertionError if it does not."""
        levels = self.lines.levels
        self.until(lambda: levels["READY"] and not levels["FAULT"], timeout_s, "not READY")

    def touch(self, *, start: bool = True, stop: bool = True) -> Touch:
        """Begin a sweep. start, stop: whether the robot sends that edge."""
        touch = Touch(next(self.acts), start, stop)
        self.hand.touches.put(touch)
        return touch

    def sweep(self, timeout_s: float = ANSWER_S) -> tuple[Touch, Answer]:
        """A touch and the box's answer. Raises AssertionError if none comes."""
        since = len(self.serial.heard)
        touch = self.touch()
        self.begun(touch)
        return touch, self.answer(since, timeout_s + 6)

    def begun(self, touch: Touch) -> None:
        """Wait until the board has reached a touch. Raises AssertionError if it does not."""
        self.until(touch.played.is_set, BEGUN_S, "the box has not caught up with the skin")

    def answer(self, since: int, timeout_s: float = ANSWER_S) -> Answer:
        """The first RES sentence from line number `since` on."""
        answer = Answer.read(self.serial.wait_for("$PPLP,RES,", timeout_s, since))
        assert answer
        return answer

    def answers(self, since: int = 0) -> list[Answer]:
        """All RES sentences from line number `since` on."""
        read = (Answer.read(line) for _, line in self.serial.heard[since:])
        return [answer for answer in read if answer]

    def state(self) -> list[str]:
        """The fields of the next STA sentence."""
        since = len(self.serial.heard)
        return self.serial.wait_for("$PPLP,STA,", 30, since).split("*")[0].split(",")[2:]

    def journal(self, lines: int = 15) -> str:
        """The last lines of the service's log."""
        return self.machine.run(f"journalctl -u palpate -n {lines} -o cat --no-pager").out

    def restore(self) -> None:
        """Lines low, cable, port and skin working; wait until the box is READY."""
        for name in ("START", "STOP"):
            self.lines.set(name, False)
        self.cable.mangle, self.cable.slow_s = bytes, 0.0
        self.cable.silent = self.cable.deaf = self.cable.halted = False
        self.serial.deaf = False
        self.plug()
        self.until_ready()

    def wait(self, seconds: float) -> None:
        """Let the guest's time pass."""
        self.clock.sleep(seconds)
