"""The picture of a choice of model, drawn from choice.json as SVG text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from palpate_train.reports.formatting import percent
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    MEDIUM,
    SMALL,
    set_ticks,
    single_axes,
    to_svg,
    write,
)

Json = Mapping[str, Any]
COLUMNS = (1.42, 1.75, 2.05)
"""Right ends of the columns of numbers beside `sizes`, as multiples of the plot's width."""


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
        axes.annotate(
            text,
            (x, -0.85),
            xycoords=axes.get_yaxis_transform(),
            ha="right",
            va="center",
            color=GREY,
            size=SMALL,
            annotation_clip=False,
        )
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
    for text, x in zip(texts, (-0.03, *COLUMNS), strict=True):
        axes.annotate(
            text,
            (x, y),
            xycoords=axes.get_yaxis_transform(),
            ha="right",
            va="center",
            size=MEDIUM,
            annotation_clip=False,
            color=ACCENT if chosen else BLACK,
            weight="bold" if chosen else "normal",
        )
