"""Features of the paper's classical classifiers, its equations 1 to 5: taxel weights [M],
L-features [3] and H-features [short windows x bands] of the raw counts of a window. Pure functions
of numpy arrays.

Raw counts are [T, R, C], or [T, R, C, A] if a taxel has several axes. Each axis is then a time
series of its own, and the taxel's weight comes from its normal axis.

Any grid, rate and data type is possible. Where the paper's formulas leave a choice, the docstring
states ours. Two rules hold for every rate. A band ends at the Nyquist frequency if that is below
its upper edge. A band without any bin of the spectrum gets the first bin above its lower edge, or
the highest bin.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError

Array = NDArray[np.float64]

HIGH_HZ = (20.0, 375.0)
"""Band of roughness and c1 (eq. 2, 3); bins 40 to 750 at 750 Hz and 1500 frames."""
LOW_HZ = (2.0, 20.0)
"""Band of c2 (eq. 3); bins 4 to 40."""
HOP_S, WINDOW_S = 0.05, 0.1
"""Step and length of the short windows (eq. 5)."""
SILENT = 1e-12
"""A short window with less power than this (counts^2) is not normalised but left near zero."""
FLOOR = 1e-6
"""Least power of a bin, or variance, in counts^2. With it a silent skin has a logarithm and a
centroid; real readings are larger and do not change."""
ROUNDING = 1e-6
"""A mean below this share of its taxel's largest count is a rounding error (float32 counts whose
means were removed). Means of unsigned counts are this small only in windows of a million frames."""


def series_of(taxels: NDArray[Any]) -> Array:
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


def taxel_weights(x: Array, axes: int = 1) -> Array:
    """Eq. 4: each taxel's share of the activation in `x` [M, T], [M] with sum 1. Each of a taxel's
    `axes` gets the same part of the taxel's weight, which is its share of the load along the
    normal.

    A taxel with a negative mean (int16 after a tare) counts as not touched and gets weight 0, so
    that no weight is negative or grows without bound where means cancel. If no mean is positive all
    weights are 1 / M.
    """
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


def power_spectrum(x: Array, frames: int) -> Array:
    """Eq. 1, squared: |DFT|^2 / frames along the last axis, in counts^2; bins from DC to
    Nyquist."""
    spectrum = np.fft.rfft(x)
    squared: Array = (spectrum.real**2 + spectrum.imag**2) / frames
    return squared


def axes(taxels: NDArray[Any]) -> int:
    """Number of axes of each taxel in raw counts [T, R, C] or [T, R, C, A]."""
    return taxels.shape[3] if taxels.ndim == 4 else 1


def l_features(taxels: NDArray[Any], rate_hz: float) -> Array:
    """Eq. 1 to 3: [roughness in log(counts^2), c1 in Hz, c2 in Hz]. taxels: raw counts; rate_hz:
    frames per second.

    A linear trend is removed from each taxel, so that drift does not leak into the low bands. A
    centroid is the power-weighted mean frequency of each taxel in the band, averaged with the
    weights of eq. 4. The mean power is divided by B - A, as printed. Every bin's power is at least
    FLOOR, so that a silent skin gives about log(M * FLOOR) and the middle of each band. One frame
    is enough. Raises FormatError if the array is not a sweep, or for an invalid rate.
    """
    x = series_of(taxels)
    check_rate(rate_hz)
    frames = x.shape[1]
    power = np.maximum(power_spectrum(detrended(x), frames), FLOOR)
    weights = taxel_weights(x, axes(taxels))
    first, last = _bins(HIGH_HZ, frames, rate_hz)
    roughness = np.log(power[:, first : last + 1].sum() / max(last - first, 1))
    centroids = [_centroid(power, weights, band, frames, rate_hz) for band in (HIGH_HZ, LOW_HZ)]
    return np.array([roughness, *centroids])


def h_shape(frames: int, rate_hz: float) -> tuple[int, int]:
    """Shape (short windows, bands) of the H-features of `frames` frames at `rate_hz`; (40, 19) for
    1500 at 750 Hz.

    Short windows: floor(frames / (0.05 s * rate)), one for each whole step; the last one is cut off
    at the sweep's end. A short window has W = round(0.1 s * rate) frames. Its bins are rate / W (10
    Hz) apart and used up to 375 Hz or Nyquist: K = min(floor(W / 2), floor(375 Hz * W / rate)). Two
    neighbouring bins make a band of 20 Hz, (0, 1), (2, 3) and so on; bin 0 (DC) counts as zero and
    the last band may have one bin only: floor(K / 2) + 1 bands. Raises FormatError if the sweep is
    shorter than one short window, or a step shorter than a frame (below 20 Hz).
    """
    _, top = _short_window(frames, rate_hz)
    return math.floor(_clean(frames / (HOP_S * rate_hz))), top // 2 + 1


def h_features(taxels: NDArray[Any], rate_hz: float, window: str = "rect") -> Array:
    """Eq. 5: power over time and frequency, float64 [l * q] for l short windows and q bands
    (`h_shape`), 0 to 1, no unit.

    taxels: raw counts; rate_hz: frames per second; window: "rect" is the paper's, "hann" leaks
    less. Short window l starts with the first frame at or after l * 0.05 s. The mean of its frames
    is subtracted before the window function is applied. Taxels are added with the weights of eq. 4,
    and each short window is divided by its sum over q: it sums to 1, or is 0 if silent. Raises
    FormatError as `h_shape` does, if the array is not a sweep, and for an unknown window function.
    """
    x = series_of(taxels)
    frames = x.shape[1]
    count, bands = h_shape(frames, rate_hz)
    width, top = _short_window(frames, rate_hz)
    cut = _cuts(x, count, width, HOP_S * rate_hz) * _window(window, width)
    power = power_spectrum(cut, frames)[:, :, : top + 1]
    power[:, :, 0] = 0.0
    total = np.zeros((count, 2 * bands))
    total[:, : top + 1] = np.tensordot(taxel_weights(x, axes(taxels)), power, 1)
    paired = total.reshape(count, bands, 2).sum(axis=2)
    normalised: Array = paired / np.maximum(paired.sum(axis=1, keepdims=True), SILENT)
    return normalised.ravel()


KINDS: Mapping[str, Callable[[NDArray[Any], float], Array]] = MappingProxyType(
    {"L": l_features, "H": h_features}
)
"""Feature sets by their names in a bundle's manifest."""


