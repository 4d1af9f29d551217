"""The chart without scripts: accuracy over cost (SVG), from dots as chart.json has them.

Each network is one mark. Ours are in the accent colour, with a ring around the packaged recipe.
Peers are dark on the front, else grey. Squares are int8, circles float; an arrow joins both
precisions of a network. A network that cannot run on the box is hollow.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from train.models.methods import SHIPPED
from train.reports.formatting import amount, percent
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
from train.studies import accuracy_axis
from train.studies.method_names import OURS
from train.studies.pareto import (
    ACCURACIES,
    COSTS,
    ChartAxis,
    Dot,
    Spot,
    label,
    networks,
    placed,
    subject,
)

HEIGHT, ABOVE, BELOW, FOOT = 3.9, 0.7, 0.5, 0.42
"""Inches: of a panel, above and below its plot, and of the legend."""
HEAD = 33.0
"""Points between a plot and its title, for two lines."""
LETTER = 0.56
"""Width of a letter, in sizes of the text: more than the mean of most fonts."""
MARK = 3.2
"""Half the size of a mark, points."""
RING, FARTHER, GUESSED = 13.5, 1.5, 6.0
"""Points: the ring around the packaged recipe; the additional distance of its name; the space above
the floor for the line of guessing."""
PLACES = [
    (6, 0, "left"),
    (0, 10, "center"),
    (-6, 0, "right"),
    (0, -10, "center"),
    (-4, 8, "right"),
    (5, -8, "left"),
    (5, 8, "left"),
    (-5, -8, "right"),
    (0, 20, "center"),
    (0, -20, "center"),
    (8, 16, "left"),
    (8, -16, "left"),
    (-8, 16, "right"),
    (-8, -16, "right"),
]
"""Places of a name relative to its dot, in points, and its alignment; the best first."""
SIDES = {"left": 0.0, "center": 0.5, "right": 1.0}
"""The side of a name at which its dot is."""
LEADER = {"arrowstyle": "-", "color": ACCENT, "linewidth": 0.9, "shrinkA": 0, "shrinkB": RING / 2}
"""The line from the name of the packaged recipe to its dot."""
Box = tuple[float, float, float, float]


def chart(
    dots: Sequence[Dot],
    panels: Sequence[str] = ("speed", "force"),
    cost: str = "ms_p50",
    accuracies: Mapping[str, ChartAxis] = ACCURACIES,
) -> str:
    """Accuracy over `cost`, a panel for each of `panels` that a dot has."""
    there = [y for y in panels if placed(dots, cost, y)]
    height = HEIGHT * len(there) + FOOT
    figure, chosen = Figure((WIDTH, height), dpi=72), subject(dots)
    for i, y in enumerate(there):
        top = height - i * HEIGHT - ABOVE
        axes = add_axes(figure, 0.105, 0.975, top / height, (top - HEIGHT + ABOVE + BELOW) / height)
        _panel(axes, placed(dots, cost, y), accuracies[y], y, COSTS[cost], chosen)
    for x, row, text, shade in (
        (0.01, 1, "■ int8   ● float   → float to int8   ○ not on the box", GREY),
        (0.01, 0, "━ Pareto front: no other is both better and cheaper", BLACK),
        (0.66, 1, f"■ {OURS}   ◯ shipped{'' if chosen == SHIPPED else ' then'}", ACCENT),
    ):
        figure.text(x, (0.06 + 0.19 * row) / height, text, color=shade, size=SMALL)
    return to_svg(
        figure, f"accuracy over {COSTS[cost].short}, of {len(set(networks(dots)))} models"
    )


def _panel(
    axes: Axes, spots: Sequence[Spot], accuracy: ChartAxis, y: str, cost: ChartAxis, chosen: str
) -> None:
    ends = [x for spot in spots for x, _ in ((spot.x, spot.y), spot.other or (spot.x, 0))]
    axes.set_xscale("log")
    axes.set_xlim(min(ends) / 1.6, max(ends) * 1.6)
    lows = [float(spot.dot["accuracy"][y]["low"]) for spot in spots]
    accuracy_axis.stretch(axes, "y", [*lows, *([accuracy.chance] if accuracy.chance else [])])
    if accuracy.chance:
        accuracy_axis.draw_chance(axes, accuracy.chance)
        axes.annotate(
            f"guessing: {percent(accuracy.chance)}",
            (1, accuracy.chance),
            (0, 3),
            ("axes fraction", "data"),
            textcoords="offset points",
            color=GREY,
            size=SMALL,
            ha="right",
        )
    axes.grid(color=FAINT, linewidth=0.6)
    tens = 10.0 ** np.arange(np.floor(np.log10(min(ends))), np.ceil(np.log10(max(ends))) + 1)
    ticks = [float(t) for t in tens if axes.get_xlim()[0] <= t <= axes.get_xlim()[1]]
    set_ticks(
        axes.xaxis, ticks or [float(f"{min(ends):.1g}")], cost.unit
    )  # a single dot may have no power of ten in reach
    axes.set_xlabel(f"← {cost.short}", color=GREY, size=SMALL, labelpad=4)
    _head(axes, spots, f"Named rightly: {accuracy.short}", cost, chosen)
    best = [spot for spot in spots if spot.best]
    edge = [axes.get_xlim()[1]]
    stairs = np.array([[s.x for s in best] + edge, [s.y for s in best] + [best[-1].y]])
    axes.step(*stairs, where="post", color=BLACK, linewidth=1.2)
    for spot in sorted(spots, key=lambda s: s.best):
        _mark(axes, spot, y, chosen)
    _labels(axes, spots, axes.transData.transform(stairs.T), chosen)


def _head(axes: Axes, spots: Sequence[Spot], title: str, cost: ChartAxis, chosen: str) -> None:
    """The title of an axis, and the two main results: the packaged recipe, and the most accurate
    other method."""
    shipped = next((spot for spot in spots if chosen in spot.methods), None)
    peer = max(
        (spot for spot in spots if spot.dot["family"] != OURS),
        key=lambda spot: spot.y,
        default=None,
    )
    axes.set_ylabel(
        title, color=BLACK, size=MEDIUM, weight="bold", rotation=0, ha="left", va="bottom"
    )
    axes.yaxis.set_label_coords(-0.1, 1 + HEAD / axes.get_window_extent().height)
    for up, before, spot in ((21, "", shipped), (9, "best peer, ", peer)):
        if spot:
            text = f"{before}{label(spot.dot)}: {percent(spot.y)} in {amount(spot.x, cost.unit)}"
            axes.annotate(
                text,
                (-0.1, 1),
                (0, up),
                "axes fraction",
                textcoords="offset points",
                color=colour(spot),
                size=SMALL,
            )


def colour(spot: Spot) -> str:
    """Colour of a network's mark."""
    return ACCENT if spot.dot["family"] == OURS else BLACK if spot.best else GREY


