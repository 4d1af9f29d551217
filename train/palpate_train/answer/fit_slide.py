"""The slides of a training set: the range of their speeds, the least vibration of each material and
the least pattern that passes from taxel to taxel. All is measured from counts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from palpate.answer.pipeline import Slide
from palpate.answer.slide import CHANCE, PARTS, SlideLimits, SlideMeter, SpeedRange, vibration
from palpate.answer.window import TINY
from palpate.bundle.contents import Bundle
from palpate.bundle.manifest import Manifest
from palpate_train.answer.rule import Rule
from palpate_train.data.sets import Dataset, evenly
from palpate_train.metrics.tolerances import MARGIN, OUTER

MOST_SWEEPS = 1000
"""Most sweeps that are measured, evenly spread over the set."""
LEAST_SHARE, LEAST_SWEEPS = 0.2, 5
"""Least share and number of measured sweeps that give a range."""
FEWEST_SLIDES = round(2 / OUTER)
"""Least number of training sweeps of each label whose least vibration refuses a whole window. The
next sweep has less vibration than the least of n sweeps with a probability of 1 / (n + 1)."""
STILL = 0.5 * float(np.log(TINY)) / 2
"""Below this vibration a part does not change at all."""
UNNOTICED = "a finger that rests: not noticed"


def slides(meter: SlideMeter, sweeps: Dataset) -> list[Slide]:
    """The slides of at most MOST_SWEEPS of the sweeps."""
    return [meter(window) for window in sweeps.samples[evenly(len(sweeps), MOST_SWEEPS)]]


def trained_speeds(sweeps: Dataset, pitch_mm: float | None) -> tuple[SpeedRange | None, str]:
    """The range of the measured speeds of `sweeps`, or None and the reason. pitch_mm: distance
    between taxels, None if unknown."""
    meter = SlideMeter(sweeps.format, pitch_mm)
    if meter.why is not None:
        return None, meter.why
    measured = slides(meter, sweeps)
    count = len(measured)
    speeds = [slide.speed_mm_s for slide in measured if slide.speed_mm_s is not None]
    if len(speeds) < max(LEAST_SWEEPS, LEAST_SHARE * count):
        return None, f"the speed was measured in {len(speeds)} of {count} sweeps"
    ends = np.quantile(speeds, (OUTER, 1 - OUTER), method="nearest")
    return SpeedRange(*map(float, ends)), ""


def limited(manifest: Manifest, train: Dataset) -> Manifest:
    """`manifest` with the limits of the training sweeps; unchanged if there are none."""
    whole = bool(np.bincount(train.labels, minlength=len(train.materials)).min() >= FEWEST_SLIDES)
    least = _least(manifest, train) if whole or manifest.early else ()
    pattern = _pattern(train)
    if not least and pattern is None:
        return manifest
    return replace(manifest, sliding=SlideLimits(least, pattern, whole or not least))


def _pattern(train: Dataset) -> float | None:
    """The least height of a pattern, where nearly all training sweeps show one of twice the height;
    else None. So a sweep with half of the usual pattern is answered."""
    meter = SlideMeter(train.format, 1.0)
    if meter.why is not None:
        return None
    heights = [slide.height for slide in slides(meter, train)]
    return CHANCE if np.quantile(heights, OUTER) >= 2 * CHANCE else None


def _least(manifest: Manifest, train: Dataset) -> tuple[float, ...]:
    """The least vibration of each label; empty if windows are too short, and if a part of a sweep
    does not change at all, since slides then resemble rests."""
    if train.format.window < 2 * PARTS or set(train.materials) != set(manifest.labels):
        return ()
    least = np.array([vibration(window, manifest.tare).min() for window in train.samples])
    labels = [train.materials.index(label) for label in manifest.labels]
    found = [float(least[train.labels == k].min(initial=np.inf)) for k in labels]
    if not all(np.isfinite(v) and v > STILL for v in found):
        return ()
    return tuple(round(v - MARGIN, 3) for v in found)  # of a logarithm, so it is a share


def text(manifest: Manifest) -> str:
    """Whether a finger that rests is noticed, in words."""
    limits, by = manifest.sliding, []
    if limits and limits.least:
        part = "the window" if limits.whole else "an unfinished sweep"
        by.append(f"in each tenth of {part} by its lack of vibration")
    if limits and limits.pattern:
        by.append("in a whole window by its lack of a pattern that passes from taxel to taxel")
    return f"a finger that rests: noticed {' and '.join(by)}" if by else UNNOTICED


def without_pattern(bundle: Bundle) -> Bundle:
    """The bundle that needs no pattern in a slide."""
    return _limits(bundle, pattern=None)


def without_vibration(bundle: Bundle) -> Bundle:
    """The bundle that needs no vibration in a slide; its early answers still do."""
    if bundle.manifest.early:
        return _limits(bundle, whole=False)
    return _limits(bundle, least=(), whole=True)


def _limits(bundle: Bundle, **changed: Any) -> Bundle:
    if bundle.manifest.sliding is None:
        return bundle
    limits = replace(bundle.manifest.sliding, **changed)
    kept = limits if limits.least or limits.pattern else None
    return replace(bundle, manifest=replace(bundle.manifest, sliding=kept))


RULES = {
    "vibration": Rule("a least vibration of slides", without_vibration),
    "slide": Rule("a least pattern of slides", without_pattern, limited=limited),
}
