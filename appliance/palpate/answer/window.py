"""One window of raw counts, with what several rules need of it: computed when it is first needed,
once, and in float32. Pure functions of raw counts."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import LARGEST_READING

Array = NDArray[Any]
TRIPLES = 100
"""Number of places in a stretch at which the noise is measured. More places take more time and
change the result by less than a tenth."""
TINY = 1e-30
"""Replaces 0 as a divisor, or where a logarithm is taken."""


class Window:
    """A stretch of T frames with V values each, in the order of a frame, N of them along the
    normal. taxels: raw counts [T, R, C] or [T, R, C, A]."""

    def __init__(self, taxels: Array) -> None:
        self.taxels = taxels

    @classmethod
    def of(cls, taxels: Counts) -> Window:
        """The window of raw counts, or the given one."""
        return taxels if isinstance(taxels, Window) else cls(taxels)

    def __len__(self) -> int:
        return len(self.taxels)

    @cached_property
    def series(self) -> Array:
        """Raw counts [T, V]."""
        return self.taxels.reshape(len(self), -1)

    @cached_property
    def values(self) -> NDArray[np.float32]:
        """Counts [T, V] above the first frame: squares of large counts would round small vibrations
        away. NaN throughout for a value that is not readable."""
        first = self.series[0]
        first = first if self.readable else np.where(self.unreadable, np.nan, first)
        return np.asarray(np.subtract(self.series, first, dtype=np.float32))

    @cached_property
    def counts(self) -> NDArray[np.float32]:
        """The values along the normal, [T, N]."""
        axes = self.taxels.shape[3] if self.taxels.ndim == 4 else 1
        counts: NDArray[np.float32] = np.ascontiguousarray(self.values[:, axes - 1 :: axes])
        return counts

    @cached_property
    def mean(self) -> NDArray[np.float64]:
        """Mean raw counts [V]."""
        above = ones(len(self)).dot(self.values)  # of whole counts exact
        return np.asarray(self.series[0] + above / np.float64(len(self)))

    @cached_property
    def highest(self) -> Array:
        """Highest raw counts [V]."""
        return np.asarray(self.series.max(axis=0))

    @cached_property
    def lowest(self) -> Array:
        """Lowest raw counts [V]."""
        return np.asarray(self.series.min(axis=0))

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

    @cached_property
    def readable(self) -> bool:
        """Whether no value is unreadable."""
        return self.series.dtype.kind != "f" or bool(np.abs(self.series).max() <= LARGEST_READING)

    @cached_property
    def noise(self) -> NDArray[np.float32]:
        """Mean magnitude of the second difference of three frames, float32 [V] in counts.

        It contains the fast part of the signal: white noise counts far more than a vibration below
        a quarter of the frame rate. 0 for fewer than three frames.
        """
        frames, values = self.values.shape
        step = max(3, frames // TRIPLES)
        places = frames // step
        if not places:
            return np.zeros(values, np.float32)
        triples = self.values[: places * step].reshape(places, step, values)
        second = triples[:, 0] + triples[:, 2]
        second -= 2 * triples[:, 1]
        return np.asarray(ones(places).dot(np.abs(second)) / places, np.float32)


Counts = Array | Window


@lru_cache(maxsize=16)
def ones(number: int) -> NDArray[np.float32]:
    """Multiplies this number of values to give their sum, in a third of the time of numpy's sum."""
    return np.ones(number, np.float32)


class Waves:
    """Gives amplitudes complex64 [F, N] at `hz` [F] of series float32 [T, N], with a Hann window
    and without a polynomial of degree `trend`, 0 or 1. Phases are those in the middle: around it
    the real part of a wave is even and the imaginary part odd, so half of it suffices."""

    def __init__(self, hz: Array, frames: int, rate_hz: float, trend: int = 0) -> None:
        time = np.arange(frames) - (frames - 1) / 2
        turns: Array = np.exp(-2j * np.pi / rate_hz * hz[:, None] * time) * np.hanning(frames)
        for power in range(trend + 1):
            base = time**power / max(float(np.linalg.norm(time**power)), 1.0)
            turns -= (turns @ base)[:, None] * base
        half = turns[:, : (frames + 1) // 2]
        half[:, frames // 2 :] /= 2  # the frame in the middle is its own mirror image
        self._even, self._odd = half.real.astype(np.float32), half.imag.astype(np.float32)

    def __call__(self, series: Array) -> Array:
        """The amplitudes; not finite where a series is not."""
        frequencies, half = self._even.shape
        start, end = series[:half], series[: -half - 1 : -1].copy()  # long rows are quick to add
        amplitudes = np.empty((frequencies, series.shape[1]), np.complex64)
        amplitudes.real, amplitudes.imag = self._even @ (start + end), self._odd @ (start - end)
        return amplitudes
