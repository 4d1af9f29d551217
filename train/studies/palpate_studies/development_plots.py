"""The picture of README and of the page "Speed against accuracy" (SVG)."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate_studies.development_chart import ChartPanel, Spot, finding
from palpate_studies.development_experiment import OURS
from palpate_studies.method_names import short_name
from palpate_train.models.methods import PACKAGED
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    MEDIUM,
    SMALL,
    WHITE,
    WIDTH,
    add_axes,
    round_ticks,
    set_ticks,
    to_svg,
)

RING: Mapping[str, Any] = {
    "marker": "o",
    "markersize": 13,
    "markerfacecolor": "none",
    "markeredgewidth": 1.3,
    "color": ACCENT,
    "clip_on": False,
}
MARKERS = {"int8": "o", "float": "s"}
HEAD, HEIGHT, FOOT = 0.56, 2.2, 0.42
"""Inches above a panel, of its plot, and below it."""
STEPS = 40
"""Points between two marks of a line that keep names away from it."""
SPAN = 0.22
"""Longest axis of accuracy. What is less accurate is drawn at its end and named below."""
LETTERS = 74
"""Most letters of a line of small text."""
KEY = "━ Pareto front of all forms   ● int8   ■ float   ◯ ships"
FEW_KEY = "━ our family, from small to large   ◯ ships   ● int8   ■ float"
ALONE = "│ time of features and network alone"
FEW = (PACKAGED, OURS[0], "minirocket", "multirocket-hydra", "ds-cnn", "paper-cnn-centred", "quant")
"""The methods of README's picture; the page has all."""
FEW_NAMES = {PACKAGED: "ships", OURS[0]: "Palpate"}
PLACES = [
    (dx, dy, side)
    for right, up in ((7, 0), (0, 10), (5, 12), (0, 20), (8, 18), (16, 26), (24, 34))
    for dx, dy in dict.fromkeys(((right, up), (-right, up), (right, -up), (-right, -up)))
    for side in (("left" if dx > 0 else "right" if dx < 0 else "center"),)
]
"""Places of a name relative to its mark, in units, and its alignment; the best first."""
FAR = 15
"""From this distance on a stroke joins name and mark."""
SIDES = {"left": 0.0, "center": 0.5, "right": 1.0}
"""The side of a name at which its mark is."""
LETTER = 0.55
"""Width of a letter, as a share of its size."""
GAP = 3.0
"""Least distance from a name to the next on its line, and to a mark, in units."""
MARK = 4.0
"""Half the width of a mark, in units."""
LEADER: dict[str, Any] = {"arrowstyle": "-", "color": GREY, "linewidth": 0.6, "shrinkB": MARK}
Box = tuple[float, float, float, float]
Label = tuple[float, float, str, str, bool]
"""A mark (x, y in the plot's units), its name or "", the name's colour, and whether it is bold."""


def speed(panels: Sequence[ChartPanel], machine: str, plain: bool = False) -> str:
    """Mean accuracy over the time of a sweep: a panel for each kind of tests, on one axis.

    machine: processor and threads, in words. plain: in fixed colours, for a viewer of Markdown, and
    with the methods of FEW alone.
    """
    spots = [ms for panel in panels for spot in panel.spots for ms in (spot.ms, spot.alone) if ms]
    ends = min(spots) / 1.7, max(spots) * 1.7
    said = ("" if plain else _below(panels), _gaps(panels, plain), machine)
    lines = [
        FEW_KEY if plain else KEY,
        *[ALONE] * any(panel.answered for panel in panels),
        *(line for text in said for line in textwrap.wrap(text, LETTERS)),
    ]
    each, below = HEAD + HEIGHT + FOOT, 0.17 * len(lines) + 0.08
    height = each * len(panels) + below
    figure = Figure((WIDTH, height), dpi=72)
    for number, panel in enumerate(panels):
        top = height - each * number - HEAD
        axes = add_axes(figure, 0.11, 0.97, top / height, (top - HEIGHT) / height)
        _panel(axes, panel, ends, plain)
    for number, line in enumerate(reversed(lines)):
        figure.text(0.012, (0.07 + 0.17 * number) / height, line, color=GREY, size=SMALL)
    return to_svg(figure, "; ".join(f"{panel.kind}: {finding(panel)}" for panel in panels), plain)


