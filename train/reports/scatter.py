"""The chart without scripts: accuracy over time per sweep. In: dots, as chart.json lists them. Out: SVG text.

On the Pareto front our models are in the accent colour and all others dark; what another dot beats in both is grey.
Squares are int8, circles float; what cannot run on the box is hollow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from train.models.methods import SHIPPED
from train.reports.pareto import ACCURACIES, COSTS, Dot, placed
from train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    MEDIUM,
    SMALL,
    WHITE,
    WIDTH,
    add_axes,
    set_ticks,
    to_svg,
)

OURS = "Palpate"
HEIGHT, ABOVE, BELOW, FOOT = 2.9, 0.36, 0.34, 0.42
"""Inches: of a panel, above and below its plot, and of the legend."""
LETTER = 0.56
"""Width of a letter, in sizes of the text: more than the mean of most fonts."""
MARK = 3.2
"""Half of a mark, points."""
PLACES = [(0, 10, "center"), (6, 0, "left"), (-6, 0, "right"), (0, -10, "center"), (-4, 8, "right"), (5, -8, "left"),
          (5, 8, "left"), (-5, -8, "right"), (0, 20, "center"), (0, -20, "center"), (8, 16, "left"), (8, -16, "left"),
          (-8, 16, "right"), (-8, -16, "right")]  # fmt: skip
"""Where a name may stand, points from its dot, and its alignment; the best first."""
SHORT = {SHIPPED: "Palpate, as shipped", "minirocket-augmented": "MiniRocket, augmented", "quant": "QUANT", "ds-cnn": "DS-CNN",
         "lite": "LITE", "multirocket-hydra": "MultiRocket-Hydra", "paper-cnn": "paper’s CNN, raw", "paper-cnn-centred": "paper’s CNN",
         "minirocket": "MiniRocket", "tactnet2": "TactNet-II", "st-hmp": "ST-HMP"}  # fmt: skip
Box = tuple[float, float, float, float]
Spot = tuple[Dot, float, float, bool]


def chart(dots: Sequence[Dot], panels: Sequence[str] = ("speed", "force"), cost: str = "ms_p50") -> str:
    """Accuracy over `cost`, a panel for each of `panels` that some dot has."""
    there = [y for y in panels if placed(dots, cost, y)]
    height = HEIGHT * len(there) + FOOT
    figure = Figure((WIDTH, height), dpi=72)
    for i, y in enumerate(there):
        top = height - i * HEIGHT - ABOVE
        axes = add_axes(figure, 0.085, 0.985, top / height, (top - HEIGHT + ABOVE + BELOW) / height)
        _panel(axes, placed(dots, cost, y), y, cost)
    for x, row, text, colour in (
        (0.01, 1, "■ int8   ● float   ○ cannot run on the box", GREY),
        (0.01, 0, "━ Pareto front: nothing is better in both", BLACK),
        (0.6, 0, "■ Palpate, by weights", ACCENT),
    ):
        figure.text(x, (0.06 + 0.19 * row) / height, text, color=colour, size=SMALL)
    return to_svg(figure, f"accuracy over {COSTS[cost].short} of {len(dots)} models")


def _panel(axes: Axes, spots: Sequence[Spot], y: str, cost: str) -> None:
    x = np.array([spot[1] for spot in spots])
    low = min(spot[0]["accuracy"][y]["low"] for spot in spots)
    axes.set_xscale("log")
    axes.set_xlim(x.min() / 1.4, x.max() * 1.4)
    bottom = max(np.floor(low * 10) / 10, 0)
    axes.set_ylim(bottom - 0.04 * (1 - bottom), 1.01)
    axes.grid(color=FAINT, linewidth=0.6)
    tens = 10.0 ** np.arange(np.floor(np.log10(x.min())), np.ceil(np.log10(x.max())) + 1)
    ticks = [k * t for t in tens for k in (1, 3) if axes.get_xlim()[0] <= k * t <= axes.get_xlim()[1]]
    ticks = ticks or [float(f"{x.min():.1g}")]  # a single dot may have neither 1 nor 3 times a power of ten in reach
    axis = COSTS[cost]
    set_ticks(axes.xaxis, ticks, axis.unit)
    set_ticks(axes.yaxis, np.arange(bottom, 1.001, 0.1 if bottom >= 0.4 else 0.2), percent=True)
    axes.set_title(ACCURACIES[y].short, color=BLACK, size=MEDIUM, weight="bold", loc="left", pad=6)
    axes.set_title(f"share right, over {axis.short}", color=GREY, size=SMALL, loc="right", pad=6)
    best = [spot for spot in spots if spot[3]]
    edge = [axes.get_xlim()[1]]
    stairs = np.array([[s[1] for s in best] + edge, [s[2] for s in best] + [best[-1][2]]])
    axes.step(*stairs, where="post", color=BLACK, linewidth=1.2)
    for spot in sorted(spots, key=lambda s: s[3]):
        _mark(axes, spot, y)
    _labels(axes, spots, axes.transData.transform(stairs.T))


def colour(dot: Dot, best: bool) -> str:
    """Of a dot's mark."""
    ours = dot["family"] == OURS
    return (ACCENT if ours else BLACK) if best else ACCENT if dot["method"] == SHIPPED else GREY


