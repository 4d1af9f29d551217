"""Pictures of results (SVG) for evaluate and the study `paper`.

Our results are in the accent colour, values printed in the paper are hollow diamonds; all else is
grey.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from palpate_studies.method_names import plain_name
from palpate_train.reports.confusion_plot import STRONGEST, shade
from palpate_train.reports.formatting import exact_percent, interval, percent
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
    set_ticks,
    set_titles,
    single_axes,
    tiles,
    to_svg,
    write,
)

Array = NDArray[Any]
Estimate = tuple[float, float, float]
"""Share, lower and upper end of its 95 % interval."""
Grid = Mapping[tuple[str, str], Estimate]
"""By row and column."""
MEANS = {True: "without each taxel’s mean over the window", False: "as recorded, means and all"}
"""Titles of the panels of `matrix`."""
PRINTED: dict[str, Any] = {
    "marker": "D",
    "markersize": 5.5,
    "markerfacecolor": WHITE,
    "markeredgecolor": BLACK,
    "linestyle": "none",
}
STRONG: tuple[dict[str, Any], ...] = (
    {"color": ACCENT, "linewidth": 2.0},
    {"color": BLACK, "linewidth": 1.6, "linestyle": (0, (3, 1.5))},
)
THIN: dict[str, Any] = {"color": GREY, "linewidth": 0.6, "alpha": 0.6}


@dataclass(frozen=True)
class Bar:
    """One row of `bars`: our result, and the value printed in the paper, if there is one."""

    name: str
    ours: Estimate
    printed: float | None = None


def bars(groups: Mapping[str, Sequence[Bar]], about: str, chance: float = 0.0) -> str:
    """Bars with 95 % intervals, printed values as marks, and both as numbers beside them.

    groups: rows by heading ("" for none). chance: accuracy of guessing, drawn as a line.
    """
    lines = [
        line
        for heading, rows in groups.items()
        for line in ([heading] if heading else []) + list(rows)
    ]
    figure, axes = single_axes(
        len(lines) * 0.29 + 0.75, left=0.21, right=0.63, top=0.32, bottom=0.43
    )
    for y, line in enumerate(lines):
        if isinstance(line, str):
            write(axes, -0.48, y, line, ha="left", weight="bold")
        else:
            _bar(axes, y, line)
    for x, text, side in ((1.04, "ours, 95 %", "left"), (1.87, "◇ printed", "right")):
        write(axes, x, -0.9, text, GREY, SMALL, ha=side)
    axes.set_ylim(len(lines) - 0.5, -0.55)
    axes.set_xlim(0, 1)
    axes.grid(axis="x", color=FAINT, linewidth=0.7)
    set_ticks(axes.xaxis, [0, 0.25, 0.5, 0.75, 1], percent=True)
    set_ticks(axes.yaxis, [])
    set_titles(axes, "sweeps named rightly")
    if chance:
        axes.axvline(chance, color=GREY, linewidth=1, linestyle=(0, (2, 2)))
        write(axes, chance, -0.9, "random guess", GREY, SMALL)
    return to_svg(figure, about)


def _bar(axes: Axes, y: float, bar: Bar) -> None:
    mean, low, high = bar.ours
    axes.barh(y, mean, 0.62, color=ACCENT, alpha=STRONGEST, linewidth=0)
    axes.plot([low, high], [y, y], color=BLACK, linewidth=1.4)
    write(axes, -0.03, y, bar.name, ha="right")
    write(axes, 1.04, y, percent(mean, 0), ACCENT, ha="left", weight="bold")
    write(axes, 1.31, y, interval((low, high), 0), GREY, SMALL, ha="left")
    if bar.printed is not None:
        axes.plot(bar.printed, y, zorder=3, **PRINTED)
        write(axes, 1.87, y, exact_percent(bar.printed), ha="right")


def curve(costs: Sequence[Array], printed: Sequence[tuple[int, float]], about: str) -> str:
    """Cost over iterations, both logarithmic: each fold thin, the median strong.

    costs: [n, 2] each, as Fold.cost. printed: marks (iteration, cost).
    """
    figure, axes = single_axes(2.9, left=0.14, right=0.97, top=0.25, bottom=0.45)
    folds = [np.maximum(cost, [1, 1e-5]) for cost in costs if len(cost)]
    for cost in folds:
        axes.plot(*cost.T, **THIN)
    if folds:
        _median(axes, folds)
    for at in printed:
        axes.plot(*at, zorder=3, **PRINTED)
        axes.annotate(
            f"{at[1]:g}",
            at,
            (0, 7),
            textcoords="offset points",
            color=BLACK,
            size=SMALL,
            ha="center",
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(1, 6000)
    axes.set_ylim(min([1e-3, *(cost[:, 1].min() / 2 for cost in folds)]), 6)
    axes.grid(color=FAINT, linewidth=0.6)
    set_ticks(axes.xaxis, [1, 10, 100, 1000, 4000])
    set_ticks(
        axes.yaxis,
        [tick for tick in (1e-5, 1e-4, 1e-3, 0.01, 0.1, 1) if tick >= axes.get_ylim()[0]],
    )
    set_titles(axes, "iteration", "cross entropy   ◇ printed")
    return to_svg(figure, about)


def _median(axes: Axes, folds: Sequence[Array]) -> None:
    """The median of the curves [n, 2] over their common length, with its name at the end."""
    n = min(map(len, folds))
    median = np.median([cost[:n] for cost in folds], axis=0)
    axes.plot(*median.T, **STRONG[0])
    late = median[-1, 0] > 1500
    axes.annotate(
        "ours",
        median[-1],
        (0, 7) if late else (0, -7),
        textcoords="offset points",
        color=ACCENT,
        size=MEDIUM,
        va="bottom" if late else "top",
        ha="right" if late else "center",
    )


def sweeps(
    ours: Mapping[str, Mapping[str, Sequence[Estimate]]],
    printed: Mapping[str, Sequence[float | None]],
    about: str,
) -> str:
    """A panel for each method: accuracy after one, two, three … sweeps, by "product" and by
    "vote"."""
    lowest = min(e[1] for rules in ours.values() for line in rules.values() for e in line)
    bottom, figure = max(np.floor(lowest * 10) / 10, 0), Figure((WIDTH, 2.7))
    for i, (name, rules) in enumerate(ours.items()):
        left = 0.09 + 0.91 * i / len(ours)
        axes = add_axes(figure, left, left + 0.91 / len(ours) - 0.04, top=0.86, bottom=0.24)
        count = _fusion_panel(axes, rules, printed.get(name, ()))
        axes.set_title(name, color=BLACK, size=MEDIUM, loc="left", pad=6)
        axes.set_xlim(0.7, count + 0.3)
        axes.set_ylim(bottom, 1.04)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        set_ticks(axes.xaxis, range(1, count + 1))
        set_ticks(
            axes.yaxis,
            np.arange(bottom, 1.01, 0.1 if bottom > 0.3 else 0.2),
            percent=True,
            bare=i > 0,
        )
    line: dict[str, Any] = {"y": 0.1, "va": "center", "ha": "left", "color": GREY, "size": SMALL}
    figure.supxlabel("sweeps of one tube to the right,", x=0.09, **line)
    figure.supylabel("share named rightly upwards", x=0.51, rotation=0, **line)
    for x, text, colour in (
        (0.09, "● product", ACCENT),
        (0.4, "● vote", GREY),
        (0.65, "◇ printed", BLACK),
    ):
        figure.text(x, 0.02, text, color=colour, size=SMALL)
    return to_svg(figure, about)


def _fusion_panel(
    axes: Axes, rules: Mapping[str, Sequence[Estimate]], printed: Sequence[float | None]
) -> int:
    """Draw both rules of one method, and marks of printed values; the largest number of sweeps."""
    looks: dict[str, tuple[dict[str, Any], int]] = {
        "vote": ({"color": GREY, "linewidth": 1.4}, -12),
        "product": (STRONG[0], 7),
    }
    for rule, (look, away) in looks.items():
        mean, low, high = np.array(rules[rule]).T
        n = np.arange(1, len(mean) + 1)
        axes.fill_between(n, low, high, color=look["color"], alpha=0.07, linewidth=0)
        axes.plot(n, mean, marker="o", markersize=3, **look)
        for at in list(zip(n, mean, strict=True))[
            rule == "vote" :
        ]:  # one sweep is the same by both
            axes.annotate(
                f"{100 * at[1]:.0f}",
                at,
                (0, away),
                textcoords="offset points",
                color=look["color"],
                size=SMALL,
                ha="center",
            )
    for count, value in enumerate(printed, 1):
        if value is not None:
            axes.plot(count, value, zorder=3, **PRINTED)
    return len(rules["product"])


def matrix(
    results: Sequence[Mapping[str, Any]], about: str = "methods by protocols", count: str = "window"
) -> str:
    """Methods x protocols from the list that `evaluate` writes: a panel without each window's
    means, one with them.

    Each cell is the mean over seeds. count: "window" or "recording". Sets differ by their number of
    materials.
    """
    panels: dict[str, dict[tuple[str, str], list[Estimate]]] = {}
    for result in sorted(
        results, key=lambda r: (not r["means_removed"], _ease(r["protocol"]), -len(r["materials"]))
    ):
        ends = result["interval" if count == "window" else "recording_interval"]
        column = f"{_left_out(result['protocol'])}\n{len(result['materials'])} classes"
        panel = panels.setdefault(MEANS[result["means_removed"]], {})
        share = result[count]["right"] / result[count]["total"]
        panel.setdefault((plain_name(result["method"]), column), []).append((share, *ends))
    means = {
        title: {at: _mean(seeds) for at, seeds in cells.items()} for title, cells in panels.items()
    }
    return grid(means, about)


def _left_out(protocol: str) -> str:
    """The condition that a protocol leaves out, in two lines."""
    kind, _, name = protocol.partition(":")
    name = {"rep": "repetition"}.get(name, name.split("=")[0])
    return {"leave": f"{name}\nleft out", "split": f"split by\n{name}", "random": "random\nparts"}[
        kind
    ]


def _mean(seeds: Sequence[Estimate]) -> Estimate:
    share, low, high = (float(value) for value in np.mean(seeds, 0))
    return share, low, high


def grid(panels: Mapping[str, Grid], about: str) -> str:
    """A table of rows x columns for each panel: per cent with intervals, more in a deeper colour.

    Columns keep their order, so give the hard ones first. The best rows of the first panel are on
    top.
    """
    first = next(iter(panels.values()))
    names = list(dict.fromkeys(row for panel in panels.values() for row, _ in panel))
    means = {
        name: np.mean([e[0] for (row, _), e in first.items() if row == name] or [0])
        for name in names
    }
    names.sort(key=lambda name: -means[name])
    above, below = 0.75, 0.34 * len(names)
    figure = Figure((WIDTH, (above + below) * len(panels) + 0.05))
    inch = 1 / figure.get_figheight()
    for p, (title, panel) in enumerate(panels.items()):
        top = 1 - inch * ((above + below) * p + above)
        axes = add_axes(figure, 0.31, 0.995, top, top - inch * below)
        figure.text(
            0.01, top + inch * (above - 0.22), title, color=BLACK, size=MEDIUM, weight="bold"
        )
        _table(axes, panel, names)
    return to_svg(figure, about)


def _table(axes: Axes, panel: Grid, names: Sequence[str]) -> None:
    columns = list(dict.fromkeys(column for _, column in panel))
    for j, column in enumerate(columns):
        write(axes, j + 0.5, -0.15, column, GREY, SMALL - (len(columns) > 5), va="bottom")
    for i, name in enumerate(names):
        write(axes, -0.02 * len(columns), i + 0.5, name, size=SMALL + 0.5, ha="right")
        for j, column in enumerate(columns):
            if (name, column) in panel:
                _cell(axes, i, j, panel[name, column])
    tiles(axes, len(names), len(columns))


def _ease(protocol: str) -> int:
    """Sort key: hard protocols first."""
    return ("leave", "split", "random").index(protocol.split(":")[0])


def _cell(axes: Axes, i: int, j: int, estimate: Estimate) -> None:
    """Row i, column j: the share on its shade, the interval below it."""
    mean, low, high = (f"{100 * value:.0f}" for value in estimate)
    shade(axes, i, j, estimate[0] ** 2)
    write(axes, j + 0.5, i + 0.34, mean)
    write(axes, j + 0.5, i + 0.76, f"{low}–{high}", size=SMALL - 1)
