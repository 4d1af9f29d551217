"""Shows Views in a terminal, as a picture that is redrawn or as plain lines.

Nothing depends on colour: five characters and numbers show the load, signs the positions. If the
output is not a terminal, or is a dumb terminal, one line is printed each second.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from typing import Generic, Self, TextIO, TypeVar

from palpate.alignment.view import View, figure
from palpate.core.clock import Clock
from palpate.signal.contact import Point

Shown = TypeVar("Shown")
LINE_NS = 1_000_000_000
"""Time between two plain lines."""
ENTER, LEAVE = "\033[?1049h\033[?25l", "\033[?1049l\033[?25h"
"""Control sequences that change to the alternate screen without a cursor, and back."""
BLOCKS, ASCII = " ░▒▓█◉+┌─┐│└┘", " .:*#@+.-.|''"
"""Signs for five loads, the contact's centre, a trained position and a frame, in UTF-8 and in
ASCII."""
LEFT, TOP, SPARE = 8, 6, 12
"""First column and line of the grid, and the number of lines outside it."""
BOLD, PLAIN = "\033[1m", "\033[0m"
MARKED = "\033[1;7m"
HEAT = (236, 23, 30, 37, 79, 158)
"""Colours of loads in a terminal with 256 colours, from none to the strongest."""


def abilities(out: TextIO) -> tuple[bool, str]:
    """Whether a terminal has 256 colours, and the signs that it can show."""
    signs = BLOCKS if (out.encoding or "").lower().replace("-", "") == "utf8" else ASCII
    return "256" in os.environ.get("TERM", ""), signs


class LiveScreen(ABC, Generic[Shown]):
    """Shows one object after another on `out`, and restores the terminal at the end. Subclasses
    implement `_picture` and `_line`.

    address: of the page, "" without a page. live: `out` is a terminal on which pictures can be
    drawn.
    """

    def __init__(self, out: TextIO, clock: Clock, address: str = "") -> None:
        self._out, self._clock, self._address = out, clock, address
        self._colours, self._signs = abilities(out)
        self.live = out.isatty() and os.environ.get("TERM", "dumb") != "dumb"
        self._next_ns = 0

    def __enter__(self) -> Self:
        self._write(ENTER if self.live else f"page: {self._address}\n" if self._address else "")
        return self

    def __exit__(self, *_: object) -> None:
        self._write(LEAVE if self.live else "")

    def show(self, view: Shown) -> None:
        """Draw `view` over the previous picture, or print a line once a second. One write draws the
        picture, so it does not flicker."""
        if self.live:
            width, height = os.get_terminal_size(self._out.fileno())
            lines = self._picture(view, width or 80, height or 24)
            self._write(
                "\033[H" + "".join(f"{line}\033[K\n" for line in lines[:-1]) + f"{lines[-1]}\033[J"
            )
        elif (now_ns := self._clock.now_ns()) >= self._next_ns:
            self._next_ns = now_ns + LINE_NS
            self._write(self._line(view) + "\n")

    @abstractmethod
    def _picture(self, view: Shown, width: int, height: int) -> list[str]:
        """The lines of `view` for a terminal of this size."""
        ...

    @abstractmethod
    def _line(self, view: Shown) -> str:
        """`view` in one line."""
        ...

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()


class Screen(LiveScreen[View]):
    """Shows Views."""

    def _picture(self, view: View, width: int, height: int) -> list[str]:
        return Canvas(view, self._signs, width, height, self._address).lines(self._colours)

    def _line(self, view: View) -> str:
        return line(view)


def line(view: View) -> str:
    """A View in one line that begins with the message."""
    at = (
        f"  centre row {view.centre[0]:.1f} column {view.centre[1]:.1f} {view.unit}"
        if view.centre
        else ""
    )
    return f"{view.origin and f'{view.origin}  '}{view.message}{at}  ({view.hint})"


class Canvas:
    """A View as characters, each with a style, cut to the size of the terminal."""

    def __init__(self, view: View, signs: str, width: int, height: int, address: str) -> None:
        self._view, self._signs = view, signs
        rows, cols = view.shape
        self._cell = (
            max(1, min(3, (height - SPARE) // rows)),
            max(4, min(8, (width - LEFT) // cols)),
        )
        self._height, self._width = height, width
        self._cells: dict[tuple[int, int], tuple[str, str]] = {}
        self._words(address)
        if view.load:
            self._grid()
            self._positions()

    def lines(self, colours: bool) -> list[str]:
        """The picture, line by line."""
        drawn = []
        for y in range(self._height):
            row = [self._cells.get((y, x), (" ", "")) for x in range(self._width)]
            text, style = "", ""
            for sign, wanted in row:
                wanted = wanted if colours or "38;5" not in wanted else ""
                if wanted != style:
                    text, style = text + PLAIN * bool(style) + wanted, wanted
                text += sign
            drawn.append(text.rstrip() + PLAIN * bool(style))
        return drawn

    def _put(self, y: int, x: int, text: str, style: str = "") -> None:
        for i, sign in enumerate(text):
            self._cells[y, x + i] = sign, style

    def _words(self, address: str) -> None:
        view, (rows, _) = self._view, self._view.shape
        simulated = view.origin and f"   {view.origin}"
        self._put(0, 1, f"palpate align   skin {view.skin}   bundle {view.bundle}{simulated}")
        self._put(2, 1, view.message, BOLD)
        self._put(3, 1, view.hint)
        below = TOP + rows * self._cell[0] + 1
        if view.centre:
            row, col = view.centre
            self._put(
                below, 1, f"centre: row {row:.1f}, column {col:.1f} {view.unit} from taxel 1.1"
            )
        trained = f"   {self._signs[6]} where it was in training" if view.contact else ""
        self._put(below + 1, 1, f"{self._signs[5]} the contact's centre{trained}   Ctrl-C ends")
        self._put(below + 2, 1, address)

    def _grid(self) -> None:
        """Draw a field of characters for the load of each taxel, with the number in its middle, and
        a frame around the grid."""
        (high, wide), view = self._cell, self._view
        left_up, flat, right_up, upright, left_down, right_down = list(self._signs[7:])
        for c in range(view.shape[1]):
            self._put(TOP - 2, LEFT + c * wide, f"{'col ' * (wide > 6)}{c + 1}".center(wide - 1))
        self._put(TOP - 1, LEFT - 1, left_up + flat * (wide * view.shape[1] - 1) + right_up)
        for r, loads in enumerate(view.load):
            top = TOP + r * high
            self._put(top + high // 2, 1, f"row {r + 1}")
            for y in range(high):
                self._put(top + y, LEFT - 1, upright.ljust(wide * view.shape[1]) + upright)
            for c, load in enumerate(loads):
                self._taxel(top, LEFT + c * wide, load)
        self._put(
            TOP + len(view.load) * high,
            LEFT - 1,
            left_down + flat * (wide * view.shape[1] - 1) + right_down,
        )

    def _taxel(self, top: int, left: int, load: float) -> None:
        """Draw one field; the last character of its width is the gap to the next field."""
        (high, wide), share = self._cell, max(0.0, min(1.0, load / self._view.full))
        for y in range(high):
            self._put(
                top + y,
                left,
                self._signs[round(4 * share)] * (wide - 1),
                f"\033[38;5;{HEAT[round(5 * share)]}m",
            )
        number = figure(load, self._view.full, self._view.load_unit)
        if wide >= len(number) + 3:
            number = f" {number} "
        self._put(top + high // 2, left + (wide - 1 - len(number)) // 2, number[: wide - 1])

    def _positions(self) -> None:
        view = self._view
        if view.contact:
            for position in zip(view.contact.rows_mm, view.contact.cols_mm, strict=True):
                self._put(*self._at(position), self._signs[6], BOLD)
        if view.centre:
            y, x = self._at(view.centre)
            self._put(y, x - 1, f"({self._signs[5]})", MARKED)

    def _at(self, point: Point) -> tuple[int, int]:
        """Line and column of a point, at the grid's edge if the point lies outside."""
        pitch = self._view.contact.pitch_mm if self._view.contact else 1.0
        (high, wide), (rows, cols) = self._cell, self._view.shape
        row, col = (point[0] / pitch + 0.5) * high, (point[1] / pitch + 0.5) * wide
        return TOP + int(max(0, min(rows * high - 1, row))), LEFT + int(
            max(0, min(cols * wide - 1, col))
        )
