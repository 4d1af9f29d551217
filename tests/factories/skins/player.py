"""A skin on a terminal: plays frames through its wire into a pseudo-terminal, at its own rate or as
fast as they are read.

A link to the near end stands for the plug: it comes and goes.
"""

import contextlib
import fcntl
import os
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from palpate.core.clock import Clock, wait_readable
from tests.factories.skins.wires import Wire

DRIVER_BYTES = 65_536
"""Bytes that the kernel's driver of a real adapter keeps for a slow reader, about; further bytes
are lost."""
MOST_AT_ONCE = 1000
"""Most frames of one step. A computer that is too slow for the skin would otherwise fall behind
more with each step, and a step would never end."""
LOOK_NS = 2_000_000
"""Time between two checks for commands while nothing is due."""


class FrameSource(Protocol):
    """The source of frames, by their numbers."""

    def frame(self, i: int, frame_ns: Callable[[int], int]) -> NDArray[Any]:
        """Raw counts of frame `i`, asked for in order. frame_ns: its time."""
        ...


class Player:
    """Plays a skin. It is plugged in from the beginning, and sends while a program has the terminal
    open.

    path: the link to the terminal. paced: frames come at the wire's rate by `clock`; else as fast
    as they are read. collect_ns: interval at which the adapter passes bytes on (FTDI: 16 ms); 0 at
    once. mangle: changes the bytes, as a bad cable does. paused: the skin sends nothing. frames,
    sent: number of frames and of bytes sent. thrown: bytes that nobody read in time.
    """

    def __init__(
        self,
        wire: Wire,
        source: FrameSource,
        clock: Clock,
        path: Path,
        *,
        paced: bool = True,
        collect_ns: int = 0,
    ) -> None:
        self.wire, self.path = wire, path
        self.mangle: Callable[[bytes], bytes] = lambda data: data
        self.paused = False
        self.frames = self.sent = self.thrown = 0
        self._source, self._clock, self._paced, self._collect_ns = source, clock, paced, collect_ns
        self._next = 0  # number of the next frame
        self._period_ns, self._origin_ns, self._origin = wire.period_ns, clock.now_ns(), 0
        self._far = -1
        self._waiting = b""
        self.plug()

    def plug(self) -> None:
        """A new terminal under the same link. Does nothing if it is plugged in."""
        if self._far >= 0:
            return
        self._far, near = os.openpty()
        tty.setraw(near)
        os.set_blocking(self._far, False)
        self.path.symlink_to(os.ttyname(near))
        os.close(near)  # from now on the far end sees whether a program has it open

    def unplug(self) -> None:
        """Remove the terminal with all bytes in it."""
        if self._far >= 0:
            self.path.unlink()
            os.close(self._far)
            self._far, self._waiting = -1, b""

    close = unplug

    @property
    def opened(self) -> bool:
        """Whether a program has the terminal open."""
        if self._far < 0:
            return False
        watch = select.poll()
        watch.register(self._far, select.POLLHUP)
        return not watch.poll(0)

    def frame_ns(self, i: int) -> int:
        """The time at which frame `i` is taken."""
        return self._origin_ns + round((i - self._origin + 1) * self._period_ns)

    def due_ns(self) -> int:
        """The time of the next bytes; commands are checked at least every LOOK_NS."""
        look = self._clock.now_ns() + LOOK_NS
        if not self.opened or self.paused or not self.wire.streaming:
            return look
        if not self._paced:
            return look - LOOK_NS * (not self._waiting)
        due = self.frame_ns(self._next)
        if self._collect_ns:
            due += -due % self._collect_ns
        return min(due, look)

    def step(self) -> None:
        """Carry out the commands that have come, and send the bytes that are due."""
        if not self.opened:
            self._waiting = b""
            self._skip()
            return
        self._obey()
        if self._period_ns != self.wire.period_ns:
            self._origin_ns, self._origin, self._period_ns = (
                self._clock.now_ns(),
                self._next,
                self.wire.period_ns,
            )
        if self.paused or not self.wire.streaming:
            self._skip()
        elif self._paced:
            self._send_due()
        elif not self._waiting:
            self._send_one(self._next)
        self._flush()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Play until `stopped()`, in a thread or process of its own."""
        while not stopped():
            self.step()
            self._clock.sleep_until(self.due_ns())
            if self._waiting and not self._paced:
                select.select([], [self._far], [], LOOK_NS / 1e9)

    def _taken(self) -> int:
        """Number of the first frame that is not taken yet."""
        return self._first_after(self._clock.now_ns())

    def _first_after(self, t_ns: int) -> int:
        """Number of the first frame after the time `t_ns`."""
        about = self._origin + int((t_ns - self._origin_ns) / self._period_ns)
        return about + (self.frame_ns(about) <= t_ns)

    def _skip(self) -> None:
        """Drop frames while nobody reads."""
        if self._paced:
            self._next = max(self._next, self._taken())

    def _send_due(self) -> None:
        now = self._clock.now_ns()
        until = self._first_after(
            now // self._collect_ns * self._collect_ns if self._collect_ns else now
        )
        if (late := until - self._next - MOST_AT_ONCE) > 0:
            self.wire.skip(late)
            self._next += late
        while self._next < until:
            self._send_one(self._next)

    def _send_one(self, i: int) -> None:
        taxels = self._source.frame(i, self.frame_ns)
        data = self.mangle(self.wire.frame(taxels, (self.frame_ns(i) - self._origin_ns) // 1000))
        self._next = i + 1
        self.frames += 1
        if len(self._waiting) + len(data) > DRIVER_BYTES:
            self._flush()
        room = max(0, DRIVER_BYTES - len(self._waiting))
        self._waiting += data[:room]
        self.thrown += len(data[room:])

    def _obey(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):  # no bytes; closed at this moment
            self._waiting += self.wire.receive(os.read(self._far, 4096))

    def _flush(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):  # full; closed at this moment
            while self._waiting:
                written = os.write(self._far, self._waiting)
                self._waiting, self.sent = self._waiting[written:], self.sent + written


@contextlib.contextmanager
def running(player: Player) -> Iterator[Player]:
    """The player plays in a thread until the block ends."""
    stop = threading.Event()
    thread = threading.Thread(target=player.run, args=(stop.is_set,), daemon=True)
    thread.start()
    try:
        yield player
    finally:
        stop.set()
        thread.join()
        player.close()


DELIVERY_S = 0.1
"""Longest wait until the kernel has passed on the bytes that one end of a terminal wrote."""
SPIN_S = 5e-4
"""Time of this wait without sleeping."""
PORT_BYTES = 4000
"""Most bytes in the near end of a terminal before it is read (4096 less the last line's end)."""


class PlayerClock:
    """A clock whose waits play `skin`, so that no bytes are missed meanwhile."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.player: Player | None = None

    def now_ns(self) -> int:
        """The time of the underlying clock."""
        return self._clock.now_ns()

    def sleep_until(self, t_ns: int) -> None:
        """Sleep, and send the bytes of the skin that become due."""
        self._clock.sleep_until(t_ns)
        if self.player:
            self.player.step()

    def wait_readable(self, fd: int, timeout_s: float) -> bool:
        """Devices.wait: let time pass until the skin has sent bytes, at most `timeout_s`."""
        assert self.player, "no skin is played"
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            sent = self.player.sent
            self.player.step()
            if _wait_for_bytes(fd, self.player.sent - sent):
                return True
            if self._clock.now_ns() >= until_ns:
                return False
            self._clock.sleep_until(min(until_ns, self.player.due_ns()))


def _wait_for_bytes(fd: int, sent: int) -> bool:
    """Whether bytes can be read once the kernel has delivered those sent; at once if none."""
    if not sent:
        return wait_readable(fd, 0)
    begin = time.monotonic()
    while (waited := time.monotonic() - begin) < DELIVERY_S and (held := _held(fd)) < min(
        sent, PORT_BYTES
    ):
        # it usually takes some 10 us; a sleeping thread on a busy machine wakes much later
        if waited > SPIN_S:
            time.sleep(1e-4) if held else wait_readable(fd, DELIVERY_S)
    return wait_readable(fd, 0)


def _held(fd: int) -> int:
    """Bytes that can be read from a terminal now."""
    return int.from_bytes(fcntl.ioctl(fd, termios.FIONREAD, bytes(4)), sys.byteorder)
