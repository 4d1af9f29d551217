"""Whether the counts move as over a slide: alike from frame to frame, and from taxel to taxel.

White noise does neither, and slides whose taxels come from several sweeps do not share their
movements. Neither measure depends on the gain or on the material.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context, Refusal, Stage, StageInputs
from palpate.answer.window import TINY, Counts, Window
from palpate.core.schema import Within, check
from palpate.core.status import Reason, Remark
from palpate.core.types import Status

Share = Annotated[float, Within(-1, 1)]
LEAST_FRAMES = 8
"""A shorter half of a window says nothing."""


@dataclass(frozen=True, slots=True)
class Correlations:
    """The least correlations of a slide, see `correlations`; -1 where noise and slides are alike.
    Raises BundleError for a number out of range."""

    frames: Share = -1.0
    taxels: Share = -1.0

    def __post_init__(self) -> None:
        check(self, "correlations")

    def within(self, found: tuple[float, float]) -> bool:
        """Whether the correlations of a window are as high as in a slide."""
        return found[0] >= self.frames and found[1] >= self.taxels

    def judges(self, given: StageInputs) -> list[Stage]:
        """Whether the counts move like noise."""
        return [self]

    def apply(self, context: Context) -> Refusal | None:
        """Refuse a whole window that moves like noise."""
        if context.whole and not self.within(correlations(context.window)):
            return Refusal(Status.NO_SLIDE, Remark(Reason.NOISE))
        return None


def correlations(taxels: Counts) -> tuple[float, float]:
    """The mean correlation of a taxel with itself one frame later, in the half of the window where
    it is less and without a trend; and the mean correlation of two taxels. taxels: raw counts [T,
    R, C] or [T, R, C, A], of which the normal axis counts. 1 where nothing can be said."""
    rows = Window.of(taxels).counts.T.copy()  # long rows are quick to add
    half = rows.shape[1] // 2
    if half < LEAST_FRAMES:
        return 1.0, 1.0
    time = np.arange(half, dtype=np.float32) - np.float32(half - 1) / 2
    time /= np.linalg.norm(time)
    least = min(_repeated(rows[:, :half], time), _repeated(rows[:, -half:], time))
    away = rows - rows.mean(axis=1, keepdims=True)
    power = np.vecdot(away, away)
    moving = power > TINY
    if (n := int(moving.sum())) < 2:
        return least, 1.0
    common = (1 / np.sqrt(power[moving])) @ away[moving]
    return least, (float(common @ common) / n - 1) / (n - 1)


def _repeated(part: NDArray[np.float32], time: NDArray[np.float32]) -> float:
    """The mean correlation of the taxels of a part [N, h] with themselves one frame later."""
    away = part - part.mean(axis=1, keepdims=True)
    away -= np.outer(away @ time, time)
    power = np.vecdot(away, away)
    moving = power > TINY
    later = np.vecdot(away[:, 1:], away[:, :-1])
    return float((later[moving] / power[moving]).mean()) if moving.any() else 1.0
