"""The picture of a confusion matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    GREY,
    SMALL,
    single_axes,
    tiles,
    to_svg,
    write,
)

Array = NDArray[Any]
FEW = 30
"""Number of sweeps below which a row says how many there are: one of three is 33 %, too."""
STRONGEST = 0.6
"""Strongest share of the accent colour behind a number: text stays readable on it, in light and in
dark."""


def draw(
    matrix: Array,
    names: Sequence[str],
    about: str,
    printed: Array | None = None,
    totals: Array | None = None,
) -> str:
    """Draw counts or shares [K, K] with the true materials as rows: each row in per cent, and the
    printed values below in small type. totals: sweeps [K] of each material, if some of them have no
    label; without them the sums of the rows. Rows of few sweeps show their number."""
    k = len(names)
    sums = np.sum(matrix, 1) if totals is None else totals
    counted = totals is not None or np.asarray(matrix).dtype.kind in "iu"
    rows = np.asarray(matrix, float) / np.maximum(np.reshape(sums, (-1, 1)), 1e-9)
    figure, axes = single_axes(
        0.6 + (0.36 if printed is None else 0.47) * k, left=0.25, right=0.995, top=0.55, bottom=0.05
    )
    for i, j in np.ndindex(k, k):
        shade(axes, i, j, rows[i, j])
        there = rows[i, j] >= 0.005
        write(
            axes,
            j + 0.5,
            i + (0.5 if printed is None else 0.36),
            f"{100 * rows[i, j]:.0f}" if there else "·",
            BLACK if there else GREY,
            weight="bold" if i == j else "normal",
        )
        if printed is not None and printed[i][j] > 0:
            write(axes, j + 0.5, i + 0.76, f"◇ {100 * printed[i][j]:.0f}", size=SMALL - 1)
    for i, name in enumerate(names):
        few = counted and sums[i] < FEW
        write(axes, -0.03 * k, i + (0.34 if few else 0.5), name, size=SMALL + 0.5, ha="right")
        if few:
            write(axes, -0.03 * k, i + 0.76, f"n = {sums[i]:.0f}", GREY, SMALL - 1, ha="right")
        write(axes, i + 0.5, -0.12, name.replace(" ", "\n"), size=SMALL, va="bottom")
    write(axes, -0.03 * k, -0.12, "%, is ↓  named →", GREY, SMALL, ha="right", va="bottom")
    tiles(axes, k, k)
    return to_svg(figure, about)


def shade(axes: Axes, i: int, j: int, strength: float) -> None:
    axes.add_patch(
        Rectangle(
            (j, i), 1, 1, facecolor=ACCENT, alpha=STRONGEST * float(strength), edgecolor="none"
        )
    )
