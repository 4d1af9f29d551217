"""Reads a program on a terminal; a failure has its text and kills the process."""

import os
import select
import subprocess
import time
from collections.abc import Callable
from typing import Any

LIMIT_S = 120
"""Far above the run time of these programs, also on a very busy machine."""


def read(
    far: int,
    run: subprocess.Popen[Any],
    done: Callable[[bytes], object] = lambda shown: False,
    limit_s: float = LIMIT_S,
) -> bytes:
    """The text of a program until `done`, or until it has closed the terminal."""
    shown, end_s = b"", time.monotonic() + limit_s
    while not done(shown):
        if not select.select([far], [], [], max(0.0, end_s - time.monotonic()))[0]:
            run.kill()
            run.wait()
            raise AssertionError(
                f"the program was not done within {limit_s} s; it has shown {shown[-3000:]!r}"
            )
        try:
            more = os.read(far, 65536)
        except OSError:  # Linux's end of file, after the last writer has closed
            return shown
        if not more:
            return shown
        shown += more
    return shown


def ended(run: subprocess.Popen[Any], shown: bytes) -> int:
    """The exit code of a program that should end now."""
    try:
        return run.wait(timeout=LIMIT_S)
    except subprocess.TimeoutExpired as e:
        run.kill()
        run.wait()
        raise AssertionError(
            f"the program did not end within {LIMIT_S} s; it has shown {shown[-3000:]!r}"
        ) from e