def compute(kind: str, taxels: NDArray[Any], rate_hz: float) -> NDArray[np.float32]:
    """Feature set `kind` of raw counts at `rate_hz`: float32 [n]. Raises FormatError."""
    if kind not in KINDS:
        raise FormatError(f"feature set {kind!r} is unknown; use one of {', '.join(KINDS)}")
    return KINDS[kind](taxels, rate_hz).astype(np.float32)


def _clean(bins: float) -> float:
    """`bins` without rounding errors next to a whole number: 0.1 s at 30 Hz is 3 frames, not
    3.0000000000000004."""
    return float(round(bins)) if math.isclose(bins, round(bins), rel_tol=1e-9) else bins


def _bins(band: tuple[float, float], frames: int, rate_hz: float) -> tuple[int, int]:
    """First and last bin inside `band`, by the two rules at the top of this module."""
    low, high = (_clean(min(edge * frames / rate_hz, frames / 2)) for edge in band)
    first = min(math.ceil(low), frames // 2)
    return first, max(first, math.floor(high))


def _centroid(
    power: Array, weights: Array, band: tuple[float, float], frames: int, rate_hz: float
) -> float:
    """Eq. 3, as described in `l_features`: power [M, bins], weights [M] -> Hz."""
    first, last = _bins(band, frames, rate_hz)
    inside = power[:, first : last + 1]
    hz = np.arange(first, last + 1) * (rate_hz / frames)
    return float(weights @ (inside @ hz / inside.sum(axis=1)))


def _short_window(frames: int, rate_hz: float) -> tuple[int, int]:
    """(W, K): number of frames in a short window, and its highest bin that is used."""
    check_rate(rate_hz)
    width = round(WINDOW_S * rate_hz)
    if HOP_S * rate_hz < 1:
        raise FormatError(
            f"{rate_hz:g} Hz is too slow for H-features; use at least {1 / HOP_S:g} Hz, or L"
        )
    if frames < width:
        raise FormatError(
            f"{frames} frames are too few for H-features at {rate_hz:g} Hz; use at least {width}, "
            "or L"
        )
    return width, min(width // 2, math.floor(_clean(HIGH_HZ[1] * width / rate_hz)))


def _cuts(x: Array, count: int, width: int, hop: float) -> Array:
    """`x` [M, T] as short windows [M, count, width], each minus its own mean; zero beyond the end
    of `x`."""
    # rounded, since 3.0000000000000004 would be taken for 4
    starts = np.ceil(np.round(np.arange(count) * hop, 6)).astype(np.int64)
    at = starts[:, None] + np.arange(width)
    there = at < x.shape[1]
    cut = np.where(there, x[:, np.minimum(at, x.shape[1] - 1)], 0.0)
    mean = cut.sum(axis=2, keepdims=True) / there.sum(axis=1)[:, None]
    return np.where(there, cut - mean, 0.0)


def _window(name: str, width: int) -> Array:
    if name == "rect":
        return np.ones(width)
    if name == "hann":
        return np.sin(np.pi * np.arange(width) / width) ** 2
    raise FormatError(f"window function {name!r} is unknown; use rect or hann")
