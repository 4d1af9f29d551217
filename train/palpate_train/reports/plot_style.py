"""The style of all pictures: turns matplotlib figures into SVG text that is the same in every run.

A picture is 360 units wide, the width of a phone. Its colours are roles (--text, --accent …), which
a page sets for light and dark. A picture outside of a page has plain colours.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, Formatter, NullFormatter, NullLocator

ACCENT, BLACK, GREY, FAINT, WHITE = "#0b66c3", "#1f2328", "#59636e", "#d1d9e0", "#fefefe"
ORANGE, GREEN, PURPLE = "#b04a00", "#007a5e", "#8b3fb8"
"""Further colours for pictures with several; each has a contrast of at least 5 on the
background."""
ROLES = {
    "accent": (ACCENT, "#58a6ff"),
    "text": (BLACK, "#e6edf3"),
    "grey": (GREY, "#9ea7b3"),
    "faint": (FAINT, "#343b44"),
    "background": (WHITE, "#0d1117"),
    "orange": (ORANGE, "#f0883e"),
    "green": (GREEN, "#3fb68b"),
    "purple": (PURPLE, "#c297ff"),
}
"""The colours of each role, for all and for readers who chose dark."""
COLOURS = {colour: f"var(--{role}, {colour})" for role, (colour, _) in ROLES.items()}
"""The text in an SVG for each colour."""
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'DejaVu Sans', sans-serif"
WIDTH = 5.0
"""Inches, of 72 units each."""
MEDIUM, SMALL = 10.5, 9.0
"""Sizes of text in units."""
PLACES = 2
"""Decimals of coordinates: a hundredth of a unit cannot be seen."""
DIGITS = 6
"""Largest number of significant digits in a tick label."""
LIGHT, DARK = (
    " ".join(f"--{role}: {colours[look]};" for role, colours in ROLES.items()) for look in (0, 1)
)
AXIS = "axis:"
"""Prefix of the id of an axis with numbers while it is drawn; the axis title follows."""
REWRITTEN = (
    (r' (width|height)="[\d.]+pt"', ""),  # as wide as the page
    (r"<defs>\s*<style.*?</style>\s*</defs>", ""),  # it would be that of the whole page
    (rf'<g id="{AXIS}', '<g data-axis="'),
    (r'<g id="[^"]*"', "<g"),  # two pictures of a page would share them
    (r' transform="rotate\(-?0 [^"]*"', ""),
    (r"font-family: [^;\"]*;? ?", ""),
    (r"\n\s*", "\n"),
)
"""What is replaced in matplotlib's SVG."""
COORDINATES = re.compile(r'\b(d|[xy][12]?|width|height)="[^"]*"')


class TickFormatter(Formatter):
    """Labels that show the full value of each tick: with the necessary decimals, up to DIGITS
    significant digits.

    factor: a label is the tick's value times this. unit: follows the last label.
    """

    def __init__(self, factor: float = 1.0, unit: str = "") -> None:
        self.factor, self.unit = factor, unit

    def __call__(self, x: float, pos: int | None = None) -> str:
        """The label of a tick at `x`, without the unit."""
        text = np.format_float_positional(float(f"{x * self.factor:.{DIGITS}g}"), trim="-")
        return text.replace("-", "−") if float(text) else "0"

    def format_ticks(self, values: Iterable[float]) -> list[str]:
        """All labels of an axis."""
        labels = [self(value) for value in values]
        if labels and self.unit:
            labels[-1] += f" {self.unit}"
        return labels


def single_axes(
    height: float, left: float, right: float, top: float, bottom: float
) -> tuple[Figure, Axes]:
    """A picture `height` inches high with one plot. left, right: its ends as shares. top, bottom:
    margins in inches."""
    figure = Figure((WIDTH, height))
    return figure, add_axes(figure, left, right, 1 - top / height, bottom / height)


