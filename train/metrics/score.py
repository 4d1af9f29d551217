"""Scores: right answers of how many, with a 95 % interval. In: right or wrong, logits. Out: figures
for results."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.bundle import bundle
from appliance.core.provenance import commit
from appliance.core.statistics import wilson
from appliance.inference.classifier import LEAST_PROBABILITY, softmax

Array = NDArray[Any]
DRAWS = 2000
"""Of the bootstrap."""


@dataclass(frozen=True)
class Score:
    """`right` of `total`."""

    right: int
    total: int

    @classmethod
    def of(cls, right: Array) -> Score:
        """Of booleans [n]."""
        return cls(int(right.sum()), len(right))

    def json(self) -> dict[str, int]:
        """As scripts read it."""
        return {"right": self.right, "total": self.total}


def interval(right: Array, clusters: Array | None = None) -> tuple[float, float]:
    """The 95 % interval of the share of `right` [n] (booleans, or shares over seeds).

    Without clusters it is Wilson's. Where sweeps succeed or fail together, as those of one position
    do (clusters [n]), it is that of the cluster bootstrap (percentiles of 2,000 draws), or Wilson's
    where that is wider: a bootstrap of few clusters, or where all answers are right, is too narrow.
    """
    low, high = widen(wilson(float(right.sum()), len(right)), right, clusters)
    return round(float(max(low, 0.0)), 4), round(float(min(high, 1.0)), 4)


def widen(
    bounds: tuple[float, float], values: Array, clusters: Array | None
) -> tuple[float, float]:
    """The interval `bounds` of the mean of `values` [n], extended to that of the bootstrap over
    `clusters` [n].

    The bootstrap's is from 2.5 to 97.5 % of DRAWS draws; without clusters `bounds` stay as they
    are.
    """
    if clusters is None:
        return bounds
    member = np.unique(clusters, return_inverse=True)[1]
    sums, size = np.bincount(member, values), np.bincount(member)
    drawn = np.random.default_rng(0).integers(len(size), size=(DRAWS, len(size)))
    means = sums[drawn].sum(1) / size[drawn].sum(1)
    return min(bounds[0], float(np.quantile(means, 0.025))), max(
        bounds[1], float(np.quantile(means, 0.975))
    )


def fuse(logits: Array, together: Array) -> tuple[Array, Array]:
    """Fuse the sweeps with the same value of `together` [n]: log scores [G, K], each the logarithm
    of the product of the probabilities of `logits` [n, K], and the number [G] of the first sweep of
    each."""
    _, first, member = np.unique(together, return_index=True, return_inverse=True)
    scores = np.zeros((len(first), logits.shape[1]))
    np.add.at(scores, member, np.log(np.maximum(softmax(logits), LEAST_PROBABILITY)))
    return scores, first


def accuracy_figure(right: int, n: int) -> dict[str, Any]:
    """The accuracy of `right` of `n` with its 95 % Wilson interval, as a manifest holds it."""
    low, high = wilson(right, n)
    return {"accuracy": round(right / n, 4), "n": n, "low": round(low, 4), "high": round(high, 4)}


@cache
def provenance() -> dict[str, str]:
    """The origin that a result file records beside its sets and seeds. shipped: the id of the
    packaged bundle.

    All is of the first call: other commits, and another day, may follow during a long run.
    """
    return {
        "commit": commit(),
        "shipped": shipped(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def shipped() -> str:
    """The id of the packaged bundle, as the box prints it."""
    return bundle.identity((bundle.DEFAULT / "manifest.json").read_bytes())