def _mark(axes: Axes, spot: Spot, y: str, chosen: str) -> None:
    shade, ends, mine = colour(spot), spot.dot["accuracy"][y], chosen in spot.methods
    strength, int8 = 1.0 if spot.best or mine else 0.6, spot.dot["precision"] == "int8"
    axes.plot(
        [spot.x] * 2, [ends["low"], ends["high"]], color=shade, linewidth=0.9, alpha=0.5 * strength
    )
    if spot.other:
        tail, head = (spot.other, (spot.x, spot.y)) if int8 else ((spot.x, spot.y), spot.other)
        arrow = {"arrowstyle": "->", "color": shade, "linewidth": 1, "alpha": strength}
        axes.annotate(
            "", head, tail, arrowprops=arrow | {"shrinkA": 0, "shrinkB": MARK if int8 else 0}
        )
    look: dict[str, Any] = {"color": shade, "clip_on": False}
    axes.plot(
        spot.x,
        spot.y,
        "s" if int8 else "o",
        markersize=2 * MARK,
        markeredgewidth=1.2,
        alpha=strength,
        markerfacecolor=shade if spot.on_box else WHITE,
        zorder=3 + spot.best,
        **look,
    )
    if mine:
        axes.plot(
            spot.x,
            spot.y,
            "o",
            markersize=RING,
            markeredgewidth=1.4,
            markerfacecolor="none",
            **look,
        )


