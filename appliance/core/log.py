"""The log of the box: one line an event. In: records of the logger `log`. Out: standard error, for
a terminal or the journal.

The levels are those of `logging`; systemd's journal gets them as priorities, so `journalctl -p
warning` shows warnings alone. A log that cannot be written costs its lines, never the classifying.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress

log = logging.getLogger("palpate")
"""The one logger of the box."""
log.setLevel(logging.INFO)

PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Levels of `logging` from which on a priority holds, as sd-daemon(3) numbers them; below these it
is 7, debug."""


def in_journal(environ: Mapping[str, str] = os.environ, stream: int = 2) -> bool:
    """Whether a stream (its number) goes straight to the journal: systemd names it in
    JOURNAL_STREAM."""
    try:
        status = os.fstat(stream)
    except OSError:  # closed
        return False
    return environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class LineHandler(logging.Handler):
    """Prints each record as one line: with its priority for the journal, behind the program's name
    for a terminal."""

    def __init__(self, *, journal: bool) -> None:
        super().__init__()
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """A device's name for itself may hold line breaks: they begin no line with a priority of
        its own."""
        line = " ".join(record.getMessage().splitlines())
        priority = next((n for level, n in PRIORITIES if record.levelno >= level), 7)
        return f"<{priority}>{line}" if self._journal else f"palpate: {line}"

    def emit(self, record: logging.LogRecord) -> None:
        """Print the record, where the disk behind standard error has room."""
        with suppress(OSError):
            print(self.format(record), file=sys.stderr, flush=True)


def to_stderr() -> None:
    """Have the log printed from now on. A second call changes nothing."""
    if not any(isinstance(handler, LineHandler) for handler in log.handlers):
        log.addHandler(LineHandler(journal=in_journal()))


class TroubleLog:
    """Logs one kind of trouble when it begins, when it becomes another and when it ends, not each
    time it is met.

    Logged are `begin: TROUBLE; advice` as a warning, and `end`, where there is one. known: False
    where the first state is to be logged even if it is no trouble.
    """

    def __init__(self, begin: str, advice: str = "", *, end: str = "", known: bool = True) -> None:
        self._begin, self._advice, self._end = begin, advice and f"; {advice}", end
        self._trouble: str | None = "" if known else None

    def update(self, trouble: str, line: str = "") -> None:
        """Log what has changed. trouble: "" where there is none now. line: what is logged instead
        of the usual line."""
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
        """Do `act`, which may be tried again later; whether it went well. One of `errors` is the
        trouble."""
        try:
            act()
        except errors as e:
            self.update(str(getattr(e, "strerror", None) or e))
            return False
        self.update("")
        return True
