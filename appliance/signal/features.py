"""The paper's equations 1 to 5: what its classical classifiers look at. In: digits of one sweep's window, frame rate.
Out: taxel weights [M], L-features [3] and H-features [frames x bands]. Pure functions; numpy only; nothing is kept.

Any grid, rate and digit type will do. Where the paper's formulas leave a choice, the reading stands at the function.
Two rules hold for every rate. A band ends at the Nyquist frequency where that is lower than its upper edge. A band in
which no bin of the spectrum lies keeps the first bin above its lower edge, or the highest there is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.signal import time_series
from appliance.signal.time_series import FLOOR

Array = NDArray[np.float64]

HIGH_HZ = (20.0, 375.0)
"""Band of roughness and c1 (eq. 2, 3); at 750 Hz and 1500 frames bins 40 to 750."""
LOW_HZ = (2.0, 20.0)
"""Band of c2 (eq. 3); bins 4 to 40."""
HOP_S, WINDOW_S = 0.05, 0.1
"""Step and length of the short windows (eq. 5)."""
SILENT = 1e-12
"""A short window of less power than this, in digits^2, is not normalised but left near zero."""


def taxel_weights(taxels: NDArray[Any]) -> Array:
    """Eq. 4: each taxel's share of the activation. taxels: digits [T, R, C]; gives [M] with M = R * C, summing to 1.

    A taxel whose mean is negative (int16 after a tare) is untouched: its weight is 0, so that no weight is negative and
    none grows without bound where means cancel. Where no mean is positive all weights are 1 / M. Raises FormatError for
    an array that is no sweep.
    """
    return time_series.weights(time_series.of(taxels))


def l_features(taxels: NDArray[Any], rate_hz: float) -> Array:
    """Eq. 1 to 3: [roughness in log(digits^2), c1 in Hz, c2 in Hz]. taxels: digits [T, R, C]; rate_hz: frames a second.

    A linear trend is removed from each taxel, so that drift does not leak into the low bands. A centroid is each
    taxel's power-weighted mean frequency in its band, then weighted by eq. 4. The mean power divides by B - A, as
    printed. Every bin's power is at least FLOOR: a silent skin gives about log(M * FLOOR) and the middle of each band.
    One frame is enough for an answer. Raises FormatError for an array that is no sweep or a rate that is none.
    """
    x = time_series.of(taxels)
    time_series.check_rate(rate_hz)
    frames = x.shape[1]
    power = np.maximum(time_series.power(time_series.detrended(x), frames), FLOOR)
    weights = time_series.weights(x)
    first, last = _bins(HIGH_HZ, frames, rate_hz)
    roughness = np.log(power[:, first : last + 1].sum() / max(last - first, 1))
    centroids = [_centroid(power, weights, band, frames, rate_hz) for band in (HIGH_HZ, LOW_HZ)]
    return np.array([roughness, *centroids])


def h_shape(frames: int, rate_hz: float) -> tuple[int, int]:
    """How many H-features a window of `frames` at `rate_hz` gives: (short windows, bands); 1500 at 750 Hz: (40, 19).

    Short windows: floor(frames / (0.05 s * rate)), one for each whole step; the sweep's end cuts the last one off.
    A short window is W = round(0.1 s * rate) frames, its bins rate / W (10 Hz) apart and used up to 375 Hz or Nyquist:
    K = min(floor(W / 2), floor(375 Hz * W / rate)). Two neighbours make a band of 20 Hz, (0, 1), (2, 3) ...; bin 0 (DC)
    counts as zero and the last band may hold one bin only: floor(K / 2) + 1 bands.
    Raises FormatError where the sweep is shorter than one short window, or a step than a frame (below 20 Hz).
    """
    _, top = _short_window(frames, rate_hz)
    return math.floor(_clean(frames / (HOP_S * rate_hz))), top // 2 + 1


def h_features(taxels: NDArray[Any], rate_hz: float, window: str = "rect") -> Array:
    """Eq. 5: power over time and frequency, [l * q] with l the short window, as `h_shape` counts them. 0 to 1, no unit.

    taxels: digits [T, R, C]; rate_hz: frames a second; window: "rect" is the paper's, "hann" leaks less.
    Short window l starts with the first frame at or after l * 0.05 s. Its mean, of the frames there are, is taken off
    before the window function. Taxels are added by eq. 4 and each l is divided by its sum over q: it sums to 1, or is 0
    in a silence. Raises FormatError as `h_shape`, for an array that is no sweep, and for another window function.
    """
    x = time_series.of(taxels)
    frames = x.shape[1]
    count, bands = h_shape(frames, rate_hz)
    width, top = _short_window(frames, rate_hz)
    cut = _cuts(x, count, width, HOP_S * rate_hz) * _window(window, width)
    power = time_series.power(cut, frames)[:, :, : top + 1]
    power[:, :, 0] = 0.0
    total = np.zeros((count, 2 * bands))
    total[:, : top + 1] = np.tensordot(time_series.weights(x), power, 1)
    paired = total.reshape(count, bands, 2).sum(axis=2)
    normalised: Array = paired / np.maximum(paired.sum(axis=1, keepdims=True), SILENT)
    return normalised.ravel()


Kinds = Mapping[str, Callable[[NDArray[Any], float], Array]]
KINDS: Kinds = MappingProxyType({"L": l_features, "H": h_features})
"""Feature sets by the name that a bundle's manifest uses."""


