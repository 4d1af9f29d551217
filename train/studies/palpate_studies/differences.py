"""Means and differences of accuracies that are known only by their intervals, and our accuracy next
to the best peer's.

The interval of a sum or difference is computed from the distances between each estimate and the
ends of its interval, as if the estimates were independent (method of variance estimates recovery:
Zou and Donner, Statistics in Medicine 2008; for two shares Newcombe, Statistics in Medicine 1998,
method 10).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from palpate_train.reports.formatting import points

Json = Mapping[str, Any]
Estimate = tuple[float, float, float]
"""A share or a difference of shares, with the lower and upper end of its 95 % interval."""
NEAR = -0.01
"""Ours may be this far below the best peer."""
ROUNDING = 1e-9


def of(entry: Mapping[str, Any]) -> Estimate:
    """The estimate in an entry of results, with `mean`, `low` and `high`."""
    return entry["mean"], entry["low"], entry["high"]


def entry(estimate: Sequence[float]) -> dict[str, float]:
    """An estimate as an entry of results."""
    return dict(zip(("mean", "low", "high"), estimate, strict=True))


def difference(one: Estimate, other: Estimate) -> Estimate:
    """`one` minus `other`. If both methods were tested on the same sweeps, the interval is too
    wide, because they mostly fail on the same sweeps."""
    gap = one[0] - other[0]
    below = math.hypot(one[0] - one[1], other[2] - other[0])
    above = math.hypot(one[2] - one[0], other[0] - other[1])
    return gap, gap - below, gap + above


def mean(groups: Mapping[str, Sequence[Estimate]]) -> Estimate:
    """The mean of all estimates.

    Estimates of one group share their sweeps: their errors are assumed equal, and errors of
    different groups independent. Raises ZeroDivisionError if `groups` is empty.
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


def line(what: str, ours: Json, peers: Mapping[str, Json]) -> dict[str, Any]:
    """A line of the table: the best of `peers` by name, chosen in hindsight, the difference, and a
    verdict.

    Entries have `mean`, `low` and `high`. Without peers the verdict says so.
    """
    if not peers:
        found: Json = {"best": "", "leader": None, "gap": None, "short": False}
        return {"what": what, "ours": ours, "verdict": "no peer was run", **found}
    best = max(peers, key=lambda name: float(peers[name]["mean"]))
    gap = difference(of(ours), of(peers[best]))
    found = {"best": best, "leader": peers[best], "gap": gap, "short": gap[0] < NEAR - ROUNDING}
    return {"what": what, "ours": ours, "verdict": verdict(gap), **found}


def verdict(gap: Estimate) -> str:
    """A difference (ours less the best peer) in words; "not certain" if its interval contains 0."""
    middle, low, high = gap
    if abs(middle) < ROUNDING:
        return "level"
    if middle >= NEAR - ROUNDING and middle < 0:
        return "within a point"
    word = "ahead" if middle > 0 else "falls short"
    return word if low > 0 or high < 0 else f"{word}, not certain"


def shown(gap: Estimate) -> str:
    """A difference in percentage points with its interval: "−3.7 [−10.5, +4.1]"."""
    middle, low, high = (points(value, sign=True) for value in gap)
    return f"{middle} [{low}, {high}]"
