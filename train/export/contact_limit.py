"""From how many counts on a taxel is loaded. In: a training set. Out: a ContactLimit for the
bundle.

Where the recordings know the unloaded skin, a load is what is above it. Where they do not, the raw
counts are taken for loads, as long as they can be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.types import normal
from appliance.signal.unloaded import UnloadedSkin
from train.data.sets import Dataset

Array = NDArray[Any]
SHARE = 0.1
"""A loaded taxel has at least this share of the load of the strongest one in the weakest
contact."""
BASELINE = 0.5
"""Where no taxel reads less in any sweep than this share of the highest that one reads in any,
counts are not loads: some taxels are hardly touched, and some contacts are stronger than others."""


@dataclass(frozen=True, slots=True)
class ContactLimit:
    """contact: least load in counts above `tare`, None where none can be told, and `why`. tare: raw
    counts [R, C] or [R, C, A] of the unloaded skin, 0 where they are not known."""

    contact: float | None
    tare: Array
    why: str = ""


def find(sweeps: Dataset) -> ContactLimit:
    """The limit for `sweeps`: a tenth of the weakest contact, by the strongest taxel's mean on the
    normal axis."""
    means = sweeps.samples.mean(axis=1, dtype=np.float64)
    if sweeps.unloaded is not None:
        known = np.isfinite(sweeps.unloaded).all(axis=tuple(range(1, sweeps.unloaded.ndim)))
        if known.any():
            return _above(means[known], sweeps.unloaded[known], sweeps.samples.dtype)
    return _raw(means)


def _above(means: Array, unloaded: Array, counts: np.dtype[Any]) -> ContactLimit:
    """Of means [n, R, C] or [n, R, C, A] of sweeps and what the skin gave unloaded then, [n, 2, R,
    C] or [n, 2, R, C, A].

    The box starts from one level for all of them, so that their differences must not be taken for a
    load either.
    """
    tare = np.median(unloaded[:, 0], axis=0)
    weakest = normal(means - tare, 1).max(axis=(1, 2)).min()
    drift = normal(np.abs(unloaded[:, 0] - tare), 1).max(axis=(1, 2))
    noise = [UnloadedSkin.of(mean, deviation, counts).contact for mean, deviation in unloaded]
    least = float((drift + noise).max())
    if weakest <= least:
        return ContactLimit(
            None,
            0 * tare,
            (
                f"the weakest sweep reads {weakest:.6g} counts above the unloaded skin, which itself differs by up to "
                f"{least:.6g}; send TARE with the finger lifted before each series that palpate record takes, and press more"
            ),
        )
    return ContactLimit(max(SHARE * float(weakest), least), tare)


def _raw(means: Array) -> ContactLimit:
    """Of means [n, R, C] or [n, R, C, A] of sweeps, where nothing is known of the unloaded skin."""
    tare, means = np.zeros(means.shape[1:]), normal(means, 1)
    lowest, highest = float(means.min()), float(means.max())
    if means[0].size > 1 and 0 < BASELINE * highest <= lowest:
        return ContactLimit(
            None,
            tare,
            (
                f"no taxel reads less than {lowest:.6g} counts in any sweep, none more than {highest:.6g}, and what the unloaded "
                "skin gives is not known; record with palpate record, and send TARE with the finger lifted"
            ),
        )
    weakest = float(means.max(axis=(1, 2)).min())
    # below the weakest also where a tared skin was pulled, so that its counts are negative
    return ContactLimit(weakest - (1 - SHARE) * abs(weakest), tare)