def _labels(axes: Axes, spots: Sequence[Spot], stairs: NDArray[Any], chosen: str) -> None:
    """Names beside the dots, each once, the packaged recipe first. A name without a free place is
    left out.

    stairs [n, 2]: the front's corners, in points.
    """
    at = [axes.transData.transform((spot.x, spot.y)) for spot in spots]
    taken: list[Box] = [(x - MARK, y - MARK, x + MARK, y + MARK) for x, y in at]
    taken += [(x, y - 1, end, y + 1) for (x, y), (end, _) in pairwise(stairs)]
    taken += [(end - 1, y, end + 1, up) for (_, y), (end, up) in pairwise(stairs)]
    for spot, (x, y) in zip(spots, at, strict=True):
        if spot.other:  # its arrow
            to_x, to_y = axes.transData.transform(spot.other)
            taken.append((min(x, to_x), min(y, to_y) - 2, max(x, to_x), max(y, to_y) + 2))
    left, bottom, right, top = map(float, axes.get_window_extent().extents)
    frame: Box = (left, bottom + GUESSED, right, top)
    taken.append(
        (right - 80, bottom, right, bottom + GUESSED + 12)
    )  # where it says what guessing reaches
    for i in _important(spots, chosen):
        _name(axes, spots[i], at[i], taken, i, frame, chosen)


def _name(
    axes: Axes, spot: Spot, at: NDArray[Any], taken: list[Box], own: int, frame: Box, chosen: str
) -> None:
    """The name of a spot at the first free one of PLACES, which is then taken. own: number of its
    mark in `taken`."""
    mine = chosen in spot.methods
    text, far = label(spot.dot, short=not mine), FARTHER if mine else 1.0
    width = LETTER * SMALL * len(text) * (1.12 if mine else 1.0)
    for dx, dy, side in PLACES:
        box = _box(at[0], at[1], far * dx, far * dy, side, width, SMALL)
        if _inside(box, frame) and not any(
            _meet(box, other) for k, other in enumerate(taken) if k != own
        ):
            taken.append(box)
            axes.annotate(
                text,
                (spot.x, spot.y),
                (far * dx, far * dy),
                textcoords="offset points",
                size=SMALL,
                va="center",
                ha=side,
                color=colour(spot),
                weight="bold" if mine else "normal",
                annotation_clip=False,
                zorder=6,
                arrowprops=LEADER | {"relpos": (SIDES[side], 0.5)} if mine else None,
            )
            return


def _important(spots: Sequence[Spot], chosen: str) -> Iterator[int]:
    """Indices of the spots in the order in which they get names: the packaged recipe, the front,
    the best of each family, the rest."""
    families: dict[str, int] = {}
    for i, spot in enumerate(spots):
        if spot.y > spots[families.setdefault(spot.dot["family"], i)].y:
            families[spot.dot["family"]] = i
    shipped = [i for i, spot in enumerate(spots) if chosen in spot.methods]
    leading = [i for i, spot in enumerate(spots) if spot.best]
    yield from dict.fromkeys(
        [
            *shipped,
            *leading,
            *families.values(),
            *sorted(range(len(spots)), key=lambda i: -spots[i].y),
        ]
    )


def _box(x: float, y: float, dx: float, dy: float, side: str, width: float, size: float) -> Box:
    left = x + dx - SIDES[side] * width
    return left, y + dy - 0.45 * size, left + width, y + dy + 0.45 * size


def _inside(box: Box, frame: Box) -> bool:
    return (
        box[0] >= frame[0]
        and box[2] <= frame[2] + 4
        and box[1] >= frame[1]
        and box[3] <= frame[3] + 4
    )


def _meet(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
