"""Whether the finger slides: the vibration of the taxels in tenths of a window, against the load.

A finger that rests on a material gives a load and hardly any vibration. How little a slide vibrates
depends on the material, so a bundle holds the least vibration of each material in training. The
measure does not change with the gain of the skin. Pure functions of raw counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context, JudgeInputs, Refusal, Stage
from palpate.answer.slide import ShowsPattern
from palpate.answer.window import TINY, Counts, Window, ones
from palpate.core.schema import Positive, check
from palpate.core.status import Reason, Remark
from palpate.core.types import Status, normal

Array = NDArray[np.float64]
PARTS = 10
"""Parts of a window. Early answers are given after whole parts."""


@dataclass(frozen=True, slots=True)
class SlideLimits:
    """least: [K], for each trained label the least `vibration` of a part in which the finger
    slides; empty if that is unknown. pattern: least height of the pattern that passes from taxel to
    taxel in a slide, as signal.slide measures it; None if slides need not show one. whole: whether
    whole windows have to vibrate so, too; if not, `least` is of few sweeps, and what lies below is
    only answered later. Raises BundleError for a number out of range."""

    least: tuple[float, ...]
    pattern: Positive | None = None
    whole: bool = True

    def __post_init__(self) -> None:
        check(self, "sliding")

    def resting(self, vibrations: Array, label: int) -> list[int]:
        """The parts, counted from 1, that vibrate too little for the label with this number; none
        for an enrolled label, whose limit is unknown."""
        if label >= len(self.least):
            return []
        least = self.least[label]
        return [part for part, found in enumerate(vibrations.tolist(), 1) if found < least]

    def judges(self, given: JudgeInputs) -> list[Stage]:
        """Whether a pattern shows, and whether the finger vibrates."""
        vibrates = Vibrates(self, given)
        if self.pattern is None or given.height is None:
            return [vibrates]
        return [ShowsPattern(self.pattern, given.height), vibrates]


def vibration(taxels: Counts, tare: Array, parts: int = PARTS) -> Array:
    """Natural logarithm of vibration over load in each part, float64 [parts].

    taxels: raw counts [T, R, C] or [T, R, C, A], at least `parts` frames; only the normal axis
    counts. tare: counts [R, C] or [R, C, A] of the unloaded skin. The vibration is the root of the
    mean variance of the taxels within a part, the load their mean count above the tare.
    """
    window = Window.of(taxels)
    each = len(window) // parts
    series = window.counts[: parts * each].reshape(parts, each, -1)
    offset = normal(window.series[0].reshape(tare.shape) - tare, 0)
    means, flat = ones(each) @ series / each, series.reshape(parts, -1)
    variance = (np.vecdot(flat, flat) / each - np.vecdot(means, means)) / offset.size
    total = np.add.reduce(offset, axis=None)
    load = np.abs(means.dot(ones(offset.size)) + total) / offset.size
    result: Array = 0.5 * np.log(np.maximum(variance, TINY)) - np.log(np.maximum(load, TINY))
    return result


class Vibrates:
    """Refuses a sweep in which the finger rests in a part of the window so far, where a slide over
    the label of the answer vibrates more. A load beyond that of training counts as that of
    training: vibrations grow less than it."""

    def __init__(self, limits: SlideLimits, given: JudgeInputs) -> None:
        self._limits, self._given = limits, given

    def apply(self, context: Context) -> Refusal | None:
        """Refuse a sweep with a rest."""
        parts = PARTS * len(context.taxels) // self._given.window
        if context.whole and not self._limits.whole:
            return None
        if not parts or len(context.taxels) < 2 * parts:
            return None
        beyond = self._given.beyond("load", context.disturbed)
        label = int(self._given.decided(context.probabilities).argmax())
        found = self._limits.resting(vibration(context.window, context.tare, parts) + beyond, label)
        if not found:
            return None
        where, name = " ".join(map(str, found)), self._given.labels[label]
        numbers = {"parts": where, "of": PARTS, "label": name}
        return Refusal(Status.NO_SLIDE, Remark(Reason.RESTS, numbers))
