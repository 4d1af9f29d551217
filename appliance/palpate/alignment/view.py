"""The View, the picture of `palpate skin align` at one moment, and its displays' interface."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Protocol, TypeVar

from palpate.answer.contact import ContactPositions, Point


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
