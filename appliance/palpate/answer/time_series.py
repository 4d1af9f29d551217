"""One window as time series, the basis of all features: raw counts become float64 [M, T] with M = R
* C * A, the axes of a taxel side by side. Means, taxel weights, detrended series and power spectra.
Pure functions of numpy arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError

Array = NDArray[np.float64]

FLOOR = 1e-6
"""Least power of a bin, or variance, in counts^2. With it a silent skin has a logarithm and a
centroid; real readings are larger and do not change."""
ROUNDING = 1e-6
"""A mean below this share of its taxel's largest count is a rounding error (float32 counts whose
means were removed). Means of unsigned counts are this small only in windows of a million frames."""


def of(taxels: NDArray[Any]) -> Array:
    """Raw counts [T, R, C] or [T, R, C, A] as one time series per taxel and axis, row by row:
    float64 [M, T]. Raises FormatError if the array is not a sweep or not finite."""
    if taxels.ndim not in (3, 4) or taxels.size == 0:
        raise FormatError(
            f"an array of shape {taxels.shape} is not a sweep; use frames x rows x columns (x "
            "axes), "
            "none of them 0"
        )
    x = np.ascontiguousarray(taxels.reshape(len(taxels), -1).T, np.float64)
    if not np.isfinite(x).all():
        raise FormatError(
            "the sweep holds counts that are not a number or infinite; check how it was recorded"
        )
    return x


def check_rate(rate_hz: float) -> None:
    """Raises FormatError if `rate_hz` is not a positive number."""
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise FormatError(f"a rate of {rate_hz} Hz is out of range; use more than 0")


def means(x: Array) -> Array:
    """Means over time [M] of `x` [M, T] in counts; 0 if smaller than ROUNDING."""
    mean: Array = x.mean(axis=1)
    mean[np.abs(mean) < ROUNDING * np.abs(x).max(axis=1)] = 0.0
    return mean


def weights(x: Array, axes: int = 1) -> Array:
    """Eq. 4 for `x` [M, T]: weights [M] that sum to 1, see `features.taxel_weights`. Each of a
    taxel's `axes` gets the same part of the taxel's weight, which is its share of the load along
    the normal."""
    mean = np.maximum(means(x[axes - 1 :: axes]), 0.0)
    total = mean.sum()
    share: Array = mean / total if total > 0 else np.full(len(mean), 1 / len(mean))
    return share.repeat(axes) / axes


def detrended(x: Array) -> Array:
    """`x` [M, T] minus the least-squares line of each series."""
    centred: Array = x - x.mean(axis=1, keepdims=True)
    time = np.arange(x.shape[1]) - (x.shape[1] - 1) / 2
    slope = centred @ time / max(time @ time, 1.0)
    centred -= slope[:, None] * time
    return centred


def power(x: Array, frames: int) -> Array:
    """Eq. 1, squared: |DFT|^2 / frames along the last axis, in counts^2; bins from DC to
    Nyquist."""
    spectrum = np.fft.rfft(x)
    squared: Array = (spectrum.real**2 + spectrum.imag**2) / frames
    return squared