def compute(kind: str, taxels: NDArray[Any], rate_hz: float, kinds: Kinds = KINDS) -> NDArray[np.float32]:
    """The feature set `kind` of `kinds` of raw counts [T, R, C] at `rate_hz`, as float32 [n]. Raises FormatError."""
    if kind not in kinds:
        raise FormatError(f"feature set {kind!r} is unknown; use one of {', '.join(kinds)}")
    return kinds[kind](taxels, rate_hz).astype(np.float32)


def given(kind: str, taxels: NDArray[Any], rate_hz: float, kinds: Kinds = KINDS) -> NDArray[Any]:
    """What a graph with the input `kind` is given of raw counts [T, R, C]: them where it is "raw", else `compute`."""
    return taxels if kind == "raw" else compute(kind, taxels, rate_hz, kinds)


def _clean(bins: float) -> float:
    """`bins` as the whole number that it is but for rounding: 0.1 s at 30 Hz is 3 frames, not 3.0000000000000004."""
    return float(round(bins)) if math.isclose(bins, round(bins), rel_tol=1e-9) else bins


def _bins(band: tuple[float, float], frames: int, rate_hz: float) -> tuple[int, int]:
    """First and last bin inside `band`, by the two rules of this room."""
    low, high = (_clean(min(edge * frames / rate_hz, frames / 2)) for edge in band)
    first = min(math.ceil(low), frames // 2)
    return first, max(first, math.floor(high))


def _centroid(power: Array, weights: Array, band: tuple[float, float], frames: int, rate_hz: float) -> float:
    """Eq. 3 as it is read: power [M, bins], weights [M] -> Hz."""
    first, last = _bins(band, frames, rate_hz)
    inside = power[:, first : last + 1]
    hz = np.arange(first, last + 1) * (rate_hz / frames)
    return float(weights @ (inside @ hz / inside.sum(axis=1)))


def _short_window(frames: int, rate_hz: float) -> tuple[int, int]:
    """(W, K): frames in a short window and its highest bin used."""
    time_series.check_rate(rate_hz)
    width = round(WINDOW_S * rate_hz)
    if HOP_S * rate_hz < 1:
        raise FormatError(f"{rate_hz:g} Hz is too slow for H-features; use at least {1 / HOP_S:g} Hz, or L")
    if frames < width:
        raise FormatError(f"{frames} frames are too few for H-features at {rate_hz:g} Hz; use at least {width}, or L")
    return width, min(width // 2, math.floor(_clean(HIGH_HZ[1] * width / rate_hz)))


def _cuts(x: Array, count: int, width: int, hop: float) -> Array:
    """`x` [M, T] as short windows [M, count, width], each less its own mean; what lies beyond the end is zero."""
    starts = np.ceil(np.round(np.arange(count) * hop, 6)).astype(
        np.int64
    )  # rounded as in _clean: no 3.0000000000000004
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