def add_axes(figure: Figure, left: float, right: float, top: float, bottom: float) -> Axes:
    """Add a plot, with its ends as shares of the picture; without a frame and with the grid in the
    background."""
    axes = figure.add_axes((left, bottom, right - left, top - bottom))
    axes.set_axisbelow(True)
    axes.patch.set_visible(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return axes


def tiles(axes: Axes, rows: int, columns: int) -> None:
    """Unit squares, the first row on top, with a gap between them."""
    axes.set_xlim(0, columns)
    axes.set_ylim(rows, 0)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.hlines(range(rows + 1), 0, columns, color=WHITE, linewidth=1.5)
    axes.vlines(range(columns + 1), 0, rows, color=WHITE, linewidth=1.5)


def set_ticks(
    axis: Axis,
    ticks: Iterable[float],
    unit: str = "",
    factor: float = 1.0,
    *,
    percent: bool = False,
    bare: bool = False,
) -> None:
    """Ticks without strokes, labelled with their values times `factor`, the last one with the unit.

    percent: the values are shares and shown as per cent. bare: no labels, for a plot next to a
    labelled one.
    """
    unit, factor = ("%", 100.0) if percent else (unit, factor)
    _place_ticks(axis, ticks, NullFormatter() if bare else TickFormatter(factor, unit))


def round_ticks(low: float, high: float, most: int) -> list[float]:
    """Round values from `low` to `high`, at most `most` + 1 of them."""
    step = 10.0 ** np.floor(np.log10(max(high - low, 1e-6)))
    step *= next(k for k in (0.1, 0.2, 0.5, 1, 2, 5) if (high - low) / (k * step) <= most or k == 5)
    return list(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step)


def set_categories(axis: Axis, at: Iterable[float], names: Sequence[str]) -> None:
    """Label ticks with names instead of values."""
    _place_ticks(axis, at, FixedFormatter(names))


def _place_ticks(axis: Axis, ticks: Iterable[float], formatter: Formatter) -> None:
    axis.set_major_locator(FixedLocator([float(tick) for tick in ticks]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(formatter)
    axis.set_tick_params(length=0, labelcolor=GREY, labelsize=SMALL)


def write(
    axes: Axes,
    x: float,
    y: float,
    text: str,
    colour: str = BLACK,
    size: float = MEDIUM,
    **style: Any,
) -> None:
    """Write text at a point in the plot's units, also outside the plot; centred unless `style`
    differs.

    Of several lines, the last one stands at the point and the others above it. Each is a text of
    its own, so that they keep their distance in a reader's own font.
    """
    given: dict[str, Any] = {
        "color": colour,
        "size": size,
        "va": "center",
        "ha": "center",
        "annotation_clip": False,
        "parse_math": False,  # names of materials may have dollar signs
    }
    for up, line in enumerate(reversed(text.split("\n"))):
        axes.annotate(
            line, (x, y), (0, 1.2 * size * up), textcoords="offset points", **given | style
        )


def to_svg(figure: Figure, about: str, plain: bool = False) -> str:
    """The picture as SVG text. about: its title, for readers who cannot see it. plain: use fixed
    colours instead of roles, for a picture outside of a page.

    Each axis with numbers has its title as the attribute data-axis, "" if it has none. Raises
    TypeError for an axis with labels that neither set_ticks nor set_categories has made.
    """
    figure.patch.set_facecolor(WHITE)
    for axes in figure.axes:
        axes.xaxis.set_gid(_named(axes.xaxis, figure.get_supxlabel()))
        axes.yaxis.set_gid(_named(axes.yaxis, figure.get_supylabel()))
    file = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": about}):
        figure.savefig(
            file, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    svg = file.getvalue().partition("<svg ")[2]
    for pattern, text in REWRITTEN:
        svg = re.sub(pattern, text, svg, flags=re.DOTALL)
    svg = COORDINATES.sub(_short, svg)
    if not plain:
        svg = re.sub("#[0-9a-f]{6}", lambda found: COLOURS.get(found[0], found[0]), svg)
    svg = f'<svg role="img" font-family="{FONT}" stroke-linejoin="round" {svg}'
    return svg.replace(">", f"><title>{escape(about)}</title>", 1)


def _named(axis: Axis, shared: str) -> str | None:
    """The id under which an axis with numbers is drawn: its title, or the title shared by the
    picture."""
    made = axis.get_major_formatter()
    if not axis.axes.axison or not len(axis.get_majorticklocs()):
        return None
    if not isinstance(made, (TickFormatter, FixedFormatter, NullFormatter)):
        raise TypeError("labels of matplotlib may be rounded; call set_ticks or set_categories")
    if not isinstance(made, TickFormatter):
        return None
    return AXIS + (axis.get_label_text() or shared)


def _short(coordinates: re.Match[str]) -> str:
    """An attribute with at most PLACES decimals in each number."""
    numbers = re.sub(
        r"\d+\.\d+", lambda n: f"{float(n[0]):.{PLACES}f}".rstrip("0").rstrip("."), coordinates[0]
    )
    return " ".join(numbers.split())
