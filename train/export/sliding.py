"""The least vibration with which each material was slid over in training, for the manifest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from appliance.bundle.manifest import Manifest
from appliance.signal.vibration import PARTS, TINY, SlideLimits, vibration
from train.data.sets import Dataset

MARGIN = 0.05
"""A part rests if it vibrates less than any part in training by this much (natural logarithm)."""
FEWEST = 100
"""Least number of training sweeps of each label. The next sweep has less vibration than the least
of n sweeps with a probability of 1 / (n + 1)."""
STILL = 0.5 * float(np.log(TINY)) / 2
"""Below this vibration a part does not change at all."""


def limited(manifest: Manifest, train: Dataset) -> Manifest:
    """`manifest` with the least vibration of each label in the training sweeps.

    Unchanged if a part of one does not change at all, so that slides cannot be told from rests, if
    there are fewer than FEWEST of a label, or if windows are too short.
    """
    if train.format.window < 2 * PARTS or set(train.materials) != set(manifest.labels):
        return manifest
    if np.bincount(train.labels, minlength=len(train.materials)).min() < FEWEST:
        return manifest
    least = np.array([vibration(window, manifest.tare).min() for window in train.samples])
    labels = [train.materials.index(label) for label in manifest.labels]
    found = [float(least[train.labels == k].min(initial=np.inf)) for k in labels]
    if not all(np.isfinite(v) and v > STILL for v in found):
        return manifest
    return replace(manifest, sliding=SlideLimits(tuple(round(v - MARGIN, 3) for v in found)))


def text(manifest: Manifest) -> str:
    """Whether a finger that rests is noticed, in words."""
    if manifest.sliding is None:
        return "a finger that rests: not noticed"
    return "a finger that rests: noticed in each tenth of the window, by its lack of vibration"
