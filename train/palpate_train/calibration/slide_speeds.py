"""Range of the speeds at which the fingers of a training set slid, measured from their counts."""

from __future__ import annotations

import numpy as np

from palpate.answer.pipeline import Slide
from palpate.answer.slide import SlideMeter, SpeedRange
from palpate_train.data.sets import Dataset

MOST_SWEEPS = 1000
"""Most sweeps that are measured, evenly spread over the set."""
LEAST_SHARE, LEAST_SWEEPS = 0.2, 5
"""Least share and number of measured sweeps that give a range."""
OUTER = 0.02
"""Share of the measured sweeps at each end that the range leaves out, since a few speeds are
wrong."""


def slides(meter: SlideMeter, sweeps: Dataset) -> list[Slide]:
    """The slides of at most MOST_SWEEPS of the sweeps."""
    count = min(len(sweeps), MOST_SWEEPS)
    chosen = np.linspace(0, len(sweeps) - 1, count).round().astype(int)
    return [meter(window) for window in sweeps.samples[chosen]]


def trained_speeds(sweeps: Dataset, pitch_mm: float | None) -> tuple[SpeedRange | None, str]:
    """The range of the measured speeds of `sweeps`, or None and the reason. pitch_mm: distance
    between taxels, None if unknown."""
    meter = SlideMeter(sweeps.format, pitch_mm)
    if meter.why:
        return None, meter.why
    measured = slides(meter, sweeps)
    count = len(measured)
    speeds = [slide.speed_mm_s for slide in measured if slide.speed_mm_s is not None]
    if len(speeds) < max(LEAST_SWEEPS, LEAST_SHARE * count):
        return None, f"the speed was measured in {len(speeds)} of {count} sweeps"
    ends = np.quantile(speeds, (OUTER, 1 - OUTER), method="nearest")
    return SpeedRange(*map(float, ends)), ""
