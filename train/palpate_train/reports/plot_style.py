"""The style of all pictures: turns matplotlib figures into SVG text that is the same in every run.

A picture is 360 units wide, the width of a phone. Its colours are roles (--text, --accent …), which
a page sets for light and dark. A picture outside of a page has plain colours.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

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
    "accent": ACCENT,
    "text": BLACK,
    "grey": GREY,
    "faint": FAINT,
    "background": WHITE,
    "orange": ORANGE,
    "green": GREEN,
    "purple": PURPLE,
}
COLOURS = {colour: f"var(--{role}, {colour})" for role, colour in ROLES.items()}
"""The text in an SVG for each colour."""
DARK_ROLES = {
    "accent": "#58a6ff",
    "text": "#e6edf3",
    "grey": "#9ea7b3",
    "faint": "#343b44",
    "background": "#0d1117",
    "orange": "#f0883e",
    "green": "#3fb68b",
    "purple": "#c297ff",
}
"""Colours of the same roles for readers who chose dark."""
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'DejaVu Sans', sans-serif"
WIDTH = 5.0
"""Inches, of 72 units each."""
MEDIUM, SMALL = 10.5, 9.0
"""Sizes of text in units."""
PLACES = 2
"""Decimals of coordinates: a hundredth of a unit cannot be seen."""
DIGITS = 6
"""Largest number of significant digits in a tick label."""


def _variables(roles: Mapping[str, str]) -> str:
    return " ".join(f"--{role}: {colour};" for role, colour in roles.items())


LIGHT, DARK = _variables(ROLES), _variables(DARK_ROLES)
AXIS = "axis:"
"""Prefix of the id of an axis with numbers while it is drawn; the axis title follows."""
SVG, XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
NUMBERS = {"x", "y", "x1", "y1", "x2", "y2", "width", "height"}
"""Attributes that hold one coordinate."""
ElementTree.register_namespace("", SVG)
ElementTree.register_namespace("xlink", XLINK)


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

    percent: the values are shares and shown as per cent. bare: no labels, for a plot beside a
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

    Each axis with numbers has its title as the attribute data-axis, "" if it has none.
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
    root = ElementTree.fromstring(file.getvalue())
    for style in root.findall(f"{{{SVG}}}defs[{{{SVG}}}style]"):
        root.remove(style)  # a style sheet would be that of the whole page
    _drop_empty_groups(root)
    for element in root.iter():
        _restyle(element, {} if plain else COLOURS)
    for name in ("width", "height"):
        root.attrib.pop(name)  # as wide as the page
    root.attrib |= {"role": "img", "font-family": FONT, "stroke-linejoin": "round"}
    title = ElementTree.Element(f"{{{SVG}}}title")
    title.text = about
    root.insert(0, title)
    ElementTree.indent(root, space="")
    return ElementTree.tostring(root, encoding="unicode")


def _named(axis: Axis, shared: str) -> str | None:
    """The id under which an axis with numbers is drawn: its title, or the title shared by the
    picture."""
    if not isinstance(axis.get_major_formatter(), TickFormatter) or not len(
        axis.get_majorticklocs()
    ):
        return None
    return AXIS + (axis.get_label_text() or shared)


def _drop_empty_groups(parent: ElementTree.Element) -> None:
    """Remove the empty groups of ticks without length."""
    for child in list(parent):
        _drop_empty_groups(child)
        if child.tag == f"{{{SVG}}}g" and not len(child):
            parent.remove(child)


def _restyle(element: ElementTree.Element, colours: Mapping[str, str]) -> None:
    """Replace colours by `colours`; remove matplotlib's fonts and the names of groups; round
    coordinates to a precision that can be seen."""
    attributes = element.attrib
    if element.tag == f"{{{SVG}}}g":
        name = attributes.pop("id", "")  # two pictures of a page would share them
        if name.startswith(AXIS):
            attributes["data-axis"] = name.removeprefix(AXIS)
    if "style" in attributes:
        parts = (part.partition(":") for part in attributes["style"].split(";"))
        pairs = {
            name.strip(): value.strip() for name, _, value in parts if name.strip() != "font-family"
        }
        attributes["style"] = "; ".join(
            f"{name}: {colours.get(value, value)}" for name, value in pairs.items() if name
        )
    for name in NUMBERS & attributes.keys():
        attributes[name] = _short(attributes[name])
    if "d" in attributes:
        attributes["d"] = " ".join(
            part if part.isalpha() else _short(part) for part in attributes["d"].split()
        )
    if attributes.get("transform", "").startswith(("rotate(-0 ", "rotate(0 ")):
        del attributes["transform"]


def _short(number: str) -> str:
    """A coordinate with at most PLACES decimals; numbers with a unit are unchanged."""
    try:
        text = f"{float(number):.{PLACES}f}".rstrip("0").rstrip(".")
    except ValueError:
        return number
    return "0" if text == "-0" else text
