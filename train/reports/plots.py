"""The room of pictures. In: numbers, as evaluate, paper and stress give them. Out: SVG text.

Ours is in the accent colour, what the paper printed a hollow diamond; all else is grey.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from train.reports.plot_style import (
    ACCENT,
    FAINT,
    GREY,
    INK,
    PAPER,
    SMALL,
    TEXT,
    WIDTH,
    add,
    field,
    scale,
    share,
    svg,
    tiles,
    write,
)

Array = NDArray[Any]
Estimate = tuple[float, float, float]
"""Share, lower and upper end of its 95 % interval."""
Grid = Mapping[tuple[str, str], Estimate]
"""By row and column."""
STRONGEST = 0.6  # of the accent colour behind a number: ink stays readable on it, by day and by night
PRINTED = {"marker": "D", "markersize": 5.5, "markerfacecolor": PAPER, "markeredgecolor": INK, "linestyle": "none"}
STRONG = ({"color": ACCENT, "linewidth": 2.0}, {"color": INK, "linewidth": 1.6, "linestyle": (0, (3, 1.5))})
THIN = {"color": GREY, "linewidth": 0.6, "alpha": 0.6}


@dataclass(frozen=True)
class Bar:
    """One row of `bars`: ours, and what the paper printed, where it did."""

    name: str
    ours: Estimate
    printed: float | None = None


def bars(groups: Mapping[str, Sequence[Bar]], about: str, chance: float = 0.0) -> str:
    """Bars with 95 % intervals; printed values as marks, and both as numbers beside them. chance: of a guess, a line.

    groups: rows by heading ("" for none).
    """
    lines = [line for heading, rows in groups.items() for line in ([heading] if heading else []) + list(rows)]
    figure, axes = field(len(lines) * 0.29 + 0.6, left=0.21, right=0.63, top=0.32, bottom=0.28)
    for y, line in enumerate(lines):
        if isinstance(line, str):
            write(axes, -0.48, y, line, ha="left", weight="bold")
            continue
        mean, low, high = line.ours
        axes.barh(y, mean, 0.62, color=ACCENT, alpha=STRONGEST, linewidth=0)
        axes.plot([low, high], [y, y], color=INK, linewidth=1.4)
        write(axes, -0.03, y, line.name, ha="right")
        write(axes, 1.04, y, share(mean), ACCENT, ha="left", weight="bold")
        write(axes, 1.22, y, f"{share(low)} – {share(high)}", GREY, SMALL, ha="left")
        if line.printed is not None:
            axes.plot(line.printed, y, zorder=3, **PRINTED)
            write(axes, 1.87, y, share(line.printed), ha="right")
    for x, text, side in ((1.04, "ours, 95 %", "left"), (1.87, "◇ printed", "right")):
        write(axes, x, -0.9, text, GREY, SMALL, ha=side)
    axes.set_ylim(len(lines) - 0.5, -0.55)
    axes.set_xlim(0, 1)
    axes.grid(axis="x", color=FAINT, linewidth=0.7)
    scale(axes.xaxis, [0, 0.25, 0.5, 0.75, 1])
    scale(axes.yaxis, [])
    if chance:
        axes.axvline(chance, color=GREY, linewidth=1, linestyle=(0, (2, 2)))
        write(axes, chance, -0.9, "a guess", GREY, SMALL)
    return svg(figure, about)


def curve(costs: Sequence[Array], printed: Sequence[tuple[int, float]], about: str) -> str:
    """Cost over iterations, both logarithmic: each fold thin, the median strong. costs: [n, 2] each, as Fold.cost.

    printed: marks (iteration, cost).
    """
    figure, axes = field(2.9, left=0.12, right=0.97, top=0.25, bottom=0.45)
    folds = [np.maximum(cost, [1, 1e-5]) for cost in costs if len(cost)]
    for cost in folds:
        axes.plot(*cost.T, **THIN)
    if folds:
        n = min(map(len, folds))
        middle = np.median([cost[:n] for cost in folds], axis=0)
        axes.plot(*middle.T, **STRONG[0])
        late = middle[-1, 0] > 1500
        axes.annotate("ours", middle[-1], (0, 7) if late else (6, 0), textcoords="offset points", color=ACCENT,
                      size=TEXT, va="bottom" if late else "center", ha="right" if late else "left")  # fmt: skip
    for at in printed:
        axes.plot(*at, zorder=3, **PRINTED)
        said = f"{at[1]:g}".removeprefix("0")
        axes.annotate(said, at, (0, 7), textcoords="offset points", color=INK, size=SMALL, ha="center")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(1, 6000)
    axes.set_ylim(min([1e-3, *(cost[:, 1].min() / 2 for cost in folds)]), 6)
    axes.grid(color=FAINT, linewidth=0.6)
    scale(axes.xaxis, [1, 10, 100, 1000, 4000])
    scale(axes.yaxis, tens := [k for k in (1e-5, 1e-4, 1e-3, 0.01, 0.1, 1) if k >= axes.get_ylim()[0]],
          [f"{k:.5f}".strip("0").rstrip(".") for k in tens])  # fmt: skip
    axes.set_xlabel("iteration", color=GREY, size=SMALL)
    axes.set_title("cross entropy of a batch   ◇ printed", color=GREY, size=SMALL, loc="left", pad=5)
    return svg(figure, about)


def confusion(matrix: Array, names: Sequence[str], about: str, printed: Array | None = None) -> str:
    """Counts or shares [K, K], rows the truth: each row's shares, and below them small what the paper printed."""
    k = len(names)
    rows = np.asarray(matrix, float) / np.maximum(np.sum(matrix, 1, keepdims=True), 1e-9)
    figure, axes = field(0.6 + (0.36 if printed is None else 0.47) * k, left=0.25, right=0.995, top=0.55, bottom=0.05)
    for i, j in np.ndindex(k, k):
        _shade(axes, i, j, rows[i, j])
        there = rows[i, j] >= 0.005
        write(axes, j + 0.5, i + (0.5 if printed is None else 0.36), share(rows[i, j]) if there else "·",
              INK if there else GREY, weight="bold" if i == j else "normal")  # fmt: skip
        if printed is not None and printed[i][j] > 0:
            write(axes, j + 0.5, i + 0.76, f"◇ {share(printed[i][j])}", size=SMALL - 1)
    for i, name in enumerate(names):
        write(axes, -0.03 * k, i + 0.5, name, size=SMALL + 0.5, ha="right")
        write(axes, i + 0.5, -0.12, name.replace(" ", "\n"), size=SMALL, va="bottom")
    write(axes, -0.03 * k, -0.12, "is ↓  named →", GREY, SMALL, ha="right", va="bottom")
    tiles(axes, k, k)
    return svg(figure, about)


