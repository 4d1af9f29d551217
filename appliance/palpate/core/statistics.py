"""The confidence interval of a proportion, for reports on the box and on the desktop."""

from __future__ import annotations

from math import sqrt


def wilson(k: float, n: float) -> tuple[float, float]:
    """The 95 % score interval (lower, upper) of a proportion, observed as `k` of `n` > 0 (E. B.
    Wilson, 1927)."""
    z = 1.959964
    middle, half = (
        (k + z * z / 2) / (n + z * z),
        z * sqrt(k * (n - k) / n + z * z / 4) / (n + z * z),
    )
    return max(0.0, middle - half), min(1.0, middle + half)
