"""What all features start from: digits of one sweep's window as time series. In: digits [T, R, C]. Out: float64 [M, T],
M = R * C, their means, taxel weights, trends and spectra. Pure functions; numpy only; nothing is kept.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError

Array = NDArray[np.float64]

FLOOR = 1e-6
"""Least power of a bin, or variance, in digits^2: a silent skin has a logarithm and a centroid, and no real reading is
changed."""
ROUNDING = 1e-6
"""A mean of less than this share of its taxel's largest digit is what rounding left of none (float32 digits whose means
were removed). No mean of digits from 0 up is so small, but in windows of a million frames."""


def of(taxels: NDArray[Any]) -> Array:
    """Digits [T, R, C] as one time series a taxel, row by row: float64 [M, T]. Raises FormatError where it is none."""
    if taxels.ndim != 3 or taxels.size == 0:
        raise FormatError(f"an array of shape {taxels.shape} is no sweep; use frames x rows x columns, none of them 0")
    x = np.ascontiguousarray(taxels.reshape(len(taxels), -1).T, np.float64)
    if not np.isfinite(x).all():
        raise FormatError("the sweep holds digits that are not a number or infinite; check how it was recorded")
    return x


def check_rate(rate_hz: float) -> None:
    """Raises FormatError where `rate_hz` is no rate."""
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise FormatError(f"a rate of {rate_hz} Hz is out of range; use more than 0")


def means(x: Array) -> Array:
    """Temporal means [M] of `x` [M, T] in digits; 0 where ROUNDING says so."""
    mean: Array = x.mean(axis=1)
    mean[np.abs(mean) < ROUNDING * np.abs(x).max(axis=1)] = 0.0
    return mean


def weights(x: Array) -> Array:
    """Eq. 4 of `x` [M, T]: weights [M] that sum to 1, as `features.taxel_weights` says."""
    mean = np.maximum(means(x), 0.0)
    total = mean.sum()
    share: Array = mean / total if total > 0 else np.full(len(x), 1 / len(x))
    return share


def detrended(x: Array) -> Array:
    """`x` [M, T] less its straight line of least squares."""
    centred: Array = x - x.mean(axis=1, keepdims=True)
    time = np.arange(x.shape[1]) - (x.shape[1] - 1) / 2
    slope = centred @ time / max(time @ time, 1.0)
    centred -= slope[:, None] * time
    return centred


def power(x: Array, frames: int) -> Array:
    """Eq. 1, squared: |sum over time|^2 / frames, in digits^2, along the last axis; bins from DC to Nyquist."""
    spectrum = np.fft.rfft(x)
    squared: Array = (spectrum.real**2 + spectrum.imag**2) / frames
    return squared
