"""The guest's own time, read from outside in nanoseconds, and waits in it.

The guest's time advances with the instructions of its processors (`-icount`), or with the host's
time while the guest is idle. A busy host therefore makes the guest slow, but never late: skin,
robot and every wait of a test use this clock too. The counter is WALCLK of an Intel HD Audio
controller that no driver of the guest claims: 24 MHz, 32 bits. It is read over qtest, unnoticed by
the guest (High Definition Audio Specification 1.0a, 3.3.22).
"""

import threading
import time
from collections.abc import Callable

from palpate.core.clock import Clock, SystemClock
from tests.rig.qtest import Qtest

SHIFT = 1
"""An instruction takes 2 ** SHIFT ns of the guest's time, however long its emulation takes: half
the speed of a Raspberry Pi 4."""
TICK_US = 1000
"""QEMU updates its counter at least this often, by a timer; otherwise the counter would stand still
while the guest sleeps."""
STEADY = (
    "-icount",
    f"shift={SHIFT},sleep=on",
    "-netdev",
    "hubport,id=none,hubid=0",
    "-object",
    f"filter-buffer,id=tick,netdev=none,interval={TICK_US}",
)
"""QEMU's arguments. The timer is that of an unused network filter."""
SLOT = 10
DEVICE = ("-device", f"intel-hda,addr={SLOT:#x}")
ECAM, WINDOW = 0x40_1000_0000, range(0x1000_0000, 0x3EFF_0000)
"""In QEMU's machine `virt`: the configuration space of PCI, and the addresses of 32-bit cards after
the kernel has set them up."""
COMMAND, BAR, WALCLK = 0x04, 0x10, 0x30
HZ, WRAP = 24_000_000, 1 << 32
LOOK_S = 0.01
STILL_S = 120
"""Host time after which a counter that stands still is considered dead."""


class GuestClock:
    """A clock like palpate.core.clock.Clock, from a 32-bit counter with HZ ticks per second. Read
    it at least every 179 s.

    latest_ns: the newest reading, for callers that may not use the socket. host: the clock for
    noticing a dead counter.
    """

    def __init__(self, counter: Callable[[], int], host: Clock | None = None) -> None:
        self.latest_ns = 0
        self._counter, self._host = counter, host or SystemClock()
        self._ticks, self._moved_ns, self._reading = 0, self._host.now_ns(), threading.Lock()

    def now_ns(self) -> int:
        """The guest's time. Raises TimeoutError if it stands still, OSError if QEMU has ended."""
        with self._reading:
            more = (self._counter() - self._ticks) % WRAP
            host_ns = self._host.now_ns()
            if more:
                self._moved_ns = host_ns
            elif host_ns - self._moved_ns > STILL_S * 1_000_000_000:
                raise TimeoutError(
                    f"the guest's clock has stood still for {STILL_S} s; has it crashed?"
                )
            self._ticks += more
            self.latest_ns = self._ticks * 1_000_000_000 // HZ
            return self.latest_ns

    def now_s(self) -> float:
        """The same in seconds."""
        return self.now_ns() / 1e9

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns` of the guest's time, or at once if that has passed."""
        while (left_ns := t_ns - self.now_ns()) > 0:
            self._host.sleep_until(self._host.now_ns() + left_ns)

    def sleep(self, seconds: float) -> None:
        """Wait for this much of the guest's time."""
        self.sleep_until(self.now_ns() + round(seconds * 1e9))

    def until(self, done: Callable[[], object], timeout_s: float) -> bool:
        """Wait until `done`; False if it is not within this much of the guest's time."""
        end_ns = self.now_ns() + round(timeout_s * 1e9)
        while not done():
            if self.now_ns() >= end_ns:
                return bool(done())
            self._host.sleep_until(self._host.now_ns() + round(LOOK_S * 1e9))
        return True


def find(qtest: Qtest, timeout_s: float) -> GuestClock:
    """The clock of a guest whose kernel sets up its cards. Raises TimeoutError."""
    config, end_s = ECAM + (SLOT << 15), time.monotonic() + timeout_s

    def read(address: int) -> int:
        return int(qtest.ask(f"readl {address:#x}")[0], 16)

    while (place := read(config + BAR) & ~0xF) not in WINDOW:
        if time.monotonic() > end_s:
            raise TimeoutError(f"the guest's kernel has set up no card within {timeout_s} s")
        time.sleep(0.1)
    qtest.ask(
        f"writew {config + COMMAND:#x} 0x2"
    )  # enables reads of its memory, because no driver has done so
    return GuestClock(lambda: read(place + WALCLK))
