"""The guest's own time, seen from outside. In: a counter of the guest's hardware. Out: nanoseconds,
and waits in them.

The guest's time goes by the instructions that its processors have done (`-icount`), or with the
host's while they have nothing to do. So a host that is busy makes the guest slow, but never late:
skin, robot and every wait of a test go by this clock, too. Its counter is WALCLK of an Intel HD
Audio controller that no driver of the guest claims: 24 MHz, 32 bits, read over qtest without the
guest's noticing (High Definition Audio Specification 1.0a, 3.3.22).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from appliance.core.clock import Clock, SystemClock
from tests.rig.qtest import Qtest

SHIFT = 1
"""An instruction takes 2 ** SHIFT ns of the guest's time, however long it takes to emulate: half of
a Raspberry Pi 4."""
TICK_US = 1000
"""QEMU brings its counter up to date at least so often, by a timer; else it stood still while the
guest sleeps."""
STEADY = (
    "-icount",
    f"shift={SHIFT},sleep=on",
    "-netdev",
    "hubport,id=none,hubid=0",
    "-object",
    f"filter-buffer,id=tick,netdev=none,interval={TICK_US}",
)
"""QEMU's arguments; the timer is that of a network filter through which nothing goes."""
SLOT = 10
DEVICE = ("-device", f"intel-hda,addr={SLOT:#x}")
ECAM, WINDOW = 0x40_1000_0000, range(0x1000_0000, 0x3EFF_0000)
"""Of QEMU's `virt`: configuration space of PCI, and where 32-bit cards lie once the kernel has set
them up."""
COMMAND, BAR, WALCLK = 0x04, 0x10, 0x30
HZ, WRAP = 24_000_000, 1 << 32
LOOK_S = 0.01
STILL_S = 120
"""Host time after which a counter that has not moved is taken for dead."""


class GuestClock:
    """A clock as appliance.core.clock.Clock, by a counter of HZ that wraps; read it more often than
    every 179 s.

    latest_ns: the newest reading, for those who may not ask. host: the time by which a dead counter
    is noticed.
    """

    def __init__(self, counter: Callable[[], int], host: Clock | None = None) -> None:
        self.latest_ns = 0
        self._counter, self._host = counter, host or SystemClock()
        self._ticks, self._moved_ns, self._reading = 0, self._host.now_ns(), threading.Lock()

    def now_ns(self) -> int:
        """The guest's time. Raises TimeoutError where it stands still, OSError where QEMU has
        gone."""
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
        """Return at `t_ns` of the guest's time, or at once where that has passed."""
        while (left_ns := t_ns - self.now_ns()) > 0:
            self._host.sleep_until(self._host.now_ns() + left_ns)

    def sleep(self, seconds: float) -> None:
        """Let so much of the guest's time pass."""
        self.sleep_until(self.now_ns() + round(seconds * 1e9))

    def until(self, done: Callable[[], object], timeout_s: float) -> bool:
        """Wait until `done`; False where it is not within so much of the guest's time."""
        end_ns = self.now_ns() + round(timeout_s * 1e9)
        while not done():
            if self.now_ns() >= end_ns:
                return bool(done())
            self._host.sleep_until(self._host.now_ns() + round(LOOK_S * 1e9))
        return True


def find(qtest: Qtest, timeout_s: float) -> GuestClock:
    """The clock of a guest whose kernel has set up its cards, or does so now. Raises TimeoutError
    where it does not."""
    config, end_s = ECAM + (SLOT << 15), time.monotonic() + timeout_s

    def read(address: int) -> int:
        return int(qtest.ask(f"readl {address:#x}")[0], 16)

    while (place := read(config + BAR) & ~0xF) not in WINDOW:
        if time.monotonic() > end_s:
            raise TimeoutError(f"the guest's kernel has set up no card within {timeout_s} s")
        time.sleep(0.1)
    qtest.ask(
        f"writew {config + COMMAND:#x} 0x2"
    )  # it answers reads of its memory; no driver has seen to that
    return GuestClock(lambda: read(place + WALCLK))
