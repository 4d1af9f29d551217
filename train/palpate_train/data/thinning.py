"""Fewer sweeps of a large set, taxels or materials, so that more of them cost a fit no more.

Windows of one recording resemble each other, so recordings lose windows before a recording is lost.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_train.data.sets import Dataset

Array = NDArray[Any]


def thinned(sweeps: Dataset, most: int) -> Dataset:
    """At most `most` sweeps in their order; the set itself if it has no more.

    Each material gets the same number, or all of its sweeps if it has fewer. Within a material the
    same holds for recordings. The windows of a recording are evenly spaced. A set with at least as
    many materials as `most` keeps one sweep of each.
    """
    if len(sweeps) <= most:
        return sweeps
    recording, kept = sweeps.group("recording"), []
    materials = np.unique(sweeps.labels)
    for label, quota in zip(materials, _quotas(_counts(sweeps.labels), most), strict=True):
        own = np.flatnonzero(sweeps.labels == label)
        numbers = np.unique(recording[own], return_inverse=True)[1]
        quotas = _quotas(_counts(numbers), max(int(quota), 1))
        order = np.argsort(numbers, kind="stable")
        starts = np.cumsum(_counts(numbers)) - _counts(numbers)
        for start, n, few in zip(starts, _counts(numbers), quotas, strict=True):
            kept.append(own[order[start + (np.arange(few) * n) // max(few, 1)]])
    return sweeps.take(np.sort(np.concatenate(kept)))


def evenly(n: int, most: int) -> Array:
    """Numbers below `n`, at most `most` of them, at equal distances."""
    return np.linspace(0, n - 1, min(n, most)).round().astype(int)


def _counts(values: Array) -> Array:
    return np.unique(values, return_counts=True)[1]


def _quotas(counts: Array, total: int) -> Array:
    """The share of each of `counts` [k] in `total`: the same level, or its count if that is
    smaller. The rest goes to some of the larger ones, evenly spaced."""
    if counts.sum() <= total:
        return counts
    ascending, k = np.sort(counts), len(counts)
    whole = np.append(0, np.cumsum(ascending)[:-1])  # of all smaller ones
    levels = (total - whole) // (k - np.arange(k))
    level = int(levels[np.argmax(levels < ascending)])
    quotas = np.minimum(counts, level)
    larger, left = np.flatnonzero(counts > level), total - int(quotas.sum())
    quotas[larger[np.arange(left) * len(larger) // max(left, 1)]] += 1
    return quotas
