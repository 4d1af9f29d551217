"""The View, the picture of `palpate skin align` at one moment; its displays' interface; and the
display that prints a line a second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Generic, Protocol, TextIO, TypeVar

from palpate.answer.contact import ContactPositions, Point
from palpate.core.clock import Clock


@dataclass(frozen=True, slots=True)
class View:
    """The contact on the skin at one moment, and advice for the person.

    number: counts Views from 1.
    source: as in sentences ("usb", "sim").
    skin: its state (PROTOCOL.md).
    state: "no-skin", "wait", "lift", "no-contact", "no-positions", "off" or "in-place".
    message: the state in words.
    hint: advice for the person.
    load: raw counts above the unloaded skin, [rows][columns]; empty before the first frames.
    full: load that is shown as the strongest.
    centre: centre of the contact, mm from the centre of taxel 1.1 (in taxels without `contact`).
    nearest: the nearest trained position, in the same unit.
    contact: contact positions in training, None if unknown.
    fingertip: setting `skin.fingertip`.
    load_unit: unit of the load, "" for raw counts.
    """

    number: int
    source: str
    bundle: str
    skin: str
    state: str
    message: str
    hint: str
    shape: tuple[int, int]
    load: tuple[tuple[float, ...], ...] = ()
    full: float = 1.0
    centre: Point | None = None
    nearest: Point | None = None
    contact: ContactPositions | None = None
    fingertip: str = ""
    load_unit: str = ""

    @property
    def origin(self) -> str:
        """A note that the skin is simulated or replayed, "" for a real skin."""
        return {"usb": "", "replay": "REPLAYED"}.get(self.source, "SIMULATED")

    @property
    def unit(self) -> str:
        """Unit of centre and nearest."""
        return "mm" if self.contact else "taxels"

    def json(self) -> dict[str, Any]:
        """The View as the page reads it."""
        return asdict(self)


Shown = TypeVar("Shown", contravariant=True)


class Display(Protocol[Shown]):
    """Shows one view after another."""

    def show(self, view: Shown) -> None:
        """Show `view` instead of the view before."""


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
