"""Discriminants of trained stages, whose features come before all others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_train.answer.heads import HeadPart, HeadPlan
from palpate_train.models.recipe.architectures import STAGES
from palpate_train.models.recipe.choice import FeatureColumns

Array = NDArray[Any]
STAGES_WEIGHT = 0.5
"""Weight of the discriminant of stages among others; docs/decisions/0004 compares others."""


def beside(plan: HeadPlan) -> list[HeadPart]:
    """`plan` with a discriminant of trained stages, whose features come before all others. It sees
    copies, as stages do.

    Stages and fixed features are so different that they err on different sweeps. Together they
    classify sweeps of a new condition better than either alone, which held-out parts hardly show.
    Therefore stages are added unless they are worse. They have less weight than others: where a
    force or a direction is new, they are the weakest.
    """
    size = sum(STAGES.channels)
    fixed = [replace(p, columns=tuple(np.add(p.columns, size).tolist())) for p in plan.parts]
    return [HeadPart(tuple(range(size)), True, weight=STAGES_WEIGHT), *fixed]


def fixed_columns(columns: FeatureColumns, plan: HeadPlan) -> Array:
    """The spectrum, and the loads if `plan` has them."""
    loads = np.intersect1d(columns.loads, plan.columns())
    return np.append(loads, columns.bands)


def alone(fixed: Array) -> list[HeadPart]:
    """A discriminant of each stage and the features `fixed`, which follow the features of stages;
    all see copies."""
    ends = np.cumsum(STAGES.channels).tolist()
    spectrum = (ends[-1] + fixed).tolist()
    return [
        HeadPart((*range(end - channels, end), *spectrum), True)
        for channels, end in zip(STAGES.channels, ends, strict=True)
    ]
