"""Limits of the window check, fitted to a skin that exceeds the usual limits in good sweeps.

Coarse counts stand still under a load, dead taxels never change, a strong press reaches full
scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.answer.window import Finding, WindowLimits, inspect
from palpate.core.types import Status
from palpate_train.answer import embedding
from palpate_train.data.sets import Dataset

Array = NDArray[Any]
MOST_REFUSED = 0.05
"""Largest share of sweeps that the box may refuse. Fewer are faults of their recordings, and the
usual limits stay; more are how this skin is."""
Limits = TypeVar("Limits", bound=WindowLimits)


def highest_count(sweeps: Dataset) -> float:
    """The highest count of the type of the counts."""
    kind = sweeps.samples.dtype
    return float(np.finfo(kind).max if kind.kind == "f" else np.iinfo(kind).max)


def findings(sweeps: Dataset, limits: WindowLimits, tare: Array) -> list[Finding]:
    """The check of each sweep. tare: raw counts [R, C] or [R, C, A] of the unloaded skin."""
    return [inspect(window, tare, limits) for window in sweeps.samples]


def fitted(limits: Limits, parts: Sequence[Dataset], tare: Array) -> Limits:
    """`limits` with the share at full scale and the number of taxels without a signal that sweeps
    of these sets have, if more than MOST_REFUSED of one set is refused otherwise. Counts above the
    full scale show that it is wrong, and fit nothing. tare: as for `findings`."""
    if max(part.samples.max() for part in parts) > limits.full_scale:
        return limits
    of_all = [findings(part, limits, tare) for part in parts]
    if max(np.mean([one.status is not Status.OK for one in of]) for of in of_all) <= MOST_REFUSED:
        return limits
    taxels = parts[0].format.rows * parts[0].format.cols
    open_ = replace(limits, saturated=1.0, dead_taxels=taxels)
    found = [one for part in parts for one in findings(part, open_, tare)]
    passed = [one for one in found if one.status is Status.OK]
    if not passed:
        return limits
    full, silent = (
        embedding.limit(np.array(values, float))
        for values in ([one.full for one in passed], [one.silent for one in passed])
    )
    return replace(
        limits,
        saturated=min(max(limits.saturated, full), 1.0),
        dead_taxels=min(max(limits.dead_taxels, int(silent)), taxels - 1),
    )
