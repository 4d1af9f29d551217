"""Augmented copies. In: sweeps of raw counts and an Augmentation. Out: the sweeps again, changed,
as raw counts.

They show a head in closed form how materials vary. PyTorch is not needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from train.data.sets import Dataset
from train.models.recipe.augment import Augmentation, augment
from train.models.scale import texture_scale

COPIES = 2
"""Of the training sweeps, that a head in closed form sees beside them."""
BATCH = 128
"""Sweeps that are changed at a time: so few need little memory."""


def copies(sweeps: Dataset, augmentation: Augmentation, seed: int, count: int) -> Iterator[Dataset]:
    """The sweeps again, `count` times, each time changed otherwise; in their order, of the same
    data type."""
    rng, scale = np.random.default_rng(seed), texture_scale(sweeps.samples)
    for _ in range(count):
        samples = np.empty_like(sweeps.samples)
        for start in range(0, len(sweeps), BATCH):
            part = slice(start, start + BATCH)
            samples[part] = _changed(sweeps.samples[part], scale, augmentation, rng)
        yield replace(sweeps, samples=samples)


def _changed(
    counts: NDArray[Any], scale: float, augmentation: Augmentation, rng: Generator
) -> NDArray[np.float32]:
    """Raw counts [B, T, R, C] or [B, T, R, C, A], changed; where they are integers rounded and
    clipped to what their data type holds."""
    n, frames, rows, cols = counts.shape[:4]
    x = np.ascontiguousarray(counts.reshape(n, frames, -1).transpose(0, 2, 1), np.float32)
    means = x.mean(axis=2, keepdims=True)
    x = augment((x - means) * scale, rows if cols > 1 else 1, augmentation, rng) / scale + means
    if counts.dtype.kind != "f":
        limits = np.iinfo(counts.dtype)
        x = np.rint(x).clip(limits.min, limits.max)
    changed: NDArray[np.float32] = x.transpose(0, 2, 1).reshape(counts.shape)
    return changed
