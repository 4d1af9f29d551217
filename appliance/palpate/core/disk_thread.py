"""Work on the disk next to the loop. A sync of a bad card takes seconds, in which frames would be
lost.

`DiskThread` does the work in one thread, in order, from a bounded queue. Its results are given back
in the loop's own thread. `AtOnce` does the same without a thread, for programs that may wait.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import TypeVar

from palpate.core.log import TroubleLog, log
from palpate.core.observer import Health, Observer

Result = TypeVar("Result")
MOST_WAITING = 16
"""Most pieces of work that wait. A sweep's window takes some 100 kB of memory."""
SETTLE_S = 5.0
"""Longest wait for the disk at the end; systemd kills the program after ten seconds."""


def nothing(result: object) -> None:
    """Ignore a result."""


class AtOnce:
    """Does the work in the call, for programs that may wait."""

    def __call__(
        self, work: Callable[[], Result], done: Callable[[Result], object] = nothing
    ) -> bool:
        done(work())
        return True

    def settle(self) -> bool:
        return True


class DiskThread(Observer):
    """Does work in a thread, in order, and gives its result to `done` in the loop's thread. A call
    returns False, and does nothing, if too much work is waiting. As an observer of the loop it
    gives results back in each turn, so it comes before the observers that use it. most: pieces of
    work that may wait. refused: number of pieces that were refused, and so lost."""

    def __init__(self, most: int = MOST_WAITING) -> None:
        self.refused = 0
        self._most, self._open = most, 0  # _open: accepted, and not given back
        self._jobs: deque[Callable[[], None]] = deque()
        self._results: deque[Callable[[], object]] = deque()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        begin, advice = "disk: it is too slow, and sweeps are not kept", "use another card"
        self._log = TroubleLog(begin, advice, end="disk: sweeps are kept again")

    @property
    def text(self) -> str:
        """The loss so far, for a person; "" for none."""
        lost = f"{self.refused} times something was not kept, because the disk is too slow"
        return lost if self.refused else ""

    def __call__(
        self, work: Callable[[], Result], done: Callable[[Result], object] = nothing
    ) -> bool:
        self._give_back()
        if self._open >= self._most:
            self.refused += 1
            self._log.update(f"{self._open} pieces of work are waiting")
            return False
        self._log.update("")
        self._open += 1
        with self._changed:
            self._jobs.append(lambda: self._do(work, done))
            self._changed.notify_all()
        if not self._thread:
            # a daemon: a disk that hangs must not keep the program from ending
            self._thread = threading.Thread(target=self._run, name="disk", daemon=True)
            self._thread.start()
        return True

    def turn(self, health: Health) -> None:
        self._give_back()

    def stopping(self) -> None:
        self.settle()

    def settle(self) -> bool:
        """Wait until all work is done, at most SETTLE_S. Returns whether it is."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._results) == self._open, SETTLE_S)
        self._give_back()
        if self._open:
            late = f"disk: {self._open} pieces of work were not done in {SETTLE_S:g} s"
            log.warning(f"{late}, so the last sweeps may be missing; use another card")
        return not self._open

    def _give_back(self) -> None:
        while self._results:
            give = self._results.popleft()
            self._open -= 1
            give()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs)
                job = self._jobs.popleft()
            job()
            with self._changed:
                self._changed.notify_all()

    def _do(self, work: Callable[[], Result], done: Callable[[Result], object]) -> None:
        try:
            result = work()
        except Exception as e:  # it is raised in the loop's thread, which logs it
            self._results.append(lambda e=e: _throw(e))  # type: ignore[misc]
        else:
            self._results.append(lambda: done(result))


DiskWork = AtOnce | DiskThread


def _throw(e: Exception) -> None:
    raise e
