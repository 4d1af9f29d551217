"""A pseudo-terminal as the serial line: the robot's end, and the name of the box's end."""

from __future__ import annotations

import os
import tty
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def pair() -> Iterator[tuple[int, str]]:
    """(far end, a non-blocking descriptor; name of the near end). Both ends are raw, as a serial
    line is."""
    far, near = os.openpty()
    try:
        tty.setraw(far)
        tty.setraw(near)
        os.set_blocking(far, False)
        yield far, os.ttyname(near)
    finally:
        os.close(far)
        os.close(near)
