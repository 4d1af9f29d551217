"""The simulated robot and readout board on one timeline, and a clock that skips time. Acts (the
frames of a sweep and the positions of its edges) become packets as in PROTOCOL.md and edges, each
at its time.

`usb` presents the readout board to pyusb, `gpio` the edges to the drivers.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterator, MutableSequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.clock import Clock
from palpate.core.types import SweepFormat
from palpate.io import packets
from palpate.sim.gpio import SimGpio

START, STOP, NEW_OBJECT = "START", "STOP", "NEW-OBJECT"
"""The lines that the robot drives."""
PULSE_NS = 20_000_000
"""Length of the robot's pulses."""
SETTLED = 16
"""A finger that follows START begins after this part of a slide: until then the skin creeps."""
WAITING = 2
"""Frames of a lifted finger that are played at once while it waits for START."""
REACTION_NS = 20_000_000
"""Time for which the finger continues to slide after DECIDED has risen."""


class VirtualClock:
    """Time that passes only in `sleep_until`: minutes are simulated at once, reproducibly."""

    def __init__(self, start_ns: int = 1_000_000_000) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until(self, t_ns: int) -> None:
        self._now_ns = max(self._now_ns, t_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Act:
    """One sweep of the robot. frames: raw counts [n, R, C] or [n, R, C, A]. start, stop: frames at
    which its edges come. label: the material. new_object: NEW OBJECT comes with the first frame.
    lifted: frames before the finger touches.

    about: a remark for a person. wanted: the right status; "" for `ok`, or
    `unknown` if the bundle lacks the material. unplugged: frames [from, to) for which the
    skin is unplugged; None for none.
    """

    frames: NDArray[Any]
    start: int
    stop: int
    label: str
    new_object: bool = False
    about: str = ""
    wanted: str = ""
    unplugged: tuple[int, int] | None = None
    lifted: int = 1

    def part(self, of: slice) -> Act:
        return replace(self, frames=self.frames[of])


class Robot:
    """The simulated robot: plays a script of acts and drives start, stop and NEW OBJECT at their
    frames.

    acts: number of acts that it has begun. played: the acts as they were played; without `remember`
    only the newest. skipped: frame numbers [from, to) that were omitted because it stopped early;
    the readout board leaves them out. cable: unplugs the skin at one time, plugs it in at another.
    follows: it waits with a lifted finger for START, then slides until STOP, both by `obey`, and
    drives no lines.
    """

    def __init__(
        self,
        script: Iterator[Act],
        lines: SimGpio,
        *,
        remember: bool = True,
        follows: bool = False,
    ) -> None:
        self.acts = 0
        self._follows, self._sliding, self._lifting = follows, False, False
        self._act: Act | None = None  # the act that waits for START, or slides
        self.played: MutableSequence[Act] = [] if remember else deque(maxlen=1)
        self.finished = False
        self.skipped: tuple[int, int] | None = None
        self.cable: Callable[[int, int], None] | None = None
        self._script, self._lines = script, lines
        self._playing: tuple[Act, int, Callable[[int], int]] | None = None

    def next_act(self, first: int, frame_ns: Callable[[int], int]) -> Act | None:
        """Begin the next act with frame `first`, schedule its edges and return it; None when the
        script has ended. frame_ns: gives the host time at which a frame is taken."""
        if self._follows:
            return self._followed(first, frame_ns)
        act = next(self._script, None)
        if act is None:
            self.finished = True
            return None
        self.acts += 1
        self.played.append(act)
        if act.new_object:
            self._pulse(NEW_OBJECT, frame_ns(first))
        self._pulse(START, frame_ns(first + act.start))
        self._pulse(STOP, frame_ns(first + act.stop))
        if act.unplugged and self.cable:
            self.cable(*(frame_ns(first + i) for i in act.unplugged))
        self._playing = act, first, frame_ns
        return act

    def react(self, t_ns: int) -> None:
        """DECIDED has risen at `t_ns`: end the slide REACTION_NS later, unless it ends before."""
        if not self._playing or self._follows:
            return
        act, first, frame_ns = self._playing
        at = bisect_left(range(act.stop), t_ns + REACTION_NS, key=lambda i: frame_ns(first + i))
        if at == act.stop:
            return
        self._playing = None
        stop_ns = frame_ns(first + at)
        self._lines.forget(STOP, stop_ns)
        self._pulse(STOP, stop_ns)
        self.skipped = first + at, first + act.stop
        if self.played:
            frames = np.delete(act.frames, slice(at, act.stop), axis=0)
            self.played[-1] = replace(act, frames=frames, stop=at)

    def obey(self, t_ns: int, *, start: bool) -> None:
        """START or STOP has come at `t_ns`: a waiting finger slides, or is lifted."""
        if start and not self._sliding:
            self._sliding, self._lifting = True, False
            self._playing = None
        elif not start and self._sliding:
            self._sliding, self._lifting = False, True
            if self._playing:
                act, first, frame_ns = self._playing
                last = len(act.frames)
                at = bisect_left(range(last), t_ns, key=lambda i: frame_ns(first + i))
                self.skipped = (first + at, first + last) if at < last else None

    def _followed(self, first: int, frame_ns: Callable[[int], int]) -> Act | None:
        """The next frames of a finger that follows commands: lifted, a slide, or the end."""
        if self._act is None:
            self._act = next(self._script, None)
            if self._act is None:
                self.finished = True
                return None
        act = self._act
        if self._sliding:
            if not self._playing:
                self.acts += 1
                self.played.append(act)
            settled = act.start + (act.stop - act.start) // SETTLED
            part = act.part(slice(settled, act.stop))  # again, until STOP comes
            self._playing = part, first, frame_ns
            return part
        if self._lifting:
            self._lifting, self._playing, self._act = False, None, None
            return act.part(slice(act.stop, None))
        return act.part(slice(max(1, min(act.lifted, WAITING))))

    def _pulse(self, name: str, at_ns: int) -> None:
        self._lines.drive(name, True, at_ns)
        self._lines.drive(name, False, at_ns + PULSE_NS)


class Film:
    """The frames of a robot's acts, one after the other."""

    def __init__(self, robot: Robot, format: SweepFormat) -> None:
        self._robot = robot
        self._frames = np.zeros((0, *format.shape), format.numpy_type)
        self._base = 0  # number of the first frame in _frames

    def frames(self, first: int, n: int, frame_ns: Callable[[int], int]) -> NDArray[Any]:
        """Frames `first` to `first + n` of the script [n, *shape], requested in order; after its
        end all counts are 0. frame_ns: gives the host time at which a frame is taken, and so the
        times of the edges of an act."""
        if self._robot.skipped:
            begin, end = (i - self._base for i in self._robot.skipped)
            self._frames = np.delete(self._frames, slice(begin, end), axis=0)
            self._robot.skipped = None
        while first + n > self._base + len(self._frames):
            act = self._robot.next_act(self._base + len(self._frames), frame_ns)
            keep = max(0, min(first - self._base, len(self._frames)))
            dark = np.zeros((4096, *self._frames.shape[1:]), self._frames.dtype)
            self._frames = np.concatenate([self._frames[keep:], act.frames if act else dark])
            self._base += keep
        return self._frames[first - self._base :][:n]


class ReadoutBoard:
    """The simulated readout board (PROTOCOL.md): samples the script at its own rate, has a FIFO,
    sends packets.

    packet_frames, fifo_frames: frames per packet and in the FIFO. ppm: error of its crystal.
    latency: draws the time in ns from a packet's last frame to its arrival. first_seq: number of
    its first frame.
    """

    def __init__(
        self,
        format: SweepFormat,
        robot: Robot,
        clock: Clock,
        *,
        packet_frames: int = 6,
        fifo_frames: int = 750,
        ppm: float = 0.0,
        latency: Callable[[], int] = lambda: 150_000,
        serial: str = "SIM0001",
        first_seq: int = 0,
    ) -> None:
        self.identity = packets.Identity(packets.VERSION, (1, 0, 0), "palpate-sim", serial)
        f = format
        self.skin = packets.SkinFormat(
            f.rows, f.cols, f.dtype, f.rate_hz, fifo_frames, packet_frames, f.axes
        )
        self.present = True
        self.running = False
        self._clock, self._latency = clock, latency
        self._rate = 1 + ppm * 1e-6
        self._period_ns = format.period_ns / self._rate
        self._origin_ns = clock.now_ns()
        self._first_seq = first_seq
        self._next = 0  # number of the next frame to send
        # arrival of the packet that begins with this frame, once drawn
        self._arrival_ns: int | None = None
        self._film = Film(robot, format)

    def frame_ns(self, i: int) -> int:
        """Host time at which frame `i` is taken."""
        return self._origin_ns + round((i + 1) * self._period_ns)

    def request(self, request: int) -> bytes | None:
        """The reply to a control request; None if it is unknown."""
        now = int((self._clock.now_ns() - self._origin_ns) / self._period_ns)
        match request:
            case packets.Request.IDENTITY:
                return packets.pack_identity(self.identity)
            case packets.Request.FORMAT:
                return packets.pack_format(self.skin)
            case packets.Request.START:
                if not self.running:
                    self.running, self._next, self._arrival_ns = True, now, None
                return b""
            case packets.Request.STOP:
                self.running = False
                return b""
        return None

    def due_ns(self) -> int | None:
        """Time of the next packet on the bus; None while the board does not send."""
        if not self.running:
            return None
        if self._arrival_ns is None:
            last = self._next + self.skin.packet_frames - 1
            self._arrival_ns = self.frame_ns(last) + self._latency()
        return self._arrival_ns

    def take(self) -> bytes:
        """The packet that is due. If the FIFO has overflowed, the oldest frames are missing."""
        n, fifo = self.skin.packet_frames, self.skin.fifo_frames
        taken = int((self._clock.now_ns() - self._origin_ns) / self._period_ns)
        late = max(0, taken - fifo - self._next)
        first = self._next + late
        self._next, self._arrival_ns = first + n, None
        device_us = round((self.frame_ns(first) - self._origin_ns) * self._rate / 1000)
        flags = packets.Flag.OVERFLOW if late else 0
        frames = self._film.frames(first, n, self.frame_ns)
        return packets.pack(self._first_seq + first, device_us, frames, flags)
