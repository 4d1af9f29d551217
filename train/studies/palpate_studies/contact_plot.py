"""Draws the results of the study `alignment`: accuracy and flagged sweeps over displacement."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    FAINT,
    GREY,
    SMALL,
    WIDTH,
    add_axes,
    set_ticks,
    to_svg,
    write,
)

Json = dict[str, Any]
HEIGHT = 4.7
"""Height of the picture, inches."""
DIRECTIONS = {"rows": "along the finger, towards row 4", "columns": "across, towards column 4"}


def draw(results: Json) -> str:
    """Share of correct answers and share of flagged sweeps over the displacement, along the finger
    and across: SVG."""
    figure = Figure((WIDTH, HEIGHT))
    for number, (direction, points) in enumerate(results["moved"].items()):
        top = 1 - (0.5 + 2.15 * number) / HEIGHT
        axes = add_axes(figure, 0.14, 0.97, top, top - 1.45 / HEIGHT)
        mm = [point["mm"] for point in points]
        for name, colour, text, up in (
            ("accuracy", ACCENT, "named rightly", 0.85),
            ("moved", BLACK, "marked\nas moved", 0.58),
        ):
            mean, low, high = np.array([point[name] for point in points]).T
            axes.fill_between(mm, low, high, color=colour, alpha=0.13, linewidth=0)
            axes.plot(
                mm,
                mean,
                color=colour,
                linewidth=2,
                linestyle="-" if name == "accuracy" else (0, (4, 1.5)),
            )
            write(axes, 0, up, text, colour, SMALL)
        axes.set(xlim=(mm[0], mm[-1]), ylim=(-0.03, 1.03))
        axes.grid(axis="y", color=FAINT, linewidth=0.8)
        set_ticks(axes.yaxis, (0, 0.5, 1), percent=True)
        set_ticks(axes.xaxis, range(-6, 7, 2))
        write(axes, mm[0], 1.17, f"skin moved {DIRECTIONS[direction]}", ha="left")
        axes.set_ylabel("of the sweeps", color=GREY, size=SMALL)
        axes.set_xlabel(
            "mm from where it sat in training" if number else "mm", color=GREY, size=SMALL
        )
    n, attachments = (results["moved"]["rows"][0][name] for name in ("n", "attachments"))
    return to_svg(
        figure,
        f"Share of {n} simulated sweeps ({attachments} attachments) that are named rightly, and "
        "marked as moved",
    )
