"""Mean ranks of methods over tests, and cliques of methods that the tests cannot tell apart.

Friedman's ranks with the critical difference of Nemenyi (Demsar, Journal of Machine Learning
Research 7, 2006). aeon draws them as `aeon.visualisation.plot_critical_difference`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.stats import rankdata, studentized_range

LEVEL = 0.95


@dataclass(frozen=True, slots=True)
class Ranking:
    """Mean rank of each method, the best first; 1 is the best. difference: ranks that differ by
    less may do so by chance. cliques: the longest groups of such methods."""

    ranks: Mapping[str, float]
    tests: int
    difference: float
    cliques: tuple[tuple[str, ...], ...]


def ranking(accuracies: Mapping[str, list[float]]) -> Ranking:
    """The ranking of methods. accuracies: of each method in the same tests, in one order.

    Raises ValueError for fewer than two methods.
    """
    if len(accuracies) < 2:
        raise ValueError(f"{len(accuracies)} methods have no ranks; name two or more")
    table = np.array(list(accuracies.values()))
    mean = rankdata(-table, axis=0).mean(axis=1)
    ranks = dict(sorted(zip(accuracies, map(float, mean), strict=True), key=lambda item: item[1]))
    count, tests = table.shape
    spread = float(studentized_range.ppf(LEVEL, count, np.inf)) / sqrt(2)
    difference = spread * sqrt(count * (count + 1) / (6 * tests))
    return Ranking(ranks, tests, difference, _cliques(ranks, difference))


def _cliques(ranks: Mapping[str, float], difference: float) -> tuple[tuple[str, ...], ...]:
    """The longest groups of two or more neighbours whose ranks differ by less than
    `difference`."""
    names = list(ranks)
    found: list[tuple[str, ...]] = []
    for i, first in enumerate(names):
        group = tuple(name for name in names[i:] if ranks[name] - ranks[first] < difference)
        if len(group) > 1 and not any(set(group) <= set(other) for other in found):
            found.append(group)
    return tuple(found)
