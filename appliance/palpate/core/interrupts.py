"""Ctrl-C during imports: extension modules turn an exception during their import into other errors.

While a program is imported, Ctrl-C raises nothing; it prints one line and ends with exit code 130.
Where a command imports later, the other error becomes KeyboardInterrupt again.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130
"""Exit code of a program that Ctrl-C has ended, as in a shell."""


@contextmanager
def during_imports(program: str) -> Iterator[None]:
    """Within this block, Ctrl-C ends the process. An ignored SIGINT, as after `nohup`, stays
    ignored."""

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
