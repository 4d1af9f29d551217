"""The picture of a confusion matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from palpate.core.sweep_set import Array
from palpate_train.reports.plot_style import (
    ACCENT,
    BLACK,
    GREY,
    SMALL,
    WIDTH,
    single_axes,
    tiles,
    to_svg,
    write,
)

FEW = 30
"""Number of sweeps below which a row says how many there are: one of three is 33 %, too."""
LETTER = 0.58 * SMALL / 72
"""Width of a letter in inches, at most in the mean of a name."""
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
    label; without them the sums of the rows. Rows of few sweeps show their number. Names that are
    wider than a column stand upright above it."""
    k, longest = len(names), LETTER * max(map(len, names))
    left = max(0.25, (longest + 0.2) / WIDTH)
    heads = _heads(names, WIDTH * (0.995 - left) / k)
    sums = np.sum(matrix, 1) if totals is None else totals
    counted = totals is not None or np.asarray(matrix).dtype.kind in "iu"
    rows = np.asarray(matrix, float) / np.maximum(np.reshape(sums, (-1, 1)), 1e-9)
    top = 0.55 if heads else max(0.55, longest + 0.1)
    height = top + 0.05 + (0.36 if printed is None else 0.47) * k
    figure, axes = single_axes(height, left=left, right=0.995, top=top, bottom=0.05)
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
        head, turned = (heads[i], 0) if heads else (name, 90)
        write(axes, i + 0.5, -0.12, head, size=SMALL, va="bottom", rotation=turned)
    write(axes, -0.03 * k, -0.12, "%, is ↓  named →", GREY, SMALL, ha="right", va="bottom")
    tiles(axes, k, k)
    return to_svg(figure, about)


def _heads(names: Sequence[str], wide: float) -> list[str]:
    """The names in lines for columns of `wide` inches; none if one of them is too long for it."""
    heads = [name.replace(" ", "\n").replace("-", "-\n") for name in names]
    longest = max(len(line) for head in heads for line in head.split("\n"))
    return heads if LETTER * longest <= wide else []


def shade(axes: Axes, i: int, j: int, strength: float) -> None:
    axes.add_patch(
        Rectangle(
            (j, i), 1, 1, facecolor=ACCENT, alpha=STRONGEST * float(strength), edgecolor="none"
        )
    )