def sweeps(
    ours: Mapping[str, Mapping[str, Sequence[Estimate]]], printed: Mapping[str, Sequence[float | None]], about: str
) -> str:
    """A panel for each method: share right after one, two, three … sweeps, by "product" and by "vote"."""
    lowest = min(e[1] for rules in ours.values() for line in rules.values() for e in line)
    bottom, figure = max(np.floor(lowest * 10) / 10, 0), Figure((WIDTH, 2.5))
    for i, (name, rules) in enumerate(ours.items()):
        left = 0.075 + 0.925 * i / len(ours)
        axes = add(figure, left, left + 0.925 / len(ours) - 0.04, top=0.86, bottom=0.18)
        for rule, look, away in (("vote", {"color": GREY, "linewidth": 1.4}, -12), ("product", STRONG[0], 7)):
            mean, low, high = np.array(rules[rule]).T
            n = np.arange(1, len(mean) + 1)
            axes.fill_between(n, low, high, color=look["color"], alpha=0.13, linewidth=0)
            axes.plot(n, mean, marker="o", markersize=3, **look)
            for at in list(zip(n, mean, strict=True))[rule == "vote" :]:  # one sweep is the same by both
                axes.annotate(share(at[1]), at, (0, away), textcoords="offset points", color=look["color"], size=SMALL,
                              ha="center")  # fmt: skip
        for at in enumerate(printed.get(name, ()), 1):
            if at[1] is not None:
                axes.plot(*at, zorder=3, **PRINTED)
        axes.set_title(name, color=INK, size=TEXT, loc="left", pad=6)
        axes.set_xlim(0.7, len(n) + 0.3)
        axes.set_ylim(bottom, 1.04)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        scale(axes.xaxis, n)
        scale(axes.yaxis, np.arange(bottom, 1.01, 0.1 if bottom > 0.3 else 0.2), [] if i else None)
    for x, text, colour in (
        (0.0, "sweeps", GREY),
        (0.4, "● product", ACCENT),
        (0.62, "● vote", GREY),
        (0.78, "◇ printed", INK),
    ):
        figure.text(x, 0.02, text, color=colour, size=SMALL)
    return svg(figure, about)


def matrix(results: Sequence[Mapping[str, Any]], about: str = "methods by protocols", count: str = "window") -> str:
    """Methods x protocols from the list that `evaluate` writes: a panel without each window's means, one with them.

    Each cell is the mean over seeds. count: "window" or "recording". Sets are told apart by their number of materials.
    """
    held: dict[str, dict[tuple[str, str], list[Estimate]]] = {}
    for told in sorted(results, key=lambda r: (not r["means_removed"], _ease(r["protocol"]), -len(r["materials"]))):
        ends = told["interval" if count == "window" else "recording_interval"]
        kind, _, name = told["protocol"].partition(":")
        column = f"{kind}\n{name.split('=')[0]}\n{len(told['materials'])} classes"
        panel = held.setdefault("means removed" if told["means_removed"] else "means kept", {})
        panel.setdefault((told["method"], column), []).append((told[count]["right"] / told[count]["total"], *ends))
    return grid({title: {at: tuple(np.mean(v, 0)) for at, v in cells.items()} for title, cells in held.items()}, about)


