"""Ctrl-C during the imports of a program: it prints one line and ends with exit code 130.

It raises no exception, since extension modules turn an exception during their import into other
errors.
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
