"""Statistics of each value of a frame over a stretch of the signal. Pure functions of raw
counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import LARGEST_READING

TRIPLES = 100
"""Number of places in a stretch at which the noise is measured. More places take more time and
change the result by less than a tenth."""


@dataclass(frozen=True, slots=True, eq=False)
class TaxelStatistics:
    """Statistics of a stretch of T frames with V values each, in the order of a frame.

    series: raw counts [V, T], contiguous. highest, lowest: raw counts [V]. mean: float64 [V].
    """

    series: NDArray[Any]
    highest: NDArray[Any]
    lowest: NDArray[Any]
    mean: NDArray[np.float64]

    @classmethod
    def of(cls, taxels: NDArray[Any]) -> TaxelStatistics:
        """From raw counts [T, R, C] or [T, R, C, A]."""
        # [V, T]: three times as fast to reduce
        series = np.ascontiguousarray(taxels.reshape(len(taxels), -1).T)
        return cls(
            series,
            series.max(axis=1),
            series.min(axis=1),
            series.mean(axis=1, dtype=np.float64),
        )

    @property
    def still(self) -> NDArray[np.bool_]:
        """The values that are constant, bool [V]."""
        still: NDArray[np.bool_] = self.lowest == self.highest
        return still

    @property
    def unreadable(self) -> NDArray[np.bool_]:
        """The values with a count that is not a number, or beyond LARGEST_READING, bool [V]."""
        with np.errstate(invalid="ignore"):
            largest = np.maximum(np.abs(self.highest), np.abs(self.lowest))
            unreadable: NDArray[np.bool_] = ~(largest <= LARGEST_READING)
        return unreadable

    def noise(self) -> NDArray[np.float32]:
        """Mean magnitude of the second difference of three frames, float32 [V] in counts.

        It contains the fast part of the signal: white noise counts far more than a vibration below
        a quarter of the frame rate. 0 for fewer than three frames.
        """
        values, frames = self.series.shape
        step = max(3, frames // TRIPLES)
        places = frames // step
        if not places:
            return np.zeros(values, np.float32)
        triples = self.series[:, : places * step].reshape(values, places, step)[..., :3]
        flat = triples.astype(np.float32).reshape(-1, 3)
        if self.series.dtype.kind != "f":
            return _mean_magnitude(flat, values)
        with np.errstate(all="ignore"):  # float32 counts may be infinite
            return _mean_magnitude(flat, values)


def _mean_magnitude(triples: NDArray[np.float32], values: int) -> NDArray[np.float32]:
    """Mean magnitude of the second difference of triples [V * n, 3], float32 [V]."""
    second = triples @ _SECOND_DIFFERENCE
    np.abs(second, out=second)
    mean: NDArray[np.float32] = second.reshape(values, -1) @ np.full(
        len(second) // values, values / len(second), np.float32
    )
    return mean


_SECOND_DIFFERENCE = np.array([1, -2, 1], np.float32)