def grid(panels: Mapping[str, Grid], about: str) -> str:
    """Per cent with intervals in a table of rows x columns for each panel; deeper colour for more.

    Columns as they come, so put the hard ones first; rows with the best of the first panel on top.
    """
    first = next(iter(panels.values()))
    names = list(dict.fromkeys(row for panel in panels.values() for row, _ in panel))
    means = {name: np.mean([e[0] for (row, _), e in first.items() if row == name] or [0]) for name in names}
    names.sort(key=lambda name: -means[name])
    above, below = 0.75, 0.34 * len(names)
    figure = Figure((WIDTH, (above + below) * len(panels) + 0.05))
    inch = 1 / figure.get_figheight()
    for p, (title, panel) in enumerate(panels.items()):
        columns = list(dict.fromkeys(column for _, column in panel))
        top = 1 - inch * ((above + below) * p + above)
        axes = add(figure, 0.265, 0.995, top, top - inch * below)
        figure.text(0.01, top + inch * (above - 0.22), title, color=INK, size=TEXT, weight="bold")
        for j, column in enumerate(columns):
            write(axes, j + 0.5, -0.15, column, GREY, SMALL - (len(columns) > 5), va="bottom")
        for i, name in enumerate(names):
            write(axes, -0.02 * len(columns), i + 0.5, name, size=SMALL + 0.5, ha="right")
            for j, column in enumerate(columns):
                if (name, column) in panel:
                    _cell(axes, i, j, panel[name, column])
        tiles(axes, len(names), len(columns))
    return svg(figure, about)


def stress(
    told: Mapping[str, Any], strong: Sequence[str], about: str = "methods under stress", columns: int = 3
) -> str:
    """What train.stress.merge gives: share right over severity, a small picture for each stress.

    strong: two methods at most that are shown with their bands; all others are thin.
    """
    curves = {name: entry["curves"] for name, entry in told["methods"].items() if entry["curves"]}
    looks = dict(zip([name for name in strong if name in curves], STRONG, strict=False))
    named = list(dict.fromkeys(name for those in curves.values() for name in those))
    rows, above, each = -(-len(named) // columns), 0.3, 1.36
    figure = Figure((WIDTH, above + rows * each))
    inch = 1 / figure.get_figheight()
    for i, (text, colour) in enumerate(
        [(f"{mark} {name}", look["color"]) for mark, (name, look) in zip("━╍", looks.items(), strict=False)]
        + [("thin: the others", GREY)]
    ):
        figure.text(0.01 + 0.3 * i, 1 - 0.16 * inch, text, color=colour, size=SMALL + 0.5)
    for i, name in enumerate(named):
        row, column = divmod(i, columns)
        left, bottom = 0.07 + 0.93 * column / columns, ((rows - 1 - row) * each + 0.38) * inch
        axes = add(figure, left, left + 0.93 / columns - 0.045, bottom + 0.72 * inch, bottom)
        _lines(axes, name, {method: those[name] for method, those in curves.items() if name in those}, looks)
        scale(axes.yaxis, [0, 0.5, 1], [] if column else None)
    return svg(figure, about)


def _lines(axes: Axes, name: str, curves: Mapping[str, Any], looks: Mapping[str, Any]) -> None:
    """One stress: all methods, those with a look last and with their bands."""
    for method, told in sorted(curves.items(), key=lambda item: item[0] in looks):
        x = told["severities"]
        if method in looks:
            axes.fill_between(x, told["low"], told["high"], color=looks[method]["color"], alpha=0.13, linewidth=0)
        axes.plot(x, told["accuracy"], **looks.get(method, THIN))
    axes.set_title(name, color=INK, size=SMALL + 0.5, loc="left", pad=3)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(0, 1.02)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    per_cent = told["unit"].startswith(("share", "of "))
    most = f"{100 * x[-1]:g} % {told['unit'].removeprefix('share')}" if per_cent else f"{x[-1]:g} {told['unit']}"
    scale(axes.xaxis, [x[0], x[-1]], [f"{x[0]:g}", most])
    for label, side in zip(axes.get_xticklabels(), ("left", "right"), strict=True):
        label.set_horizontalalignment(side)


def _ease(protocol: str) -> int:
    """Hard protocols first."""
    return ("leave", "split", "random").index(protocol.split(":")[0])


def _shade(axes: Axes, i: int, j: int, strength: float) -> None:
    axes.add_patch(Rectangle((j, i), 1, 1, facecolor=ACCENT, alpha=STRONGEST * float(strength), edgecolor="none"))


def _cell(axes: Axes, i: int, j: int, estimate: Estimate) -> None:
    """Row i, column j: the share on its shade, the interval below it."""
    mean, low, high = (f"{100 * value:.0f}" for value in estimate)
    _shade(axes, i, j, estimate[0] ** 2)
    write(axes, j + 0.5, i + 0.34, mean)
    write(axes, j + 0.5, i + 0.76, f"{low}–{high}", size=SMALL - 1)
