"""Confidence intervals of a proportion, for reports on the box and on the desktop."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
DRAWS = 2000
"""Number of draws of the bootstrap."""


def wilson(k: float, n: float) -> tuple[float, float]:
    """The 95 % score interval of a proportion `k` of `n` > 0 (E. B. Wilson, 1927)."""
    z = 1.959964
    middle = (k + z * z / 2) / (n + z * z)
    half = z * sqrt(k * (n - k) / n + z * z / 4) / (n + z * z)
    return max(0.0, middle - half), min(1.0, middle + half)


def interval(right: Array, clusters: Array | None = None) -> tuple[float, float]:
    """The 95 % interval of the share of `right` [n] (booleans, or shares over seeds).

    Without `clusters` it is Wilson's interval. Sweeps of one cluster (numbers [n], such as
    positions) succeed or fail together; then it is the wider of Wilson's interval and that of the
    cluster bootstrap (percentiles of DRAWS draws). The bootstrap alone is too narrow if there are
    few clusters or all answers are right.
    """
    low, high = widen(wilson(float(right.sum()), len(right)), right, clusters)
    return round(float(max(low, 0.0)), 4), round(float(min(high, 1.0)), 4)


def widen(
    bounds: tuple[float, float], values: Array, clusters: Array | None
) -> tuple[float, float]:
    """The interval `bounds` of the mean of `values` [n], extended to the interval of the bootstrap
    over `clusters` [n]. The bootstrap's interval is from 2.5 to 97.5 % of DRAWS draws. Without
    clusters, `bounds` are returned unchanged."""
    if clusters is None:
        return bounds
    member = np.unique(clusters, return_inverse=True)[1]
    sums, size = np.bincount(member, values), np.bincount(member)
    drawn = np.random.default_rng(0).integers(len(size), size=(DRAWS, len(size)))
    means = sums[drawn].sum(1) / size[drawn].sum(1)
    low, high = (float(np.quantile(means, q)) for q in (0.025, 0.975))
    return min(bounds[0], low), max(bounds[1], high)
