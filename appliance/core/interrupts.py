"""Ctrl-C while a program still imports what it needs. In: SIGINT. Out: one line on standard error,
exit code 130.

No exception is raised for it: extension modules that are being imported make other errors of one.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130
"""Exit code of a program that Ctrl-C has ended, as a shell has it."""


@contextmanager
def during_imports(program: str) -> Iterator[None]:
    """Within this block, Ctrl-C ends the process. One that is ignored, as after `nohup`, stays
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
