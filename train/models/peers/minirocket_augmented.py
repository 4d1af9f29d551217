"""MiniRocket with the augmented copies that our own training gets. In: sweeps. Out: the METHOD
minirocket-augmented.

Beside `minirocket` it shows what is owed to the augmentation and what to the features.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from train.data.sets import Dataset
from train.models.linear_head import LinearHeadModel
from train.models.methods import Method
from train.models.peers import minirocket
from train.models.recipe.architectures import DEFAULT
from train.models.recipe.augment import SLOW, Augmentation, copies, default_augmentation

Array = NDArray[Any]
COPIES = 2
"""Of each training sweep, beside itself: as many as the closed-form head of the compact network
sees."""


def train(sweeps: Dataset, inputs: Array, seed: int) -> LinearHeadModel:
    """MiniRocket and ridge on `inputs`, the raw counts [N, T, R, C] of `sweeps`, and COPIES of
    them.

    A copy belongs to the recording of its sweep, so that none of what is held out for the
    temperature is trained on. Raises FormatError as minirocket.train does.
    """
    known = replace(
        sweeps, samples=inputs, groups=sweeps.groups | {"recording": sweeps.group("recording")}
    )
    changed = copies(known, augmentation(known.format.window), seed, COPIES)
    samples = np.concatenate([inputs, *(copy.samples for copy in changed)])
    several = replace(known.take(np.tile(np.arange(len(known)), COPIES + 1)), samples=samples)
    return minirocket.train(several, several.samples, seed)


def augmentation(window: int) -> Augmentation:
    """That of our own training for a window of so many frames; of one that our networks cannot
    take, as for slow sensors."""
    try:
        return default_augmentation(DEFAULT.zero_sum(window))
    except FormatError:
        return SLOW


ABOUT = f"MiniRocket of aeon + ridge, trained on {COPIES} augmented copies of each sweep too"
METHODS = (Method("minirocket-augmented", ABOUT, "raw", train, "minirocket"),)
