"""The robot's end of the serial line: a pseudo-terminal. Out: a non-blocking descriptor and the
name the box opens."""

from __future__ import annotations

import os
import tty
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def pair() -> Iterator[tuple[int, str]]:
    """(far end, name of the near end); both ends are raw, as a serial line is."""
    far, near = os.openpty()
    try:
        tty.setraw(far)
        tty.setraw(near)
        os.set_blocking(far, False)
        yield far, os.ttyname(near)
    finally:
        os.close(far)
        os.close(near)
