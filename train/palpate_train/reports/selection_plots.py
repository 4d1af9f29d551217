"""The two pictures of a choice of model, drawn from choice.json as SVG text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate_train.reports.formatting import percent
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    MEDIUM,
    SMALL,
    WIDTH,
    add_axes,
    set_categories,
    set_ticks,
    single_axes,
    to_svg,
    write,
)

Json = Mapping[str, Any]
TITLES = {
    "window": "length of the window",
    "rate": "frames a second",
    "taxels": "taxels",
    "bits": "bits",
    "classes": "materials distinguished",
}
COLUMNS = (1.42, 1.75, 2.05)
"""Right ends of the columns of numbers next to `sizes`, as multiples of the plot's width."""


def sizes(entries: Sequence[Json], chosen: str, wanted: float, about: str) -> str:
    """Accuracy with its interval of each tried model, the cheapest on top and the chosen one in the
    accent colour."""
    tried = [entry for entry in entries if entry["accuracy"]]
    figure, axes = single_axes(len(tried) * 0.29 + 0.6, left=0.27, right=0.62, top=0.3, bottom=0.28)
    lows = [entry["accuracy"]["low"] for entry in tried]
    bottom = max(np.floor(10 * min([*lows, wanted or 1.0]) - 0.01) / 10, 0)
    for y, entry in enumerate(tried):
        _model(axes, y, entry, entry["method"] == chosen)
    for text, x in zip(("right", "ms", "kB"), COLUMNS, strict=True):
        _beside(axes, text, (x, -0.85), color=GREY, size=SMALL)
    if wanted:
        axes.axvline(wanted, color=BLACK, linewidth=1, linestyle=(0, (2, 2)))
        write(axes, wanted, -0.85, "wanted", GREY, SMALL)
    axes.set_ylim(len(tried) - 0.5, -0.55)
    axes.set_xlim(bottom, 1.005)
    axes.grid(axis="x", color=FAINT, linewidth=0.7)
    set_ticks(axes.xaxis, np.arange(bottom, 1.01, 0.1 if bottom > 0.45 else 0.2), percent=True)
    set_ticks(axes.yaxis, [])
    return to_svg(figure, about)


def _model(axes: Axes, y: float, entry: Json, chosen: bool) -> None:
    """Draw one row: the interval with its mean, and name, accuracy, ms and kB as text."""
    accuracy, colour = entry["accuracy"], ACCENT if chosen else GREY
    axes.plot(
        [accuracy["low"], accuracy["high"]], [y, y], color=colour, linewidth=2.2 if chosen else 1.4
    )
    axes.plot(accuracy["mean"], y, "o", color=colour, markersize=6.5 if chosen else 5)
    texts = (entry["method"], percent(accuracy["mean"]), f"{entry['ms']:.2f}", f"{entry['kb']:.0f}")
    shade, weight = (ACCENT, "bold") if chosen else (BLACK, "normal")
    for text, x in zip(texts, (-0.03, *COLUMNS), strict=True):
        _beside(axes, text, (x, y), size=MEDIUM, color=shade, weight=weight)


def _beside(axes: Axes, text: str, at: tuple[float, float], **style: Any) -> None:
    """Write `text` to the left of a point in widths of the plot and in its rows."""
    place: dict[str, Any] = {"xycoords": axes.get_yaxis_transform(), "annotation_clip": False}
    axes.annotate(text, at, ha="right", va="center", **place, **style)


def reductions(curves: Sequence[Json], about: str, columns: int = 2) -> str:
    """A panel for each curve: accuracy over the share that is kept, from all to little.

    A dot is filled if it loses at most one standard error; the smallest sufficient share has the
    accent colour.
    """
    rows, above, each = -(-len(curves) // columns), 0.1, 1.35
    figure = Figure((WIDTH, above + rows * each))
    inch = 1 / figure.get_figheight()
    points = [p for curve in curves for p in curve["points"] if "accuracy" in p]
    bottom = max(np.floor(10 * min(p["accuracy"]["low"] for p in points)) / 10, 0)
    for i, curve in enumerate(curves):
        row, column = divmod(i, columns)
        low = ((rows - 1 - row) * each + 0.42) * inch
        left = 0.09 + 0.91 * column / columns
        axes = add_axes(figure, left, left + 0.91 / columns - 0.04, low + 0.78 * inch, low)
        _panel(axes, curve)
        axes.set_ylim(bottom, 1.02)
        set_ticks(
            axes.yaxis,
            np.arange(bottom, 1.01, 0.1 if bottom > 0.55 else 0.2),
            percent=True,
            bare=column > 0,
        )
    return to_svg(figure, about)


def _panel(axes: Axes, curve: Json) -> None:
    points = [p for p in curve["points"] if "accuracy" in p]
    mean, low, high = np.array(
        [[p["accuracy"][k] for k in ("mean", "low", "high")] for p in points]
    ).T
    x = np.arange(len(points))
    axes.fill_between(x, low, high, color=ACCENT, alpha=0.13, linewidth=0)
    axes.plot(x, mean, color=GREY, linewidth=1.2)
    for at, point in enumerate(points):
        size, shade = (7, ACCENT) if point["name"] == curve["kept"] else (5, GREY)
        face = shade if point.get("fine", True) else "none"
        axes.plot(at, mean[at], "o", markersize=size, color=shade, markerfacecolor=face)
    axes.set_title(TITLES[curve["kind"]], color=BLACK, size=SMALL + 0.5, loc="left", pad=3)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.set_xlim(-0.35, len(points) - 0.65 if len(points) > 1 else 0.35)
    set_categories(axes.xaxis, x, [p["name"].partition(" ")[0] for p in points])
