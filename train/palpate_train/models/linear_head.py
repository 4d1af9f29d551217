"""Heads for materials that training never saw, and the sweeps that are held out to judge heads."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data.sets import Dataset

Array = NDArray[Any]
HELD_OUT = 0.2
"""Share of the groups that is held out from training, for temperature and validation."""
ABSENT = -30.0
"""Logit of a material that training never saw. The best of the other logits is never below 0, so
the probability of such a material is below 1e-12."""


def hold_out(
    sweeps: Dataset, seed: int, by: Sequence[str] = ("position",)
) -> tuple[Dataset, Dataset, str]:
    """(training sweeps, held-out sweeps, name of the group): whole values of the first group of
    `by` that has several and can be split, else recordings.

    Raises FormatError if the set has too few groups, or if only one sweep of a material would be
    left to train on.
    """
    for name in by:
        if len(np.unique(sweeps.groups.get(name, 0))) > 1:
            with suppress(FormatError):
                return _split(sweeps, name, seed)
    return _split(sweeps, "recording", seed)


def hold_out_or_all(
    sweeps: Dataset, seed: int, by: Sequence[str] = ("position",)
) -> tuple[Dataset, Dataset, str]:
    """As `hold_out`; if the set is too small, all of it on both sides, by "nothing". Then only
    Platt's correction bounds the temperature."""
    try:
        return hold_out(sweeps, seed, by)
    except FormatError:
        return sweeps, sweeps, "nothing"


def _split(sweeps: Dataset, by: str, seed: int) -> tuple[Dataset, Dataset, str]:
    train, held_out = sweeps.split(by, 1 - HELD_OUT, seed)
    counts = np.bincount(train.labels, minlength=len(sweeps.materials))
    if 1 in counts:
        material = sweeps.materials[int(np.flatnonzero(counts == 1)[0])]
        raise FormatError(
            f"{sweeps.source}: split by {by!r} leaves one sweep of {material!r}; record more of it"
        )
    return train, held_out, by


def expanded_head(weight: Array, bias: Array, present: Array, classes: int) -> tuple[Array, Array]:
    """A head [classes, F] for all `classes`, trained for those in `present`. Its logits sum to 0
    over these, which changes no softmax; ABSENT lies far below the largest of them."""
    all_weight, all_bias = (
        np.zeros((classes, weight.shape[1]), np.float32),
        np.full(classes, ABSENT, np.float32),
    )
    all_weight[present], all_bias[present] = weight - weight.mean(axis=0), bias - bias.mean()
    return all_weight, all_bias
