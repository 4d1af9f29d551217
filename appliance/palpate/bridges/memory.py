"""Writes every verdict of the feed into a file of verdicts (client/verdicts.py)."""

from __future__ import annotations

import sqlite3
from collections import deque
from collections.abc import Mapping
from typing import Any

from palpate.bridges.results import KEPT
from palpate.client.feed import Feed
from palpate.client.verdicts import VerdictFile, dated
from palpate.core.clock import Clock
from palpate.core.log import SparseLog

READ_S = 0.5


class MemoryBridge:
    """Takes the verdicts of `feed`, and writes them to `file`; KEPT of them wait for a disk that is
    full or busy. clock: of the feed's time stamps."""

    def __init__(self, feed: Feed, file: VerdictFile, clock: Clock) -> None:
        self._feed, self._file, self._clock = feed, file, clock
        self._waiting: deque[tuple[float, Mapping[str, Any]]] = deque(maxlen=KEPT)
        self._log = SparseLog(clock.now_ns)

    def close(self) -> None:
        self._feed.close()
        self._file.close()

    def work(self) -> None:
        """Wait for a line of the feed for up to READ_S, and write all verdicts that wait."""
        line = self._feed.read(READ_S)
        if line and line["type"] == "lost":
            self._log.warning(f"memory: {line.get('lines')} lines of the feed were lost")
        if line and line["type"] == "verdict":
            try:
                found = dated(line, self._clock.now_ns())
            except (KeyError, TypeError) as e:  # of a later version
                self._log.warning(f"memory: a verdict is left out ({e!r}); update this bridge")
                return
            self._waiting.append(found)
        try:
            while self._waiting:
                self._file.add(*self._waiting[0])
                self._waiting.popleft()
        except sqlite3.OperationalError as e:
            self._log.warning(
                f"memory: {e}; {len(self._waiting)} verdicts wait, make room on the disk"
            )
        except sqlite3.Error as e:
            self._waiting.popleft()
            self._log.warning(f"memory: a verdict is left out ({e}); update this bridge")
