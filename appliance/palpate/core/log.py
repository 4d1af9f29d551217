"""The log of the box, one line for each event, on standard error for a terminal or the journal.

The levels are as in `logging`. systemd's journal gets them as priorities, so `journalctl -p
warning` shows only warnings. If the log cannot be written its lines are lost, but classifying goes
on.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress

from palpate.core.text import printable

log = logging.getLogger("palpate")
"""The only logger of the box."""
log.setLevel(logging.INFO)

EVERY_NS = 10_000_000_000
"""Least time between two lines of a SparseLog."""
PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Levels of `logging` with their priorities of sd-daemon(3); lower levels have 7, debug."""


def in_journal(environ: Mapping[str, str] = os.environ, stream: int = 2) -> bool:
    """Whether a stream (its number) goes straight to the journal, by systemd's JOURNAL_STREAM."""
    try:
        status = os.fstat(stream)
    except OSError:  # closed
        return False
    return environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class LineHandler(logging.Handler):
    """Prints each record as a line, with its priority for the journal, else the program's name."""

    def __init__(self, *, journal: bool) -> None:
        super().__init__()
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record; line breaks in a device's text must not begin another line."""
        line = printable(" ".join(record.getMessage().splitlines()))
        priority = next((n for level, n in PRIORITIES if record.levelno >= level), 7)
        return f"<{priority}>{line}" if self._journal else f"palpate: {line}"

    def emit(self, record: logging.LogRecord) -> None:
        """Print the record; it is lost if the disk behind standard error is full."""
        with suppress(OSError):
            print(self.format(record), file=sys.stderr, flush=True)


class SparseLog:
    """Logs warnings that others can cause as often as they like: at most one every EVERY_NS, with
    the number of those left out. now_ns: the clock."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns, self._next_ns, self._left_out = now_ns, 0, 0

    def warning(self, text: str) -> None:
        now_ns = self._now_ns()
        if now_ns < self._next_ns:
            self._left_out += 1
            return
        more = f" ({self._left_out} more since the last line)" if self._left_out else ""
        log.warning(text + more)
        self._next_ns, self._left_out = now_ns + EVERY_NS, 0


def to_stderr() -> None:
    """Print the log from now on. A second call changes nothing."""
    if not any(isinstance(handler, LineHandler) for handler in log.handlers):
        log.addHandler(LineHandler(journal=in_journal()))


class TroubleLog:
    """Logs a trouble when it begins, changes and ends, but not each time it is seen. The log gets
    `begin: TROUBLE; advice` as a warning, and `end` unless it is "". known: False to log the first
    state even without trouble."""

    def __init__(self, begin: str, advice: str = "", *, end: str = "", known: bool = True) -> None:
        self._begin, self._advice, self._end = begin, advice and f"; {advice}", end
        self._trouble: str | None = "" if known else None

    def update(self, trouble: str, line: str = "") -> None:
        """Log a change. trouble: "" for none now. line: replaces the usual line."""
        if trouble == self._trouble:
            return
        self._trouble = trouble
        if trouble:
            log.warning(line or f"{self._begin}: {trouble}{self._advice}")
        elif line or self._end:
            log.info(line or self._end)

    def attempt(
        self, act: Callable[[], object], errors: tuple[type[Exception], ...] = (OSError,)
    ) -> bool:
        """Do `act`; whether it succeeded. One of `errors` becomes the trouble."""
        try:
            act()
        except errors as e:
            self.update(str(getattr(e, "strerror", None) or e))
            return False
        self.update("")
        return True
