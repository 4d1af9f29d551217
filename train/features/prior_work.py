"""Features of the work that the paper compares itself with, in the form that a pressure skin allows. In: digits of one
sweep's window, frame rate. Out: static features (Hoelscher et al. 2015), spectrogram (Sinapov et al. 2011), correlation
features (Kaboli et al. 2015, Chathuranga et al. 2015), all float64 [n]. Pure functions; numpy only; nothing is kept.

The papers used other sensors (BioTac, accelerometers, three magnetic axes); how each was read stands at its function.
Any grid, rate and digit type will do.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.signal import time_series

Array = NDArray[np.float64]

LOADED = 0.1
"""A taxel is in contact where its mean is more than this share of the strongest taxel's."""
TIME_BINS, FREQUENCY_BINS = 5, 25
"""The spectrogram of Sinapov et al. 2011 after down-sampling."""


def static(taxels: NDArray[Any], rate_hz: float) -> Array:
    """What does not depend on the order of the frames (Hoelscher et al. 2015), [2 M + 7] with M = R * C.

    taxels: digits [T, R, C]; rate_hz is not looked at. Each taxel's mean [M] and standard deviation over time [M];
    mean, standard deviation, least and greatest of the pressure, which is the mean digit of a frame; the centre of
    pressure (row, column; in taxels from the middle of the grid, weights by eq. 4); the share of taxels in contact.
    The choice is ours: of their best features, temperature and thermal flow, a pressure skin has none. One frame is
    enough.
    Raises FormatError for an array that is no sweep.
    """
    x = time_series.of(taxels)
    mean, pressure = time_series.means(x), x.mean(axis=0)
    rows, cols = taxels.shape[1:]
    place = np.indices((rows, cols)).reshape(2, -1) - (np.array([[rows], [cols]]) - 1) / 2
    area = np.mean(mean > LOADED * mean.max())
    whole = [time_series.means(pressure[None])[0], pressure.std(), pressure.min(), pressure.max()]
    return np.concatenate([mean, x.std(axis=1), whole, place @ time_series.weights(x), [area]])


def spectrogram(taxels: NDArray[Any], rate_hz: float) -> Array:
    """Log power in 5 parts of the sweep x 25 bands of frequency (Sinapov et al. 2011), [125], log(digits^2).

    taxels: digits [T, R, C]; rate_hz is not looked at. The number of bins is theirs, the rest our reading: equal parts
    of the sweep, equal bands from 0 to Nyquist. Each part loses its mean and is weighed with a Hann window; the power of
    its bins without DC is averaged within each band, and the taxels are added by eq. 4 as the paper does for H. The
    spectrum of a part shorter than 50 frames has less than 25 bins and is interpolated (zeros are appended). Power is
    at least FLOOR: a silent skin gives log(FLOOR).
    Raises FormatError for an array that is no sweep, and where a part would have less than four frames.
    """
    x = time_series.of(taxels)
    if x.shape[1] < 4 * TIME_BINS:
        raise FormatError(f"{x.shape[1]} frames are too few for a spectrogram; use at least {4 * TIME_BINS}, or L")
    weights = time_series.weights(x)
    parts = []
    for part in np.array_split(x, TIME_BINS, axis=1):
        frames = part.shape[1]
        hann = np.sin(np.pi * (np.arange(frames) + 0.5) / frames) ** 2
        shaped = np.zeros((len(x), max(frames, 2 * FREQUENCY_BINS)))
        shaped[:, :frames] = (part - part.mean(axis=1, keepdims=True)) * hann
        power = weights @ time_series.power(shaped, frames)[:, 1:]
        parts += [band.mean() for band in np.array_split(power, FREQUENCY_BINS)]
    log_power: Array = np.log(np.maximum(parts, time_series.FLOOR))
    return log_power


def correlation(taxels: NDArray[Any], rate_hz: float) -> Array:
    """Nine numbers whatever the grid: how a taxel moves, and how the taxels move together. taxels: digits [T, R, C].

    Of Kaboli et al. 2015: Hjorth's activity (log of the variance, in log(digits^2)), mobility (deviation of the change
    per second over that of the digits, in 1/s) and complexity (mobility of the change over mobility), each summed over
    taxels by eq. 4; mean and spread over all pairs of taxels of the linear (Pearson) and non-linear (Spearman, by
    ranks) correlation. Of Chathuranga et al. 2015: the log of the Frobenius norm of the covariance matrix, in
    log(digits^2), and the mean digit. Their axes and cells are our taxels; one that does not move takes no part in a
    correlation, which is 0 where less than two move. Variances are at least FLOOR: in a silence mobility is `rate_hz`
    and complexity 1. Raises FormatError for an array that is no sweep, less than three frames, or a rate that is none.
    """
    x = time_series.of(taxels)
    time_series.check_rate(rate_hz)
    if x.shape[1] < 3:
        raise FormatError(f"{x.shape[1]} frames are too few for a change of the change; use at least 3, or L")
    centred = x - x.mean(axis=1, keepdims=True)
    moving = centred[centred.var(axis=1) > time_series.FLOOR]
    covariance = np.sqrt(_sum_of_squared_products(centred)) / x.shape[1]
    together = [*_pairs(moving), *_pairs(np.array([_ranks(one) for one in moving]))]
    last = [np.log(max(covariance, time_series.FLOOR)), time_series.means(x.mean(axis=0)[None])[0]]
    return np.concatenate([_hjorth(x, rate_hz) @ time_series.weights(x), together, last])


def _hjorth(x: Array, rate_hz: float) -> Array:
    """Activity, mobility and complexity of each series in `x` [M, T]: [3, M]."""
    change = np.diff(x, axis=1)
    variances = [np.maximum(s.var(axis=1), time_series.FLOOR) for s in (x, change, np.diff(change, axis=1))]
    mobility, of_change = (np.sqrt(after / before) for before, after in pairwise(variances))
    return np.array([np.log(variances[0]), mobility * rate_hz, of_change / mobility])


def _ranks(one: Array) -> Array:
    """Ranks of the values in `one` [T], equal ones sharing their mean rank, less their mean."""
    _, inverse, counts = np.unique(one, return_inverse=True, return_counts=True)
    rank = np.cumsum(counts) - (counts - 1) / 2
    shared: Array = rank[inverse] - (len(one) + 1) / 2
    return shared


def _sum_of_squared_products(z: Array) -> float:
    """Sum over all i and j of (z_i . z_j)^2 for `z` [M, T], by whichever of the two Gram matrices is smaller."""
    gram = z @ z.T if len(z) <= z.shape[1] else z.T @ z
    return float((gram**2).sum())


def _pairs(moving: Array) -> tuple[float, float]:
    """Mean and standard deviation of the correlation over all pairs in `moving` [m, T], each of mean 0 and not silent.

    From sums over all taxels, so that a large grid needs no matrix of all its pairs.
    """
    m = len(moving)
    if m < 2:
        return 0.0, 0.0
    z = moving / np.linalg.norm(moving, axis=1, keepdims=True)
    mean = float((np.linalg.norm(z.sum(axis=0)) ** 2 - m) / (m * (m - 1)))
    square = (_sum_of_squared_products(z) - m) / (m * (m - 1))
    return mean, float(np.sqrt(max(square - mean**2, 0.0)))
