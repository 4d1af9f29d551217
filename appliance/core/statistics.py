"""How sure a counted share is. In: k of n. Out: its 95 % interval, for reports on the box and on the desktop alike."""

from __future__ import annotations

from math import sqrt


def wilson(k: float, n: float) -> tuple[float, float]:
    """The 95 % interval of a share of which k of n > 0 were seen (E. B. Wilson, 1927)."""
    z = 1.959964
    middle, half = (k + z * z / 2) / (n + z * z), z * sqrt(k * (n - k) / n + z * z / 4) / (n + z * z)
    return max(0.0, middle - half), min(1.0, middle + half)
