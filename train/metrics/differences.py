"""Means and differences of accuracies of which only the intervals are known. In: estimates. Out: an
estimate.

An interval of a sum or difference is put together of the distances from each estimate to its ends,
as if those estimates were independent (the method of variance estimates recovery: Zou and Donner,
Statistics in Medicine 2008, and for two shares Newcombe, Statistics in Medicine 1998, method 10).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Estimate = tuple[float, float, float]
"""A share or a difference of shares, and the lower and upper end of its 95 % interval."""


def of(entry: Mapping[str, Any]) -> Estimate:
    """An entry of results, with `mean`, `low` and `high`."""
    return entry["mean"], entry["low"], entry["high"]


def entry(estimate: Estimate) -> dict[str, float]:
    """The same as an entry of results."""
    return dict(zip(("mean", "low", "high"), estimate, strict=True))


def difference(one: Estimate, other: Estimate) -> Estimate:
    """`one` less `other`. Methods that were tested on the same sweeps mostly fail together, so its
    interval is too wide."""
    gap = one[0] - other[0]
    below = math.hypot(one[0] - one[1], other[2] - other[0])
    above = math.hypot(one[2] - one[0], other[0] - other[1])
    return gap, gap - below, gap + above


def mean(groups: Mapping[str, Sequence[Estimate]]) -> Estimate:
    """The mean of all estimates. Those of one group, which share their sweeps, are taken to err
    together, groups independently.

    Raises ZeroDivisionError where there is none.
    """
    every = [one for group in groups.values() for one in group]
    middle = math.fsum(one[0] for one in every) / len(every)
    below = math.hypot(
        *(math.fsum(one[0] - one[1] for one in group) for group in groups.values())
    ) / len(every)
    above = math.hypot(
        *(math.fsum(one[2] - one[0] for one in group) for group in groups.values())
    ) / len(every)
    return middle, middle - below, middle + above
