"""Limits that tell a slide from a rest: the least vibration of each material, and the least
pattern that passes from taxel to taxel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate.answer.slide import CHANCE, SlideMeter
from palpate.answer.vibration import PARTS, TINY, SlideLimits, vibration
from palpate.bundle.manifest import Manifest
from palpate_train.calibration.slide_speeds import OUTER, slides
from palpate_train.data.sets import Dataset

MARGIN = 0.05
"""A part rests if it vibrates less than any part in training by this much (natural logarithm)."""
FEWEST = 100
"""Least number of training sweeps of each label. The next sweep has less vibration than the least
of n sweeps with a probability of 1 / (n + 1)."""
STILL = 0.5 * float(np.log(TINY)) / 2
"""Below this vibration a part does not change at all."""

_UNNOTICED = "a finger that rests: not noticed"


def limited(manifest: Manifest, train: Dataset) -> Manifest:
    """`manifest` with the limits of the training sweeps; unchanged if there are none."""
    least, pattern = _least(manifest, train), _pattern(train)
    if not least and pattern is None:
        return manifest
    return replace(manifest, sliding=SlideLimits(least, pattern))


def _pattern(train: Dataset) -> float | None:
    """The least height of a pattern, where nearly all training sweeps show one of twice the height;
    else None. So a sweep with half of the usual pattern is answered."""
    meter = SlideMeter(train.format, 1.0)
    if meter.why:
        return None
    heights = [slide.height for slide in slides(meter, train)]
    return CHANCE if np.quantile(heights, OUTER) >= 2 * CHANCE else None


def _least(manifest: Manifest, train: Dataset) -> tuple[float, ...]:
    """The least vibration of each label.

    Empty if there are fewer than FEWEST sweeps of a label, or if windows are too short. Also empty
    if a part of a sweep does not change at all, since slides then resemble rests.
    """
    if train.format.window < 2 * PARTS or set(train.materials) != set(manifest.labels):
        return ()
    if np.bincount(train.labels, minlength=len(train.materials)).min() < FEWEST:
        return ()
    least = np.array([vibration(window, manifest.tare).min() for window in train.samples])
    labels = [train.materials.index(label) for label in manifest.labels]
    found = [float(least[train.labels == k].min(initial=np.inf)) for k in labels]
    if not all(np.isfinite(v) and v > STILL for v in found):
        return ()
    return tuple(round(v - MARGIN, 3) for v in found)


def text(manifest: Manifest) -> str:
    """Whether a finger that rests is noticed, in words."""
    limits, by = manifest.sliding, []
    if limits and limits.least:
        by.append("in each tenth of the window by its lack of vibration")
    if limits and limits.pattern:
        by.append("in a whole window by its lack of a pattern that passes from taxel to taxel")
    return f"a finger that rests: noticed {' and '.join(by)}" if by else _UNNOTICED
