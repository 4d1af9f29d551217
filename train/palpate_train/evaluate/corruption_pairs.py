"""Two corruptions of raw counts at once: faults seldom come alone."""

from __future__ import annotations

from functools import partial
from itertools import combinations
from typing import Any

from numpy.random import Generator
from numpy.typing import NDArray

from palpate_train.evaluate.corruptions import Change, Corruption, find
from palpate_train.evaluate.evaluation_sweeps import EvaluationSweeps

Array = NDArray[Any]
PAIRED = {"gain-down": 0.2, "hum": 0.5, "noise": 0.3, "dead": 1, "lost": 0.05}
"""Faults that occur together, each at one severity, in the order in which a signal meets them."""


def pairs() -> tuple[Corruption, ...]:
    """Each two of PAIRED at once, for any sweeps. Severity 1 means both, 0 none."""
    those = zip(find(list(PAIRED)), PAIRED.values(), strict=True)
    return tuple(_pair(*first, *second) for first, second in combinations(those, 2))


def _pair(one: Corruption, much: float, other: Corruption, more: float) -> Corruption:
    both = partial(_both, one.change, much, other.change, more)
    return Corruption(
        f"{one.name}+{other.name}",
        f"{one.title} and {other.title}",
        "",
        (0, 1),
        f"{one.about}; {other.about}",
        both,
    )


def _both(
    one: Change,
    much: float,
    other: Change,
    more: float,
    x: Array,
    severity: float,
    rng: Generator,
    test: EvaluationSweeps,
) -> Array:
    return other(one(x, much * severity, rng, test), more * severity, rng, test)
