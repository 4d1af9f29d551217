"""The room of the two pictures of a choice. In: parts of choice.json. Out: SVG text, in the style of ink.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from train.reports.plot_style import ACCENT, FAINT, GREY, INK, SMALL, TEXT, WIDTH, add, field, scale, svg, write

Json = Mapping[str, Any]
TITLES = {"window": "length of the window", "rate": "frames a second", "taxels": "taxels", "bits": "bits",
          "classes": "materials told apart"}  # fmt: skip


def rungs(told: Sequence[Json], chosen: str, wanted: float, about: str) -> str:
    """Accuracy with its interval for each rung that was tried, cheapest on top; the chosen one in the accent colour."""
    tried = [rung for rung in told if rung["accuracy"]]
    figure, axes = field(len(tried) * 0.29 + 0.6, left=0.27, right=0.7, top=0.3, bottom=0.28)
    lows = [rung["accuracy"]["low"] for rung in tried]
    bottom = max(np.floor(10 * min([*lows, wanted or 1.0]) - 0.01) / 10, 0)
    for y, rung in enumerate(tried):
        mine, got = rung["method"] == chosen, rung["accuracy"]
        colour = ACCENT if mine else GREY
        axes.plot([got["low"], got["high"]], [y, y], color=colour, linewidth=2.2 if mine else 1.4)
        axes.plot(got["mean"], y, "o", color=colour, markersize=6.5 if mine else 5)
        how = {"size": TEXT, "annotation_clip": False, "va": "center", "color": ACCENT if mine else INK}
        bold = {"weight": "bold" if mine else "normal"}
        for text, at, side in (
            (rung["method"], (-0.03, y), "right"),
            (figure_of(got["mean"]), (1.18, y), "right"),
            (f"{rung['ms']:.2f}", (1.45, y), "right"),
            (f"{rung['kb']:.0f}", (1.68, y), "right"),
        ):
            axes.annotate(text, at, xycoords=axes.get_yaxis_transform(), ha=side, **how, **bold)
    for text, x in (("right", 1.18), ("ms", 1.45), ("kB", 1.68)):
        axes.annotate(text, (x, -0.85), xycoords=axes.get_yaxis_transform(), ha="right", va="center", color=GREY,
                      size=SMALL, annotation_clip=False)  # fmt: skip
    if wanted:
        axes.axvline(wanted, color=INK, linewidth=1, linestyle=(0, (2, 2)))
        write(axes, wanted, -0.85, "wanted", GREY, SMALL)
    axes.set_ylim(len(tried) - 0.5, -0.55)
    axes.set_xlim(bottom, 1.005)
    axes.grid(axis="x", color=FAINT, linewidth=0.7)
    step = 0.1 if bottom > 0.45 else 0.2
    scale(axes.xaxis, np.arange(bottom, 1.01, step))
    scale(axes.yaxis, [])
    return svg(figure, about)


def less(curves: Sequence[Json], about: str, columns: int = 2) -> str:
    """A panel for each curve: accuracy over what is left, from all of it to little. Filled where it loses no more than a
    standard error; what could be kept is in the accent colour."""
    rows, above, each = -(-len(curves) // columns), 0.1, 1.35
    figure = Figure((WIDTH, above + rows * each))
    inch = 1 / figure.get_figheight()
    points = [p for curve in curves for p in curve["points"] if "accuracy" in p]
    bottom = max(np.floor(10 * min(p["accuracy"]["low"] for p in points)) / 10, 0)
    for i, curve in enumerate(curves):
        row, column = divmod(i, columns)
        low = ((rows - 1 - row) * each + 0.42) * inch
        left = 0.075 + 0.925 * column / columns
        axes = add(figure, left, left + 0.925 / columns - 0.04, low + 0.78 * inch, low)
        _panel(axes, curve)
        axes.set_ylim(bottom, 1.02)
        scale(axes.yaxis, np.arange(bottom, 1.01, 0.1 if bottom > 0.55 else 0.2), [] if column else None)
    return svg(figure, about)


def _panel(axes: Axes, curve: Json) -> None:
    points = [p for p in curve["points"] if "accuracy" in p]
    mean, low, high = np.array([[p["accuracy"][k] for k in ("mean", "low", "high")] for p in points]).T
    x = np.arange(len(points))
    axes.fill_between(x, low, high, color=ACCENT, alpha=0.13, linewidth=0)
    axes.plot(x, mean, color=GREY, linewidth=1.2)
    for at, point in enumerate(points):
        kept = point["name"] == curve["kept"]
        fine = point.get("fine", True)
        axes.plot(at, mean[at], "o", markersize=7 if kept else 5, color=ACCENT if kept else GREY,
                  markerfacecolor=(ACCENT if kept else GREY) if fine else "none")  # fmt: skip
    axes.set_title(TITLES[curve["kind"]], color=INK, size=SMALL + 0.5, loc="left", pad=3)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.set_xlim(-0.35, len(points) - 0.65 if len(points) > 1 else 0.35)
    scale(axes.xaxis, x, [p["name"].partition(" ")[0] for p in points])


def figure_of(value: float) -> str:
    """A share with three digits: .914, 1.000."""
    return f"{value:.3f}".removeprefix("0")
