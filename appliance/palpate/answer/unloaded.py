"""Finds the level and the noise of the unloaded skin while it streams.

Nobody has to lift the finger at a certain moment: a stretch of the signal without contact is quiet,
and no other quiet stretch is lower.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import SweepFormat, normal

BLOCK_S, LEAST_FRAMES = 0.1, 8
"""Length of the stretches that are compared. Between two sweeps a finger is lifted for longer."""
NOISE = 5.0
"""A mean over time is a load if it differs from the unloaded skin by this many standard deviations
of one frame, and certainly if it differs by as many times this load."""
LEAST_COUNTS = 2.0
"""The same for whole counts, whose noise may be below one count."""
QUIET = 2.0
"""Stretches whose noise differs by at most this factor are equally quiet."""
SHARE = 0.1
"""Less than this share of a load is none: a stretch that is lower by less than this of the least
load is as low, a taxel with less than this of the strongest is not loaded."""


@dataclass(frozen=True, slots=True, eq=False)
class UnloadedSkin:
    """The skin without contact. level, noise: mean and standard deviation of the counts of each
    taxel, of the shape of a frame. contact: least difference from `level` that is a load, in
    counts."""

    level: NDArray[np.float64]
    noise: NDArray[np.float64]
    contact: float

    @classmethod
    def measured(cls, taxels: NDArray[Any]) -> UnloadedSkin:
        """From frames of an untouched skin, raw counts [n, R, C] or [n, R, C, A]."""
        return cls.of(
            taxels.mean(axis=0, dtype=np.float64),
            taxels.std(axis=0, dtype=np.float64),
            taxels.dtype,
        )

    @classmethod
    def of(
        cls, level: NDArray[np.float64], noise: NDArray[np.float64], counts: np.dtype[Any]
    ) -> UnloadedSkin:
        """From mean and standard deviation of each taxel. counts: data type of the raw counts."""
        contact = NOISE * _median(noise)
        return cls(level, noise, contact if counts.kind == "f" else max(contact, LEAST_COUNTS))


class UnloadedTracker:
    """Follows the stream. skin: the lowest of the quiet stretches so far; None before the first.

    certain: whether the skin was also touched since then. If it was not, the finger may have been
    sliding all the time.
    """

    def __init__(self, format: SweepFormat) -> None:
        self._size = max(LEAST_FRAMES, round(BLOCK_S * format.rate_hz))
        self.restart()

    def restart(self) -> None:
        """Begin again: this may be another skin."""
        self.skin: UnloadedSkin | None = None
        self.certain = self._given = False
        self._waiting: list[NDArray[Any]] = []
        self._frames = 0

    def set(self, taxels: NDArray[Any]) -> None:
        """Take these frames [n, R, C] as an untouched skin, as a person has said."""
        self.skin, self.certain, self._given = UnloadedSkin.measured(taxels), True, True

    def put(self, taxels: NDArray[Any]) -> None:
        """Add new frames [n, R, C]."""
        if self._given:
            return
        self._waiting.append(taxels)
        self._frames += len(taxels)
        if self._frames >= self._size:
            self._take(UnloadedSkin.measured(np.concatenate(self._waiting)))
            self._waiting, self._frames = [], 0

    def _take(self, block: UnloadedSkin) -> None:
        if self.skin is None or self._less(block, self.skin):
            self.skin, self.certain = block, False
            return
        away = normal(np.abs(block.level - self.skin.level), 0)
        self.certain |= bool(
            away.max(initial=0, where=np.isfinite(away)) >= NOISE * self.skin.contact
        )

    @staticmethod
    def _less(block: UnloadedSkin, than: UnloadedSkin) -> bool:
        """Whether a stretch is less loaded than another: much quieter, or as quiet and lower."""
        if block.contact * QUIET < than.contact:
            return True
        lower = float(np.nanmean(normal(block.level - than.level, 0))) < -SHARE * block.contact
        return lower and block.contact <= QUIET * than.contact


def _median(noise: NDArray[np.float64]) -> float:
    """Median noise of the taxels along the normal, so that a broken taxel does not count."""
    along = normal(noise, 0)
    return float(np.median(along[np.isfinite(along)])) if np.isfinite(along).any() else 0.0
