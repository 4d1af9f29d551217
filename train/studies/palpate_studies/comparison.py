"""Our accuracy and the best peer's: a line of a table, with the verdict in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from palpate_studies import differences
from palpate_studies.differences import Estimate
from palpate_train.reports.formatting import points

Json = Mapping[str, Any]
NEAR = -0.01
"""Ours may be this far below the best peer."""
ROUNDING = 1e-9


def line(what: str, ours: Json, peers: Mapping[str, Json]) -> dict[str, Any]:
    """A line of the table: the best of `peers` by name, chosen in hindsight, the difference, and a
    verdict.

    Entries have `mean`, `low` and `high`. Without peers the verdict says so.
    """
    if not peers:
        found: Json = {"best": "", "leader": None, "gap": None, "short": False}
        return {"what": what, "ours": ours, "verdict": "no peer was run", **found}
    best = max(peers, key=lambda name: float(peers[name]["mean"]))
    gap = differences.difference(differences.of(ours), differences.of(peers[best]))
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
