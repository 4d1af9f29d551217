"""Hands a box without a bundle over to the page of teaching: palpate-teach.path of systemd waits
for a file, and starts the page, which takes the skin."""

from __future__ import annotations

from pathlib import Path

from palpate.core import storage
from palpate.core.clock import Clock
from palpate.core.health import Health
from palpate.core.log import log
from palpate.core.observer import Observer

FILE = "untaught"
"""In the folder of the status file; the unit names it."""
AFTER_NS = 20_000_000_000
"""Time until then. An installation or a delivery waits up to 10 s to see the service run; its end
for the sake of the page would look like a failure."""


class HandOver(Observer):
    """Writes the file in `folder` once, between two sweeps. clock: the real clock."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._path, self._clock = folder / FILE, clock
        self._at_ns: int | None = clock.now_ns() + AFTER_NS

    def turn(self, health: Health) -> None:
        """Write it if it is time. A failure is logged: the robot can teach the box all the same."""
        if self._at_ns is None or health.sweeping or self._clock.now_ns() < self._at_ns:
            return
        self._at_ns = None
        try:
            storage.put(self._path, b"")
        except OSError as e:
            log.warning(f"teach: no page by itself: {self._path}: {e.strerror}")
