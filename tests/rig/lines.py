"""The robot's ends of the guest's GPIO lines: levels to drive, each at its time, and the levels
that the box drives.

All times are the guest's. The lines are a PL061 of QEMU's machine `virt`: inputs are set and
outputs watched through the qtest socket, and the guest's stock driver sees interrupts.
"""

import heapq
import threading
from collections.abc import Iterable, Sequence
from itertools import count

from tests.rig.guest_clock import GuestClock
from tests.rig.qtest import Qtest

HOLD_NS = 250_000_000
"""A planned level lasts at least this long, however late it came. A busy emulated processor handles
an interrupt long after the edge, and only then reads the level."""


class GuestLines:
    """levels: the level that the box drives, by line name. log: (ns, name, level) of all changes,
    in order, with the time that was read last.

    Can be used as the lines of the rig's robot (palpate.sim.rig.Robot).
    """

    def __init__(self, qtest: Qtest, clock: GuestClock, place: str, names: Sequence[str]) -> None:
        self.levels = dict.fromkeys(names, False)
        self.log: list[tuple[int, str, bool]] = []
        self._names, self._place, self._qtest, self._clock = list(names), place, qtest, clock
        self._plan: list[tuple[int, int, str, bool]] = []
        self._driven_ns: dict[str, int] = {}
        self._order, self._planned, self._closed = count(), threading.Condition(), False
        qtest.changed = self._note
        qtest.ask(f"irq_intercept_out {place}")
        threading.Thread(target=self._drive_as_planned, daemon=True).start()

    def set(self, name: str, level: bool) -> None:
        """Drive an input of the box, now."""
        self.run_through([(name, level)])

    def run_through(self, steps: Iterable[tuple[str, bool]]) -> None:
        """Drive inputs one after another in one write: some tens of us a step."""
        into = f"set_irq_in {self._place} unnamed-gpio-in"
        self._qtest.ask(
            *(f"{into} {self._names.index(name)} {int(level)}" for name, level in steps)
        )

    def drive(self, name: str, level: bool, t_ns: int) -> None:
        """Drive an input at a time, or at once if that has passed."""
        with self._planned:
            heapq.heappush(self._plan, (t_ns, next(self._order), name, level))
            self._planned.notify()

    def forget(self, name: str, t_ns: int) -> None:
        """Cancel the levels of `name` that are planned for `t_ns` and later."""
        with self._planned:
            self._plan = [item for item in self._plan if item[2] != name or item[0] < t_ns]
            heapq.heapify(self._plan)

    def wait(self, name: str, level: bool, timeout_s: float) -> bool:
        """Wait until the box drives an output to `level`; False if it does not in time."""
        return self._clock.until(lambda: self.levels[name] == level, timeout_s)

    def code(self) -> int:
        """The number on the class bits."""
        bits = sorted(name for name in self.levels if name.startswith("CLASS-"))
        return sum(self.levels[name] << i for i, name in enumerate(bits))

    def close(self) -> None:
        """Let go."""
        with self._planned:
            self._closed = True
            self._planned.notify()

    def _note(self, number: int, level: bool) -> None:
        self.levels[self._names[number]] = level
        self.log.append((self._clock.latest_ns, self._names[number], level))

    def _drive_as_planned(self) -> None:
        try:
            while True:
                with self._planned:
                    if self._closed:
                        return
                    left_ns = self._plan[0][0] - self._clock.now_ns() if self._plan else None
                    if left_ns is None or left_ns > 0:
                        # the guest's time is never ahead of the host's: look again at that time
                        self._planned.wait(None if left_ns is None else left_ns / 1e9)
                        continue
                    _, _, name, level = heapq.heappop(self._plan)
                held_ns = self._driven_ns.get(name, -HOLD_NS) + HOLD_NS
                if held_ns > self._clock.now_ns():
                    self.drive(name, level, held_ns)
                    continue
                self.set(name, level)
                self._driven_ns[name] = self._clock.now_ns()
        except OSError:
            return  # QEMU has ended
