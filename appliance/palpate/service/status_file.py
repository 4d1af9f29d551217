"""Writes the state of the box and its last verdicts as a small JSON file, for `palpate status`.

The file is in memory (/run). It is written aside and renamed, so that a reader always gets a whole
file, and never synced.
"""

from __future__ import annotations

import json
import os
from collections import deque
from pathlib import Path
from typing import Any

from palpate import __version__
from palpate.core import storage
from palpate.core.clock import Clock
from palpate.core.log import TroubleLog
from palpate.core.observer import Facts, Health, Observer
from palpate.core.types import Verdict
from palpate.service.status import SCHEMA, VERDICTS

PERIOD_NS = 1_000_000_000
SOON_NS = 100_000_000
"""Least time between two writes if there is a new verdict or state of the skin."""


class Report:
    """The state of the box as an object for JSON, in the status file and in the feed.

    clock: the real clock of the host, which a reader in another process shares. facts: `lines`
    shows each text among them as a line of its own, unless it is empty.
    """

    def __init__(self, clock: Clock, facts: Facts) -> None:
        self._clock, self._facts = clock, facts
        self._since_ns = clock.now_ns()

    def __call__(self, health: Health) -> dict[str, Any]:
        return {
            **{name: fact() for name, fact in self._facts.items()},
            **health._asdict(),
            "time_ns": self._clock.now_ns(),
            "since_ns": self._since_ns,
            "pid": os.getpid(),
            "version": __version__,
        }


class StatusFile(Observer):
    """Writes the state of the box and its latest answers. The file is removed when the program ends
    in order.

    clock, facts: as for Report.
    """

    def __init__(self, path: Path, clock: Clock, facts: Facts) -> None:
        self._path, self._clock, self._report = path, clock, Report(clock, facts)
        self._next_ns = clock.now_ns()
        self._verdicts: deque[dict[str, Any]] = deque(maxlen=VERDICTS)
        self._fresh, self._skin = False, ""
        self._log = TroubleLog(f"status: {path} cannot be written", "classifying goes on")

    def answered(self, verdict: Verdict) -> None:
        """Note a verdict; it is written at the end of the turn."""
        self._verdicts.append(verdict.as_dict(arrays=False))
        self._fresh = True

    def turn(self, health: Health) -> None:
        """Write once a second, and soon after a verdict or a new state of the skin."""
        now_ns = self._clock.now_ns()
        if health.skin != self._skin:
            self._skin, self._fresh = health.skin, True
        if now_ns < self._next_ns - (PERIOD_NS - SOON_NS if self._fresh else 0):
            return
        self._next_ns, self._fresh = now_ns + PERIOD_NS, False
        report = self._report(health) | {"schema": SCHEMA, "verdicts": list(self._verdicts)}
        # every user of the box may read it; it is in memory (/run), so a card does not wear from a
        # sync a second
        self._log.attempt(
            lambda: storage.put(self._path, json.dumps(report).encode(), durable=False, mode=0o644)
        )

    def stopping(self) -> None:
        """Remove the file, which is not true any more."""
        self._log.attempt(lambda: self._path.unlink(missing_ok=True))
