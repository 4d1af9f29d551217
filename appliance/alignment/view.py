"""What `palpate align` shows at one moment: the View, and the display that shows it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Protocol

from appliance.signal.contact import ContactPositions, Point


@dataclass(frozen=True, slots=True)
class View:
    """Where the skin is touched at one moment, and what the person may do.

    number: counts Views from 1. source: as sentences name it ("usb", "sim"). skin: its state
    (PROTOCOL.md). state: "no-skin", "wait", "lift", "no-contact", "no-positions", "off" or
    "in-place". message: that in words. hint: what the person may do. load: raw counts above the
    unloaded skin, [rows][columns]; empty before there are any. full: load that is shown as the
    strongest. centre: of the contact, and nearest: the trained position nearest to it, mm from the
    centre of taxel 1.1 (taxels where there is no `place`). fingertip: setting `skin.fingertip`.
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

    @property
    def origin(self) -> str:
        """That the skin is not a real one, "" if it is."""
        return {"usb": "", "replay": "REPLAYED"}.get(self.source, "SIMULATED")

    @property
    def unit(self) -> str:
        """Unit of centre and nearest."""
        return "mm" if self.contact else "taxels"

    def json(self) -> dict[str, Any]:
        """The View as the page reads it."""
        return asdict(self)


class Display(Protocol):
    """Shows one View after another."""

    def show(self, view: View) -> None:
        """Show `view` in place of the one before."""
