"""The virtual box under test: its sentences, the edges that it received, and the resources of its
process.

The skin is on the guest's USB port, the robot drives its lines, and sentences come over its serial
port, as on a real box. Only its use of memory is read inside the guest.
"""

import os
import platform
import re
import tempfile
import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from palpate.io import packets
from palpate.sim import rig, script, skin
from tests.rig import image
from tests.rig.cell import IDLE
from tests.rig.emulated_machines import LOCK
from tests.rig.lines import GuestLines
from tests.rig.machine import Guest
from tests.rig.shell import GuestFailed
from tests.rig.soak_boxes import Gone, Script, process

READY_S = 180
LOCKED = re.compile(r"^onnxruntime==(\S+)", re.M)
SENT = 4096
"""Number of packets whose time of sending is remembered: half a minute, longer than any sentence
takes."""


class SoakRobot:
    """The robot: sweeps without pause as soon as `ready` is set (see sim.rig.Robot). edges_ns:
    times of start edges, and of stop edges.

    The edges of a sweep are planned during the previous sweep, so they are in time however late
    frames are fetched.
    """

    def __init__(self, lines: GuestLines, seed: int) -> None:
        self.skipped = None
        self.ready = threading.Event()
        self.edges_ns: tuple[list[int], list[int]] = ([], [])
        self._lines, self._acts, self._rng = lines, script.tubes(seed), np.random.default_rng(seed)
        self._next: rig.Act | None = None

    def next_act(self, first: int, frame_ns: Callable[[int], int]) -> rig.Act:
        """The next sweep, which begins with frame `first`, or an empty skin."""
        if not self.ready.is_set():
            return rig.Act(skin.idle(IDLE, self._rng), 0, 0, "")
        act = self._next or self._plan(first, frame_ns)
        self._next = self._plan(first + len(act.frames), frame_ns)
        return act

    def _plan(self, first: int, frame_ns: Callable[[int], int]) -> rig.Act:
        act = next(self._acts)
        for line, frame, edges in zip(
            ("START", "STOP"), (act.start, act.stop), self.edges_ns, strict=True
        ):
            at_ns = frame_ns(first + frame)
            self._lines.drive(line, True, at_ns)
            self._lines.drive(line, False, at_ns + rig.PULSE_NS)
            edges.append(at_ns)
        return act


class VirtualBox:
    """A guest that continues from its snapshot, in place of a ThisMachine."""

    name = "virtual box"

    def __init__(self) -> None:
        self._stack, self._heard = ExitStack(), 0
        self._guest: Guest | None = None
        self._sent: deque[tuple[float, int]] = deque(maxlen=SENT)
        self._thrown, self._anew = 0, False

    @staticmethod
    def missing() -> str:
        """Why this box is not available here; "" if it is."""
        return (
            ""
            if image.built()
            else "it has not been built here; python -m tests.campaigns rig builds it"
        )

    def start(self, seed: int, sweeps: Script) -> None:
        """As ThisMachine."""
        made = image.built()
        if not made:
            raise Gone(self.missing())
        folder = self._stack.enter_context(tempfile.TemporaryDirectory())
        try:
            self._guest = self._stack.enter_context(Guest(made, Path(folder), snapshot=True))
            self._guest.ready(READY_S)
            self._pid = self._guest.out("systemctl show -P MainPID palpate")
        except (GuestFailed, OSError) as e:
            raise Gone(str(e)) from e
        self._guest.skin.mangle = self._note
        self._hand = SoakRobot(self._guest.lines, seed)
        self._board = rig.ReadoutBoard(skin.FORMAT, self._hand, self._guest.clock, fifo_frames=2250)
        self._answer = self._board.request
        self._board.request = self._request  # type: ignore[method-assign]
        self._guest.skin.plug(self._board)
        if not self._guest.lines.wait("READY", True, READY_S):
            raise Gone(f"the guest was not READY within {READY_S} s")
        self._hand.ready.set()

    def clock(self) -> float:
        """As ThisMachine; 0 before it has been started."""
        try:
            return self._guest.clock.now_s() if self._guest else 0.0
        except OSError as e:
            raise Gone(f"the guest has ended: {e}") from e

    def heard(self, wait_s: float) -> list[tuple[float, str]]:
        """As ThisMachine."""
        try:
            self._guest.clock.sleep(wait_s)
        except OSError as e:
            raise Gone(f"the guest has ended: {e}") from e
        lines = self._guest.serial.heard[self._heard :]
        self._heard += len(lines)
        return [(t_ns / 1e9, line) for t_ns, line in lines]

    def edges(self, at_s: float) -> tuple[int, int]:
        """As ThisMachine."""
        starts, stops = (bisect_right(edges, at_s * 1e9) for edges in self._hand.edges_ns)
        return starts, stops

    def taken(self, at_s: float) -> float:
        """As ThisMachine; counts frames that have left the board's FIFO, sent or dropped."""
        sent = list(self._sent)
        at = bisect_right(sent, at_s, key=lambda s: s[0])
        return sent[at - 1][1] if at else 0

    def _note(self, packet: bytes) -> bytes:
        """Record the last frame of a packet to the guest; returns the packet."""
        _, _, _, _, _, count, *_, seq, _ = packets.HEADER.unpack_from(packet)
        if self._anew and self._sent:
            # frames from between the box's STOP and its START were not requested
            self._thrown += seq - self._thrown - self._sent[-1][1]
        self._anew = False
        self._sent.append((self.clock(), seq + count - self._thrown))
        return packet

    def _request(self, request: int) -> bytes | None:
        """Record a START; returns the board's answer."""
        self._anew |= request == packets.Request.START and not self._board.running
        return self._answer(request)

    def process(self) -> tuple[int, int, float, int, int]:
        """As ThisMachine."""
        place = f"/proc/{self._pid}"
        try:
            text = self._guest.run(
                f"cat {place}/smaps_rollup {place}/stat && ls {place}/fd | wc -l", check=True
            ).out
        except (GuestFailed, OSError) as e:
            raise Gone(f"the box cannot be looked at: {e}; did it end?") from e
        *_, stat, files = text.strip().splitlines()
        return process(text, stat, int(files))

    def about(self) -> Mapping[str, Any]:
        """As ThisMachine, but of the emulated machine, before the guest runs."""
        return {
            "what": "an arm64 Debian in QEMU; the skin on its USB port, the robot on its lines "
            "and its serial port",
            "machine": f"QEMU {' '.join(image.MACHINE[1:])}, "
            f"on {platform.machine()}, {os.cpu_count()} cores",
            "versions": {
                "debian": image.SUITE,
                "python": image.GUEST_PYTHON,
                "onnxruntime": LOCKED.findall(LOCK.read_text())[0],
            },
        }

    def stop(self) -> list[tuple[float, str]]:
        """As ThisMachine."""
        try:
            self._guest.run("systemctl stop palpate", timeout_s=60, check=True)
        except (GuestFailed, OSError) as e:
            raise Gone(f"the box did not end in order: {e}") from e
        return self.heard(1.0)

    def close(self) -> None:
        """As ThisMachine."""
        self._stack.close()