def _mark(axes: Axes, spot: Spot, y: str) -> None:
    dot, at, mean, best = spot
    shade, ends = colour(dot, best), dot["accuracy"][y]
    strength = 1.0 if best or dot["method"] == SHIPPED else 0.55
    axes.plot([at, at], [ends["low"], ends["high"]], color=shade, linewidth=0.9, alpha=0.45 if best else 0.3)
    axes.plot(at, mean, "s" if dot["precision"] == "int8" else "o", markersize=2 * MARK, markeredgewidth=1.2,
              color=shade, markerfacecolor=shade if dot["runs_on_box"] else WHITE, alpha=strength, zorder=3 + best)  # fmt: skip


def _labels(axes: Axes, spots: Sequence[Spot], stairs: NDArray[Any]) -> None:
    """Names beside the dots, those of the front first, each once; a name that fits nowhere is left out.

    stairs [n, 2]: the front's corners, in points.
    """
    at = [axes.transData.transform((spot[1], spot[2])) for spot in spots]
    taken: list[Box] = [(x - MARK, y - MARK, x + MARK, y + MARK) for x, y in at]
    taken += [(x, y - 1, end, y + 1) for (x, y), (end, _) in pairwise(stairs)]
    taken += [(end - 1, y, end + 1, up) for (_, y), (end, up) in pairwise(stairs)]
    named: set[str] = set()
    leading = {label(spot[0]) for spot in spots if spot[3]}
    left, bottom, right, top = map(float, axes.get_window_extent().extents)
    frame: Box = (left, bottom, right, top)
    for i in _important(spots):
        text, size, shade = label(spots[i][0]), SMALL, colour(spots[i][0], spots[i][3])
        if text in named or (text in leading and not spots[i][3]):
            continue
        for dx, dy, side in PLACES:
            box = _box(at[i][0], at[i][1], dx, dy, side, LETTER * size * len(text), size)
            if _inside(box, frame) and not any(_meet(box, other) for k, other in enumerate(taken) if k != i):
                taken.append(box)
                named.add(text)
                axes.annotate(text, spots[i][1:3], (dx, dy), textcoords="offset points", size=size, va="center",
                              ha=side, color=shade, annotation_clip=False, zorder=6)  # fmt: skip
                break


def label(dot: Dot) -> str:
    """A short name: of our models the size alone, without the precision, which the mark shows."""
    method = str(dot["method"]).removeprefix("compact-" if dot["family"] == OURS else "")
    return SHORT.get(method, method)


def _important(spots: Sequence[Spot]) -> Iterator[int]:
    """Indices of the dots in the order in which they get names: what ships, the front, the best of each family, the rest."""
    families: dict[str, int] = {}
    for i, (dot, _, mean, _) in enumerate(spots):
        if mean > spots[families.setdefault(dot["family"], i)][2]:
            families[dot["family"]] = i
    front, leading = [i for i, spot in enumerate(spots) if spot[3]], list(families.values())
    shipped = [i for i, spot in enumerate(spots) if spot[0]["method"] == SHIPPED]
    yield from dict.fromkeys([*shipped, *front, *leading, *sorted(range(len(spots)), key=lambda i: -spots[i][2])])


def _box(x: float, y: float, dx: float, dy: float, side: str, width: float, size: float) -> Box:
    left = x + dx - {"left": 0.0, "center": 0.5, "right": 1.0}[side] * width
    return left, y + dy - 0.45 * size, left + width, y + dy + 0.45 * size


def _inside(box: Box, frame: Box) -> bool:
    return box[0] >= frame[0] and box[2] <= frame[2] + 4 and box[1] >= frame[1] and box[3] <= frame[3] + 4


def _meet(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
