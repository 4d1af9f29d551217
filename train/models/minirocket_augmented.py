"""MiniRocket with the augmented copies that our own training gets. In: sweeps. Out: the METHOD minirocket-augmented.

Beside `minirocket` it shows what is owed to the augmentation and what to the features.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from train.data.sets import Dataset
from train.models import minirocket
from train.models.compact.architectures import DEFAULT
from train.models.compact.augment import SLOW, Augmentation, augment
from train.models.linear_head import LinearHeadModel
from train.models.methods import Method
from train.models.networks import texture_scale
from train.models.training import batches, float_batches, one_thread

Array = NDArray[Any]
COPIES = 2
"""Of each training sweep, beside itself: as many as the closed-form head of the compact network sees."""


def train(sweeps: Dataset, inputs: Array, seed: int) -> LinearHeadModel:
    """MiniRocket and ridge on `inputs`, the raw counts [N, T, R, C] of `sweeps`, and COPIES of them.

    A copy belongs to the recording of its sweep, so that none of what is held out for the temperature is trained on.
    Raises FormatError as minirocket.train does.
    """
    known = replace(sweeps, samples=inputs, groups=sweeps.groups | {"recording": sweeps.group("recording")})
    samples = np.concatenate([inputs, *(changed(known, seed + copy) for copy in range(COPIES))])
    several = replace(known.take(np.tile(np.arange(len(known)), COPIES + 1)), samples=samples)
    return minirocket.train(several, several.samples, seed)


def changed(sweeps: Dataset, seed: int) -> Array:
    """The raw counts [N, T, R, C] of `sweeps`, augmented as by default for their format; of the same data type."""
    form, kind, scale = sweeps.format, sweeps.samples.dtype, texture_scale(sweeps.samples)
    what = augmentation(form.window)
    rng, found = torch.Generator().manual_seed(seed), np.empty_like(sweeps.samples)
    picks = batches(len(sweeps))
    with one_thread():
        for pick, counts in zip(picks, float_batches(sweeps.samples, picks), strict=True):
            x = counts.flatten(2).transpose(1, 2)
            means = x.mean(2, keepdim=True)
            x = augment((x - means) * scale, form.rows, what, rng) / scale + means
            x = x.transpose(1, 2).unflatten(2, counts.shape[2:])
            if kind.kind != "f":
                x = x.round().clamp(np.iinfo(kind).min, np.iinfo(kind).max)
            found[pick.numpy()] = x.numpy()
    return found


def augmentation(window: int) -> Augmentation:
    """That of our own training for a window of so many frames; of one that our networks cannot take, as for slow sensors."""
    try:
        return Augmentation() if DEFAULT.zero_sum(window) else SLOW
    except FormatError:
        return SLOW


ABOUT = f"MiniRocket of aeon + ridge, trained on {COPIES} augmented copies of each sweep too"
METHODS = (Method("minirocket-augmented", ABOUT, "raw", train, "minirocket"),)
