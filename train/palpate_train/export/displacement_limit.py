"""The displacement up to which a bundle names a material: that of its augmented training copies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from palpate.answer.contact import displacement
from palpate.bundle.manifest import Manifest
from palpate_train.data.sets import Dataset
from palpate_train.models.recipe.augment import Augmentation, augment

MOST = 360
"""Largest number of sweeps that are displaced."""
KEPT = 0.99
"""Share of the copies that lie within the limit. A few lie further, because gains differ."""


def limited(manifest: Manifest, train: Dataset, seed: int = 0) -> Manifest:
    """`manifest` with the largest displacement in copies of `train`, which are displaced as far as
    those that the model was trained with; unchanged if it has no rule for displaced sweeps, or if
    its taxels stand in one column, which training does not displace.

    A skin that was put back has other gains, which shift the measured place as well. Among trained
    positions this error is `limit_mm` at most, which is added.
    """
    rule, place, contact = manifest.displacement, manifest.contact, manifest.thresholds.contact
    if rule is None or place is None or contact is None or train.format.cols < 2:
        return manifest
    rng, shift = np.random.default_rng(seed), _shift(manifest.made)
    some = train.take(rng.permutation(len(train))[:MOST])
    loads = some.samples.mean(axis=1, dtype=np.float64) - manifest.tare
    still = dict.fromkeys(vars(Augmentation()), 0.0)
    only_moved = Augmentation(**still | {"shift": shift, "displaced": 1.0})
    moved = augment(
        loads.reshape(len(some), -1, 1).astype(np.float32), train.format.rows, only_moved, rng
    )
    means = moved.reshape(loads.shape) + manifest.tare
    mm = [displacement(mean, manifest.tare, contact, place).mm for mean in means]
    farthest = float(np.quantile(mm, KEPT)) + place.limit_mm
    return replace(manifest, displacement=replace(rule, farthest_mm=round(farthest, 3)))


def _shift(made: Mapping[str, Any]) -> float:
    """Largest displacement of training copies in rows."""
    used = made.get("recipe", {}).get("augmentation", {})
    return float(used.get("shift", Augmentation().shift))


def text(manifest: Manifest) -> str:
    """Up to which displacement a material is named, in words; "" without a rule."""
    rule = manifest.displacement
    if rule is None:
        return ""
    if rule.farthest_mm is None:
        return "displaced contacts: named at any distance"
    return f"displaced contacts: named up to {rule.farthest_mm:.1f} mm"
