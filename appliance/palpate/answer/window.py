"""One window of raw counts, with what several rules need of it: computed when it is first needed,
once, and in float32. Pure functions of raw counts."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import LARGEST_READING

Array = NDArray[Any]
T = TypeVar("T")
TRIPLES = 100
"""Number of places in a stretch at which the noise is measured. More places take more time and
change the result by less than a tenth."""
TINY = 1e-30
"""Replaces 0 as a divisor, or where a logarithm is taken."""


class once(Generic[T]):
    """A property that is computed when it is first read, in half the time of functools' own."""

    def __init__(self, compute: Callable[[Any], T]) -> None:
        self._compute, self.__doc__ = compute, compute.__doc__

    def __get__(self, window: Any, owner: type) -> T:
        value = window.__dict__[self._compute.__name__] = self._compute(window)
        return value


class Window:
    """A stretch of T frames with V values each, in the order of a frame, N of them along the
    normal. taxels: raw counts [T, R, C] or [T, R, C, A]."""

    def __init__(self, taxels: Array) -> None:
        self.taxels = taxels
        self.series = taxels.reshape(len(taxels), -1)
        """Raw counts [T, V]."""

    @classmethod
    def of(cls, taxels: Counts) -> Window:
        """The window of raw counts, or the given one."""
        return taxels if isinstance(taxels, Window) else cls(taxels)

    def __len__(self) -> int:
        return len(self.taxels)

    @once
    def values(self) -> NDArray[np.float32]:
        """Counts [T, V] above the first frame: squares of large counts would round small vibrations
        away. NaN throughout for a value that is not readable."""
        values = self.series.astype(np.float32)
        first = values[0] if self.readable else np.where(self.unreadable, np.nan, values[0])
        together = next(n for n in (100, 64, 50, 32, 20, 10, 1) if not len(values) % n)
        rows = values.reshape(-1, together * len(first))  # long rows are quick to subtract
        rows -= (ones(together)[:, None] * first).ravel()
        return values

    @once
    def counts(self) -> NDArray[np.float32]:
        """The values along the normal, [T, N]."""
        axes = self.taxels.shape[3] if self.taxels.ndim == 4 else 1
        values = self.values
        return values if axes == 1 else np.ascontiguousarray(values[:, axes - 1 :: axes])

    @once
    def mean(self) -> NDArray[np.float64]:
        """Mean raw counts [V]."""
        above = ones(len(self)).dot(self.values)  # of whole counts exact
        return np.asarray(self.series[0] + above / np.float64(len(self)))

    @once
    def highest(self) -> Array:
        """Highest raw counts [V]."""
        return np.asarray(self.series.max(axis=0))

    @once
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

    @once
    def readable(self) -> bool:
        """Whether no value is unreadable."""
        return self.series.dtype.kind != "f" or bool(np.abs(self.series).max() <= LARGEST_READING)

    @once
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
        noise: NDArray[np.float32] = ones(places).dot(np.abs(second)) / places
        return noise

    @once
    def quietest(self) -> float:
        """The least noise of a value; above 0 if all values change, surely."""
        return float(np.minimum.reduce(self.noise))


Counts = Array | Window


@lru_cache(maxsize=16)
def ones(number: int) -> NDArray[np.float32]:
    """Multiplies this number of values to give their sum, in a third of the time of numpy's sum."""
    return np.ones(number, np.float32)


class Waves:
    """Gives amplitudes float32 [F, 2, N] at `hz` [F] of series float32 [T, N], real and imaginary
    parts one after the other, with a Hann window and without a polynomial of degree `trend`, 0 or
    1. Phases are those in the middle: around it the real part of a wave is even and the imaginary
    part odd, so half of it suffices."""

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
        amplitudes = np.empty((frequencies, 2, series.shape[1]), np.float32)
        np.matmul(self._even, start + end, out=amplitudes[:, 0])
        np.matmul(self._odd, start - end, out=amplitudes[:, 1])
        return amplitudes
