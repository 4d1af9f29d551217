"""Shows Views as plain lines of text, one a second, on a terminal or any other output."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TextIO, TypeVar

from palpate.alignment.view import View
from palpate.core.clock import Clock

Shown = TypeVar("Shown")
LINE_NS = 1_000_000_000
"""Time between two lines."""


class LinePrinter(Generic[Shown]):
    """Prints what it is shown on `out`, at most once a second. line: makes the line."""

    def __init__(self, out: TextIO, clock: Clock, line: Callable[[Shown], str]) -> None:
        self._out, self._clock, self._line = out, clock, line
        self._next_ns = 0

    def show(self, view: Shown) -> None:
        """Print `view`, unless a line was printed within the last second."""
        if (now_ns := self._clock.now_ns()) >= self._next_ns:
            self._next_ns = now_ns + LINE_NS
            print(self._line(view), file=self._out, flush=True)


def line(view: View) -> str:
    """A View in one line that begins with the message."""
    at = ""
    if view.centre is not None:
        at = f"  centre row {view.centre[0]:.1f} column {view.centre[1]:.1f} {view.unit}"
    return f"{view.origin and f'{view.origin}  '}{view.message}{at}  ({view.hint})"
