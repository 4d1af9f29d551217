"""The log of the box while a block runs, warnings after `<4>` as in the journal."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from palpate.core.log import log


class LineCollector(logging.Handler):
    """Appends each record to `lines`."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__()
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.append("<4>" * (record.levelno >= logging.WARNING) + record.getMessage())


@contextmanager
def collected() -> Iterator[list[str]]:
    """The lines that the block logs."""
    lines: list[str] = []
    handler = LineCollector(lines)
    log.addHandler(handler)
    try:
        yield lines
    finally:
        log.removeHandler(handler)
