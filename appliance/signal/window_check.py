"""Checks a window without a model: contact, saturation, stuck and dead taxels. In: raw counts. Out: a Finding.

Pure functions, for the classifier and for recordings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.types import Status


@dataclass(frozen=True, slots=True)
class WindowLimits:
    """Limits for a window.

    contact: least mean over time of a loaded taxel, in counts above the tare. full_scale: the sensor's highest count.
    saturated: largest accepted share of full-scale counts. dead_taxels: largest accepted number of these.
    """

    contact: float
    full_scale: float
    saturated: float = 0.01
    dead_taxels: int = 0


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of the check of a window: status ok, or why it is refused, with the taxels in `detail`."""

    status: Status
    detail: str = ""


def _taxels(mask: Any) -> str:
    return "taxel " + " ".join(f"{r + 1}.{c + 1}" for r, c in np.argwhere(mask))


def inspect(taxels: NDArray[Any], tare: NDArray[np.float64], limits: WindowLimits) -> Finding:
    """Check a window before it is classified. taxels: raw counts [T, R, C]; tare: counts [R, C] of the unloaded skin.

    A loaded taxel always varies, so that a constant one is stuck. A constant unloaded taxel is dead if all its direct
    neighbours are loaded; at the edge of the contact it may be unloaded. One that gives no numbers is always dead.
    """
    series = np.ascontiguousarray(taxels.reshape(len(taxels), -1).T)  # [R * C, T]: three times as fast to reduce
    highest = series.max(axis=1)
    still = (series.min(axis=1) == highest).reshape(tare.shape)
    load = series.mean(axis=1, dtype=np.float64).reshape(tare.shape) - tare
    if not np.isfinite(load).all():  # possible with float32 counts; no output of the network is an answer then
        return Finding(Status.DEAD_TAXEL, _taxels(~np.isfinite(load)))
    loaded = load >= limits.contact
    if not loaded.any():
        return Finding(Status.NO_CONTACT, f"strongest taxel {load.max():.1f} digits")
    full = np.zeros(tare.shape)  # share of the frames
    if highest.max() >= limits.full_scale:  # seldom; counting takes longer than all the rest
        full = (series >= limits.full_scale).mean(axis=1).reshape(tare.shape)
    stuck = still & loaded & (full < 1)
    if stuck.any():
        return Finding(Status.STUCK_TAXEL, _taxels(stuck))
    if full.mean() > limits.saturated:
        return Finding(Status.SATURATED, _taxels(full > 0))
    silent = still & ~loaded
    if silent.any():
        dead = silent & _enclosed(loaded)
        if dead.sum() > limits.dead_taxels:
            return Finding(Status.DEAD_TAXEL, _taxels(dead))
    return Finding(Status.OK)


def _enclosed(loaded: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether all direct neighbours of a taxel are loaded, bool [R, C]; what is beyond the skin's edge counts as loaded."""
    padded = np.ones((loaded.shape[0] + 2, loaded.shape[1] + 2), bool)
    padded[1:-1, 1:-1] = loaded
    enclosed: NDArray[np.bool_] = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return enclosed
