"""MiniRocket with the augmented copies of our own training: the METHOD minirocket-augmented.

A comparison with `minirocket` separates the effect of the augmentation from that of the features.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_studies.peers import minirocket
from palpate_train.data.augment import SLOW, Augmentation, copies, default_augmentation
from palpate_train.data.sets import Dataset
from palpate_train.models.methods import Method
from palpate_train.models.recipe.architectures import STAGES
from palpate_train.onnx_tools.graph_builder import GraphModel

Array = NDArray[Any]
COPIES = 2
"""Number of copies of each training sweep, as many as the heads of the recipe see."""


def train(sweeps: Dataset, inputs: Array, seed: int) -> GraphModel:
    """MiniRocket and ridge on `inputs`, the raw counts [N, T, R, C] of `sweeps`, and COPIES of
    them.

    A copy belongs to the recording of its sweep, so that training does not see copies of sweeps
    that are held out for the temperature. Raises FormatError as minirocket.train does.
    """
    known = replace(
        sweeps, samples=inputs, groups=sweeps.groups | {"recording": sweeps.group("recording")}
    )
    changed = copies(known, augmentation(known.format.window), seed, COPIES)
    samples = np.concatenate([inputs, *(copy.samples for copy in changed)])
    several = replace(known.take(np.tile(np.arange(len(known)), COPIES + 1)), samples=samples)
    return minirocket.train(several, several.samples, seed)


def augmentation(window: int) -> Augmentation:
    """The augmentation of our own training for a window of this many frames; that of slow sensors
    if our networks cannot take the window."""
    try:
        return default_augmentation(STAGES.zero_sum(window))
    except FormatError:
        return SLOW


ABOUT = f"MiniRocket of aeon + ridge, trained on {COPIES} augmented copies of each sweep too"
METHODS = (Method("minirocket-augmented", ABOUT, "raw", train, "peers"),)
