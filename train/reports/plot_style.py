"""The room of ink: what all pictures share. In: what was drawn with matplotlib. Out: SVG text, always the same.

A picture is 360 units wide, the width of a phone. Colours are roles (--ink, --accent …) that a page may set for light
and dark; alone a picture is dark on white.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator

ACCENT, INK, GREY, FAINT, PAPER = "#0b66c3", "#1f2328", "#59636e", "#d1d9e0", "#fefefe"
ROLES = {"accent": ACCENT, "ink": INK, "grey": GREY, "faint": FAINT, "paper": PAPER}
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'DejaVu Sans', sans-serif"
WIDTH = 5.0
"""Inches, of 72 units each."""
TEXT, SMALL = 10.5, 9.0
DEFAULT_FONT = re.compile(r" font-family: [^;]*;")
STYLE = re.compile(r"<defs>\s*<style.*?</style>\s*</defs>", re.S)
NAMES = re.compile(r'(?<=<g) id="[^"]*"')
TAG = re.compile(r"<[^>]*>")
DIGITS = re.compile(r"(?<=\d\.\d\d)\d+")
UPRIGHT = re.compile(r' transform="rotate\(-0 [^)]*\)"')
HEAD = re.compile(r'width="[^"]*" height="[^"]*" (viewBox="[^"]*")([^>]*)>')


def share(value: float) -> str:
    """A share as the paper prints it: .86, 1.00."""
    return f"{value:.2f}".removeprefix("0")


def field(height: float, left: float, right: float, top: float, bottom: float) -> tuple[Figure, Axes]:
    """A picture `height` inches high with one field; left, right: its ends as shares; top, bottom: inches around it."""
    figure = Figure((WIDTH, height))
    return figure, add(figure, left, right, 1 - top / height, bottom / height)


def add(figure: Figure, left: float, right: float, top: float, bottom: float) -> Axes:
    """One more field, its ends as shares of the picture; no frame, the grid behind all else."""
    axes: Axes = figure.add_axes((left, bottom, right - left, top - bottom))
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
    axes.hlines(range(rows + 1), 0, columns, color=PAPER, linewidth=1.5)
    axes.vlines(range(columns + 1), 0, rows, color=PAPER, linewidth=1.5)


def scale(axis: Axis, ticks: Iterable[float], labels: Sequence[str] | None = None) -> None:
    """Ticks without strokes; labels as shares below one, else as they are."""
    at = [round(float(tick), 9) for tick in ticks]
    said = [share(t) if 0 < t < 1 and round(t, 2) == t else f"{t:g}" for t in at] if labels is None else labels
    axis.set_major_locator(FixedLocator(at))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FixedFormatter(said))
    axis.set_tick_params(length=0, labelcolor=GREY, labelsize=SMALL)


def write(axes: Axes, x: float, y: float, text: str, colour: str = INK, size: float = TEXT, **how: Any) -> None:
    """Text at a place in the field's units, also beside the field; its middle there where nothing else is said.

    Of several lines the last one is there and the others stand above it, each a text of its own: so a reader's own font
    keeps them in line.
    """
    style = {"color": colour, "size": size, "va": "center", "ha": "center", "annotation_clip": False} | how
    for up, line in enumerate(reversed(text.split("\n"))):
        axes.annotate(line, (x, y), (0, 1.2 * size * up), textcoords="offset points", **style)


def svg(figure: Figure, about: str) -> str:
    """The picture as text. about: for those who cannot see it."""
    figure.patch.set_facecolor(PAPER)
    held = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": about}):
        figure.savefig(held, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = held.getvalue()
    text = text[text.index("<svg") :]
    for what in (
        DEFAULT_FONT,
        STYLE,
        NAMES,
    ):  # of matplotlib, for all of a page, twice in a page
        text = what.sub("", text)
    text = TAG.sub(lambda tag: DIGITS.sub("", tag[0]), text)  # finer than seen; a text keeps its digits
    text = re.sub(r"\s*\n\s*", "\n", text)
    for role, colour in ROLES.items():
        text = text.replace(f": {colour}", f": var(--{role}, {colour})")
    said = f'role="img" font-family="{FONT}" stroke-linejoin="round"><title>{escape(about)}</title>'
    return HEAD.sub(lambda found: f"{found[1]}{found[2]} {said}", text, count=1)
