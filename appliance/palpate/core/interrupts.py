"""Signals that end a program: SIGTERM and Ctrl-C in a loop, and Ctrl-C during imports, where
extension modules turn an exception into other errors.

While a program is imported, Ctrl-C raises nothing; it prints one line and ends with exit code 130.
Where a command imports later, the other error becomes KeyboardInterrupt again.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from palpate.core.errors import INTERRUPTED as INTERRUPTED


@contextmanager
def during_imports(program: str) -> Iterator[None]:
    """Within this block, Ctrl-C ends the process; an ignored SIGINT stays ignored."""

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, f"{program}: interrupted before anything was done\n".encode())
        os._exit(INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before in (signal.SIG_IGN, None):
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def during_work() -> Iterator[None]:
    """Within this block, Ctrl-C raises KeyboardInterrupt, whatever a library makes of it."""
    came: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(number)
        signal.default_int_handler(number, frame)

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    except Exception as e:
        if came:
            raise KeyboardInterrupt from e
        raise
    finally:
        signal.signal(signal.SIGINT, before)


class StopFlag:
    """A function that is true once SIGTERM or SIGINT came. The loop then ends within one turn."""

    def __init__(self) -> None:
        self._received: list[int] = []
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda n, frame: self._received.append(n))

    def __call__(self) -> bool:
        return bool(self._received)

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, otherwise 0: SIGTERM ends a service in order."""
        return INTERRUPTED if self._received[:1] == [signal.SIGINT] else 0
