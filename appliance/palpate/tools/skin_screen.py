"""Shows a skin in a terminal, for `palpate skin show`: heat maps that are drawn again and again.

An output that is not a terminal, or a dumb terminal, gets a line a second.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from palpate.alignment.heat_map import side_by_side, uncoloured
from palpate.alignment.terminal import BLOCKS, BOLD, PLAIN, LiveScreen
from palpate.tools.skin_monitor import LiveView

MOST_NAMED = 8
"""Largest number of faulty taxels that are named; of more, the number is shown."""


class SkinScreen(LiveScreen[LiveView]):
    """Shows LiveViews."""

    def _picture(self, view: LiveView, width: int, height: int) -> list[str]:
        return list(picture(view, width, self._colours, self._signs, self._address))[: height - 1]

    def _line(self, view: LiveView) -> str:
        return line(view)


def figures(view: LiveView) -> str:
    """Rate, frames, loss and noise in words."""
    rate = "" if view.rate_hz is None else f"{view.rate_hz:.1f} Hz, "
    lost = "loss cannot be known" if view.lost is None else f"{view.lost:,} lost"
    noise = sorted(value for axis in view.noise for row in axis for value in row)
    unit = view.unit or "raw counts"
    middle = (
        f", noise {noise[len(noise) // 2]:.2g}, at most {noise[-1]:.2g} {unit}" if noise else ""
    )
    return f"{rate}{view.frames:,} frames, {lost}{middle}"


def faults(view: LiveView) -> str:
    """Stuck, dead and saturated taxels in words; "" if there are none."""
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


def picture(
    view: LiveView, width: int, colours: bool, signs: str = BLOCKS, address: str = ""
) -> Iterator[str]:
    """A LiveView line by line, no wider than `width`. signs: see alignment.terminal."""
    simulated = "   SIMULATED" * (view.source == "sim")
    yield f" palpate skin show   {view.skin}{simulated}"[:width]
    yield f" {BOLD}{view.state}{PLAIN}  {view.trouble or figures(view)}"[
        : width + len(BOLD + PLAIN)
    ]
    yield f" {faults(view) or ('no fault seen' if view.load else '')}"[:width]
    yield ""
    for maps in side_by_side(view.load, view.full, width, signs, view.unit):
        yield from maps if colours else map(uncoloured, maps)
        yield ""
    yield f" Ctrl-C ends   {address}"
