"""Shows a skin in a terminal, for `palpate skin show`. In: LiveViews. Out: heat maps that are drawn again and again, or
plain lines.

Where the output is no terminal, or a dumb one, it gets one line a second.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Self, TextIO

from appliance.alignment.terminal import BLOCKS, BOLD, ENTER, HEAT, LEAVE, LINE_NS, PLAIN
from appliance.core.clock import Clock
from appliance.tools.skin_monitor import LiveView

WIDEST = 6
"""Characters of a taxel at most; from five on its count fits in."""
GAP = "   "
MOST_NAMED = 8
"""So many faulty taxels are named; of more, only the number is told."""

Map = Sequence[Sequence[float]]


class SkinScreen:
    """Shows LiveViews on `out`; `address`: of the page, where there is one. Restores the terminal at the end."""

    def __init__(self, out: TextIO, clock: Clock, address: str = "") -> None:
        self._out, self._clock, self._address = out, clock, address
        kind = os.environ.get("TERM", "dumb")
        self._live = out.isatty() and kind != "dumb"
        self._colours = "256" in kind
        self._next_ns = 0

    def __enter__(self) -> Self:
        self._write(ENTER if self._live else f"page: {self._address}\n" if self._address else "")
        return self

    def __exit__(self, *_: object) -> None:
        self._write(LEAVE if self._live else "")

    def show(self, view: LiveView) -> None:
        """Draw `view` over the one before, in one write so that nothing flickers; or print a line, once a second."""
        if self._live:
            width, height = os.get_terminal_size(self._out.fileno())
            lines = list(picture(view, width or 80, self._colours, self._address))[: (height or 24) - 1]
            self._write("\033[H" + "".join(f"{line}\033[K\n" for line in lines) + "\033[J")
        elif (now_ns := self._clock.now_ns()) >= self._next_ns:
            self._next_ns = now_ns + LINE_NS
            self._write(line(view) + "\n")

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()


def figures(view: LiveView) -> str:
    """Rate, frames, loss and noise in words."""
    rate = "" if view.rate_hz is None else f"{view.rate_hz:.1f} Hz, "
    lost = "loss cannot be known" if view.lost is None else f"{view.lost:,} lost"
    noise = sorted(value for axis in view.noise for row in axis for value in row)
    middle = f", noise {noise[len(noise) // 2]:.2g}, at most {noise[-1]:.2g} raw counts" if noise else ""
    return f"{rate}{view.frames:,} frames, {lost}{middle}"


def faults(view: LiveView) -> str:
    """Stuck, dead and saturated taxels in words; "" where there are none."""
    kinds = (("stuck", view.stuck), ("dead", view.dead), ("saturated", view.saturated))
    return "; ".join(f"{name}: {_named(taxels)}" for name, taxels in kinds if taxels)


def _named(taxels: Sequence[str]) -> str:
    more = f" and {len(taxels) - MOST_NAMED} more" if len(taxels) > MOST_NAMED else ""
    return ", ".join(taxels[:MOST_NAMED]) + more


def line(view: LiveView) -> str:
    """A LiveView in one line."""
    found = faults(view)
    text = view.trouble or figures(view) + (f"; {found}" if found else "")
    return f"{'SIMULATED  ' * (view.source == 'sim')}{view.skin}  {view.state}: {text}"


def picture(view: LiveView, width: int, colours: bool, address: str = "") -> Iterator[str]:
    """A LiveView line by line, no wider than `width`."""
    simulated = "   SIMULATED" * (view.source == "sim")
    yield f" palpate skin show   {view.skin}{simulated}"[:width]
    yield f" {BOLD}{view.state}{PLAIN}  {view.trouble or figures(view)}"[: width + len(BOLD + PLAIN)]
    yield f" {faults(view) or ('no fault seen' if view.load else '')}"[:width]
    yield ""
    for maps in _side_by_side(view, width):
        yield from maps if colours else (_uncoloured(text) for text in maps)
        yield ""
    yield f" Ctrl-C ends   {address}"


def _side_by_side(view: LiveView, width: int) -> Iterator[list[str]]:
    """The maps of the axes, as many beside one another as there is room for."""
    _, cols, axes = view.shape
    cell = max(1, min(WIDEST, (width - 4) // cols if axes == 1 else (width // axes - len(GAP)) // cols))
    beside = max(1, (width + len(GAP)) // (cols * cell + len(GAP) + 1))
    for at in range(0, len(view.load), beside):
        drawn = [_map(axis, at + i, view, cell) for i, axis in enumerate(view.load[at : at + beside])]
        yield [" " + GAP.join(parts) for parts in zip_longest(*drawn, fillvalue="")]


def _map(values: Map, axis: int, view: LiveView, cell: int) -> list[str]:
    """One axis: a shaded field for each taxel, with its count where it fits in."""
    several = view.shape[2] > 1
    head = [f"axis {axis + 1}{' (normal)' * (axis + 1 == view.shape[2])}".ljust(cell * view.shape[1])] * several
    return head + ["".join(_field(value, view.full, cell) for value in row) + PLAIN for row in values]


def _field(value: float, full: float, cell: int) -> str:
    share = max(0.0, min(1.0, value / full))
    text = f"{value:.0f}".center(cell) if cell >= 5 else BLOCKS[round(4 * share)] * cell
    return f"\033[38;5;{HEAT[round(5 * share)]}m{text[:cell]}"


def _uncoloured(text: str) -> str:
    for shade in HEAT:
        text = text.replace(f"\033[38;5;{shade}m", "")
    return text.replace(PLAIN, "")
