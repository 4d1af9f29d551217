"""A pseudo-terminal as the serial line: the robot's end, and the name of the box's end."""

from __future__ import annotations

import os
import tty
from collections.abc import Iterator
from contextlib import contextmanager

from palpate.core.errors import PortError


@contextmanager
def pair() -> Iterator[tuple[int, str]]:
    """(far end, a non-blocking descriptor; name of the near end). Both ends are raw, as a serial
    line is. Raises PortError where this system has none."""
    try:
        far, near = os.openpty()
    except OSError as e:
        raise PortError(
            f"no pseudo-terminal for the robot's end of the line: /dev/pts: {e.strerror}; "
            "mount it (mount -t devpts devpts /dev/pts)"
        ) from e
    try:
        tty.setraw(far)
        tty.setraw(near)
        os.set_blocking(far, False)
        yield far, os.ttyname(near)
    finally:
        os.close(far)
        os.close(near)
