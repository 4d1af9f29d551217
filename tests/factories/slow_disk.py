"""Disks of tests: one that writes when a test says so, and one without room."""

import errno
from collections.abc import Callable
from typing import Any

from palpate.core.observer import Observer


def full(*given: object) -> None:
    """A disk without room."""
    raise OSError(errno.ENOSPC, "No space left on device")


class SlowDisk(Observer):
    """Work on the disk that waits for `settle`, or for the end of the loop."""

    def __init__(self) -> None:
        self._work: list[tuple[Callable[[], Any], Callable[[Any], object]]] = []

    def __call__(
        self, work: Callable[[], Any], done: Callable[[Any], object] = lambda result: None
    ) -> bool:
        self._work.append((work, done))
        return True

    def settle(self) -> bool:
        """Write all."""
        while self._work:
            work, done = self._work.pop(0)
            done(work())
        return True

    def stopping(self) -> None:
        self.settle()
