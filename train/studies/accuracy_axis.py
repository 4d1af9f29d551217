"""The axis of accuracy of pictures with many methods. A position on it is the root of the error: 90
and 95 % are as far apart as 71 and 80 %, and 100 % is on the axis."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from train.reports.plot_style import GREY, set_ticks

SHARES = (0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1)
"""Ticks, closer together near 100 %."""
ROOM = 0.04
"""Space below the lowest value, as a share of the axis."""


def stretch(axes: Axes, way: str, lows: Iterable[float], ticks: Iterable[float] = SHARES) -> None:
    """Make the axis `way` ("x" or "y") of `axes` an axis of accuracy, from a little below all
    `lows` to 100 %."""
    low = max(min(lows) - ROOM, 0.0)
    set_scale, set_limits = (
        (axes.set_xscale, axes.set_xlim) if way == "x" else (axes.set_yscale, axes.set_ylim)
    )
    set_scale("function", functions=(_place, _share))
    set_limits(low, 1)
    set_ticks(
        axes.xaxis if way == "x" else axes.yaxis,
        [tick for tick in ticks if tick >= low],
        percent=True,
    )


def draw_chance(axes: Axes, share: float) -> None:
    """Draw a dashed line at the accuracy of guessing."""
    axes.axhline(share, color=GREY, linewidth=1, linestyle=(0, (3, 2)))


def _place(share: NDArray[Any]) -> NDArray[Any]:
    places: NDArray[Any] = -np.sqrt(np.maximum(1 - share, 0))
    return places


def _share(place: NDArray[Any]) -> NDArray[Any]:
    shares: NDArray[Any] = 1 - np.square(place)
    return shares
