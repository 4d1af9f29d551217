"""The robot's ends of the guest's GPIO lines. In: levels to drive, each at its time. Out: what the box drives, with times.

A PL061 of QEMU's `virt` machine: inputs are set and outputs watched through the qtest socket, and the guest's stock
driver sees interrupts.
"""

from __future__ import annotations

import heapq
import queue
import socket
import threading
import time
from collections.abc import Iterable, Sequence
from itertools import count

ANSWER_S = 20
HOLD_NS = 250_000_000
"""A level that was planned is held at least so long, however late it came: an emulated processor that is busy takes an
interrupt long after the edge, and looks at the level only then.
"""


class GuestLines:
    """levels: line name -> what the box drives it to. log: (host ns, name, level) of all changes, in order.

    Fits where the rig's robot drives its edges (appliance.sim.rig.EdgeLines).
    """

    def __init__(self, qtest: socket.socket, place: str, names: Sequence[str]) -> None:
        self.levels = dict.fromkeys(names, False)
        self.log: list[tuple[int, str, bool]] = []
        self._names, self._place, self._qtest = list(names), place, qtest
        self._answers: queue.Queue[str] = queue.Queue()
        self._changed, self._asking = threading.Condition(), threading.Lock()
        self._plan: list[tuple[int, int, str, bool]] = []
        self._driven_ns: dict[str, int] = {}
        self._order, self._planned, self._closed = count(), threading.Condition(), False
        threading.Thread(target=self._listen, daemon=True).start()
        threading.Thread(target=self._drive_as_planned, daemon=True).start()
        self._ask(f"irq_intercept_out {place}")

    def set(self, name: str, level: bool) -> None:
        """Drive an input of the box, now."""
        self.run_through([(name, level)])

    def run_through(self, steps: Iterable[tuple[str, bool]]) -> None:
        """Drive inputs one after the other, in one write to QEMU: some tens of microseconds from step to step."""
        into = f"set_irq_in {self._place} unnamed-gpio-in"
        self._ask(*(f"{into} {self._names.index(name)} {int(level)}" for name, level in steps))

    def drive(self, name: str, level: bool, t_ns: int) -> None:
        """Drive an input at a host time, or at once where that has passed."""
        with self._planned:
            heapq.heappush(self._plan, (t_ns, next(self._order), name, level))
            self._planned.notify()

    def forget(self, name: str, t_ns: int) -> None:
        """Take back what `name` was to be set to at `t_ns` and later."""
        with self._planned:
            self._plan = [item for item in self._plan if item[2] != name or item[0] < t_ns]
            heapq.heapify(self._plan)

    def wait(self, name: str, level: bool, timeout_s: float) -> bool:
        """Wait until the box drives an output to `level`; False where it does not in time."""
        with self._changed:
            return self._changed.wait_for(lambda: self.levels[name] == level, timeout_s)

    def code(self) -> int:
        """What the class bits say now."""
        bits = sorted(name for name in self.levels if name.startswith("CLASS-"))
        return sum(self.levels[name] << i for i, name in enumerate(bits))

    def close(self) -> None:
        """Let go."""
        with self._planned:
            self._closed = True
            self._planned.notify()
        self._qtest.close()

    def _ask(self, *lines: str) -> None:
        with self._asking:
            self._qtest.sendall("".join(f"{line}\n" for line in lines).encode())
            answers = [self._answers.get(timeout=ANSWER_S) for _ in lines]
        for line, answer in zip(lines, answers, strict=True):
            if not answer.startswith("OK"):
                raise RuntimeError(f"qtest: {line}: {answer}")

    def _listen(self) -> None:
        try:
            for line in self._qtest.makefile():
                word, *rest = line.split()
                if word != "IRQ":
                    self._answers.put(line.strip())
                    continue
                t_ns, name, level = time.monotonic_ns(), self._names[int(rest[1])], rest[0] == "raise"
                with self._changed:
                    self.levels[name] = level
                    self.log.append((t_ns, name, level))
                    self._changed.notify_all()
        except OSError:
            return  # closed

    def _drive_as_planned(self) -> None:
        while True:
            with self._planned:
                wait_s = (self._plan[0][0] - time.monotonic_ns()) / 1e9 if self._plan else None
                if wait_s is None or wait_s > 0:
                    self._planned.wait(wait_s)
                if self._closed:
                    return
                if not self._plan or self._plan[0][0] > time.monotonic_ns():
                    continue
                _, _, name, level = heapq.heappop(self._plan)
            held_ns = self._driven_ns.get(name, 0) + HOLD_NS
            if held_ns > time.monotonic_ns():
                self.drive(name, level, held_ns)
                continue
            try:
                self.set(name, level)
            except (OSError, queue.Empty):
                return  # the guest has gone
            self._driven_ns[name] = time.monotonic_ns()