def _below(panels: Sequence[ChartPanel]) -> str:
    """The marks at the lower end of the axis, with their accuracies."""
    parts = []
    for panel in panels:
        bottom, _ = _ends(panel)
        those = [_label(spot) for spot in panel.spots if spot.mean < bottom and not spot.form]
        if those:
            parts.append(f"{panel.kind}: {' · '.join(those)}")
    return f"▾ less than the axis shows ({'; '.join(parts)})" if parts else ""


def _label(spot: Spot, few: bool = False) -> str:
    name = FEW_NAMES.get(spot.method) if few else None
    return f"{name or short_name(spot.method)} {100 * spot.mean:.1f}"


def _gaps(panels: Sequence[ChartPanel], few: bool) -> str:
    """The hollow marks: methods that were not run in every test, with the number of their tests."""
    parts = []
    for panel in panels:
        count = len(panel.cases)
        lacking = {m: n for m, n in panel.lacking().items() if m in FEW or not few}
        those = [f"{short_name(name)} {count - n}" for name, n in lacking.items()]
        if those:
            parts.append(f"{panel.kind}: {' · '.join(those)} of {count}")
    return f"Hollow: not run in all tests ({'; '.join(parts)})" if parts else ""


def _panel(axes: Axes, panel: ChartPanel, ends: tuple[float, float], few: bool) -> None:
    """One panel with its finding as title. few: the methods of FEW alone."""
    low, high = _ends(panel)
    room = 0.09 * max(high - low, 0.02)
    axes.set_xscale("log")
    axes.set_xlim(*ends)
    axes.set_ylim(low - 1.5 * room, high + room)
    axes.grid(color=FAINT, linewidth=0.6)
    tens = [10.0**n for n in range(-4, 5) if ends[0] <= 10.0**n <= ends[1]]
    set_ticks(axes.xaxis, tens or [float(f"{ends[0]:.1g}")], "ms")
    set_ticks(axes.yaxis, round_ticks(low - room, high + room, 6), percent=True)
    shape, frames = panel.sweep.partition(" ")[0], panel.sweep.rpartition(" ")[2]
    what = "the whole answer to" if panel.answered else "features and network for"
    timed = f"← faster: time of {what} {shape} taxels, {frames} frames"
    axes.set_xlabel(timed, color=GREY, size=SMALL, labelpad=3)
    about = f"classified correctly, mean of {len(panel.cases)} tests: {panel.kind}"
    axes.set_ylabel(about, color=GREY, size=SMALL, rotation=0, ha="left", va="bottom")
    axes.yaxis.set_label_coords(-0.115, 1.03)
    look: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
    look |= {"color": BLACK, "weight": "bold", "size": MEDIUM}
    axes.annotate(finding(panel), (-0.115, 1.03), (0, 13), **look)
    front = [(spot.ms, spot.mean) for spot in panel.front]
    corners = [(x, y) for a, b in pairwise(front) for x, y in (a, (b[0], a[1]))]
    stairs = [*corners, *front[-1:], *((ends[1], y) for _, y in front[-1:])]
    line = [(spot.ms, spot.mean) for spot in panel.line]
    stairs = [] if few else stairs  # without the dots at its corners it says nothing
    for path, shade, width in ((stairs, BLACK, 1.1), (line, ACCENT, 1.8)):
        axes.plot([x for x, _ in path], [y for _, y in path], color=shade, linewidth=width)
    _write_labels(axes, list(_marks(axes, panel, few)), _between(line) + _between(stairs))


def _ends(panel: ChartPanel) -> tuple[float, float]:
    """Lowest and highest accuracy on the axis."""
    means = [spot.mean for spot in panel.spots]
    return max(min(means), max(means) - SPAN), max(means)


