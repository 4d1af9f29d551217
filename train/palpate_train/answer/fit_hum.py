"""The least ratio of hum that the box removes: above what training sweeps have without hum."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.hum import HumFilter
from palpate.bundle.contents import Bundle
from palpate.core.types import SweepFormat
from palpate_train.metrics import tolerances

Array = NDArray[Any]
STANDS_OUT, MOST_RATIO = 3.5, 20.0
"""Least ratio of hum that is removed, and the largest limit: beyond it training sweeps have
something like hum, so nothing is removed."""


def fit(format: SweepFormat, trained: Array) -> float | None:
    """The least ratio, from training sweeps [n, T, ...]; None if hum cannot be seen in them, or if
    they have something like it."""
    find = HumFilter(format)
    if not find.hz:
        return None
    ratios = [find.ratio(window) for window in trained]
    limit = max(STANDS_OUT, tolerances.CLEAR * float(np.quantile(ratios, tolerances.KEPT)))
    return round(limit, 2) if limit <= MOST_RATIO else None


def cleaned(format: SweepFormat, least: float | None, samples: Array) -> tuple[Array, Array]:
    """The windows [n, T, ...] without hum, and the amplitude that was removed of each [n]."""
    if least is None:
        return samples, np.zeros(len(samples))
    remove = HumFilter(format)
    clean, counts = zip(*(remove(window, least) for window in samples), strict=True)
    return np.stack(clean), np.array(counts)


def without(bundle: Bundle) -> Bundle:
    """The bundle that removes no hum."""
    allowed = bundle.manifest.disturbances
    less = allowed and replace(allowed, hum=None)
    return replace(bundle, manifest=replace(bundle.manifest, disturbances=less))
