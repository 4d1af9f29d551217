"""Heat maps of a skin in a terminal with 256 colours, for `palpate skin show` and `palpate
watch`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest

from palpate.alignment.terminal import BLOCKS, HEAT, PLAIN
from palpate.alignment.view import figure

WIDEST = 6
"""Largest width of a taxel in characters; from five on the count is shown."""
GAP = "   "

Map = Sequence[Sequence[float]]
"""Load of one axis, [rows][columns]."""


def side_by_side(
    load: Sequence[Map], full: float, width: int, signs: str = BLOCKS, unit: str = ""
) -> Iterator[list[str]]:
    """The maps of all axes, with as many side by side as fit in `width`. Yields the lines of one
    row of maps after another.

    full: load that is shown as the strongest. signs: see alignment.terminal. unit: of the load, ""
    for raw counts.
    """
    axes, cols = len(load), len(load[0][0]) if load else 0
    if not load:
        return
    cell = max(
        1, min(WIDEST, (width - 4) // cols if axes == 1 else (width // axes - len(GAP)) // cols)
    )
    beside = max(1, (width + len(GAP)) // (cols * cell + len(GAP) + 1))
    for at in range(0, axes, beside):
        drawn = [
            _map(axis, _head(at + i, axes), full, cell, signs, unit)
            for i, axis in enumerate(load[at : at + beside])
        ]
        yield [" " + GAP.join(parts) for parts in zip_longest(*drawn, fillvalue="")]


def uncoloured(text: str) -> str:
    """`text` for a terminal without colours."""
    for shade in HEAT:
        text = text.replace(f"\033[38;5;{shade}m", "")
    return text.replace(PLAIN, "")


def _head(axis: int, axes: int) -> str:
    return f"axis {axis + 1}{' (normal)' * (axis + 1 == axes)}" if axes > 1 else ""


def _map(values: Map, head: str, full: float, cell: int, signs: str, unit: str) -> list[str]:
    """One axis: a shaded field for each taxel, with its count if there is room."""
    rows = [
        "".join(_field(value, full, cell, signs, unit) for value in row) + PLAIN for row in values
    ]
    return [head.ljust(cell * len(values[0])), *rows] if head else rows


def _field(value: float, full: float, cell: int, signs: str, unit: str) -> str:
    share = max(0.0, min(1.0, value / full))
    text = figure(value, full, unit).center(cell) if cell >= 5 else signs[round(4 * share)] * cell
    return f"\033[38;5;{HEAT[round(5 * share)]}m{text[:cell]}"