def _marks(axes: Axes, panel: ChartPanel, few: bool) -> Iterator[Label]:
    """Draw the spots; yield their names, the most important first. All forms of a method have the
    same name."""
    names: dict[str, str] = {}
    shown = [s for s in panel.spots if not few or (s.method in FEW and not s.form)]
    bottom, _ = _ends(panel)
    for spot in shown:
        y, mark = max(spot.mean, bottom), MARKERS[spot.precision]
        mark = "v" if spot.mean < bottom else mark
        shade = _shade(panel, spot, few)
        face = WHITE if spot.lacks else shade
        look: dict[str, Any] = {"markeredgecolor": shade, "markerfacecolor": face, "clip_on": False}
        axes.plot(spot.ms, y, mark, markersize=5.5, zorder=4, **look)
        if spot.alone:
            axes.plot(spot.alone, y, "|", markersize=5.5, color=shade, clip_on=False)
        if spot.method == PACKAGED and not spot.form:
            axes.plot(spot.ms, y, **RING)
    order = sorted(shown, key=lambda s: (s.method != PACKAGED, s not in panel.front, -s.mean))
    for spot in order:
        text = "" if spot.mean < bottom else names.setdefault(spot.method, _label(spot, few))
        yield spot.ms, max(spot.mean, bottom), text, _shade(panel, spot, few), spot.method in OURS


def _shade(panel: ChartPanel, spot: Spot, few: bool) -> str:
    return ACCENT if spot.method in OURS else BLACK if spot in panel.front and not few else GREY


def _between(line: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points along a line, where no name may stand."""
    return [
        (float(np.exp((1 - t) * np.log(a[0]) + t * np.log(b[0]))), float((1 - t) * a[1] + t * b[1]))
        for a, b in pairwise(line)
        for t in np.linspace(0, 1, STEPS)
    ]


def _write_labels(
    axes: Axes, labels: Sequence[Label], taken: Sequence[tuple[float, float]] = ()
) -> None:
    """Write names next to their marks, the most important first. A name is written once, at the
    first of its marks with a free place; without one it is left out.

    taken: points in the plot's units where lines run. The axes have their final limits.
    """
    at = [axes.transData.transform(label[:2]) for label in labels]
    boxes: list[Box] = [(x - MARK, y - MARK, x + MARK, y + MARK) for x, y in at]
    boxes += [(x - 1, y - 1, x + 1, y + 1) for x, y in map(axes.transData.transform, taken)]
    left, bottom, right, top = map(float, axes.get_window_extent().extents)
    written: set[str] = set()
    for i, (x, y, text, colour, bold) in enumerate(labels):
        width = LETTER * SMALL * len(text) * (1.1 if bold else 1.0)
        for dx, dy, side in PLACES if text and text not in written else ():
            start = at[i][0] + dx - SIDES[side] * width
            middle = at[i][1] + dy
            box = (start - GAP, middle - 0.5 * SMALL, start + width + GAP, middle + 0.5 * SMALL)
            inside = (
                box[0] >= left and box[2] <= right + 6 and box[1] >= bottom and box[3] <= top + 6
            )
            parts = [box, *(_stroke(at[i], (at[i][0] + dx, middle)) if abs(dy) > FAR else ())]
            others = [other for k, other in enumerate(boxes) if k != i]
            if inside and not any(_meet(part, other) for part in parts for other in others):
                boxes += parts
                written.add(text)
                axes.annotate(
                    text,
                    (x, y),
                    (dx, dy),
                    textcoords="offset points",
                    size=SMALL,
                    va="center",
                    ha=side,
                    color=colour,
                    weight="bold" if bold else "normal",
                    annotation_clip=False,
                    zorder=6,
                    arrowprops=LEADER | {"relpos": (SIDES[side], 0.5)} if abs(dy) > FAR else None,
                )
                break


def _stroke(begin: Iterable[float], end: Iterable[float]) -> list[Box]:
    """Boxes along the stroke from a mark to its name."""
    (x, y), (to_x, to_y) = begin, end
    along = [(x + t * (to_x - x), y + t * (to_y - y)) for t in (0.3, 0.45, 0.6, 0.75, 0.9)]
    return [(px - 1, py - 1, px + 1, py + 1) for px, py in along]


def _meet(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
