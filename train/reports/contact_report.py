"""The picture of how a moved skin is flagged. In: what contact_positions measured. Out: SVG text."""

from __future__ import annotations

from typing import Any

import numpy as np

from train.reports import plot_style

Json = dict[str, Any]


def chart(told: Json) -> str:
    """Share right and share flagged over how far the skin was moved, along the finger and across: SVG."""
    figure, height = plot_style.Figure((plot_style.WIDTH, 4.7)), 4.7
    for number, (way, points) in enumerate(told["moved"].items()):
        top = 1 - (0.5 + 2.15 * number) / height
        axes = plot_style.add(figure, 0.09, 0.97, top, top - 1.45 / height)
        mm = [point["mm"] for point in points]
        for name, colour, said, up in (
            ("accuracy", plot_style.ACCENT, "named rightly", 0.85), ("moved", plot_style.INK, "flagged\nas moved", 0.58),
        ):  # fmt: skip
            mean, low, high = np.array([point[name] for point in points]).T
            axes.fill_between(mm, low, high, color=colour, alpha=0.13, linewidth=0)
            axes.plot(mm, mean, color=colour, linewidth=2, linestyle="-" if name == "accuracy" else (0, (4, 1.5)))
            plot_style.write(axes, 0, up, said, colour, plot_style.SMALL)
        axes.set(xlim=(mm[0], mm[-1]), ylim=(-0.03, 1.03))
        axes.grid(axis="y", color=plot_style.FAINT, linewidth=0.8)
        plot_style.scale(axes.yaxis, (0, 0.5, 1))
        plot_style.scale(axes.xaxis, range(-6, 7, 2))
        along = {"rows": "along the finger, towards row 4", "columns": "across, towards column 4"}[way]
        plot_style.write(axes, mm[0], 1.17, f"skin moved {along}", ha="left")
        if number:
            plot_style.write(
                axes, 0, -0.28, "mm from a place like those of training", plot_style.GREY, plot_style.SMALL
            )
    n, attachments = (told["moved"]["rows"][0][name] for name in ("n", "attachments"))
    return plot_style.svg(
        figure,
        f"Share of {n} simulated sweeps ({attachments} attachments) that are named rightly, and flagged as moved",
    )
