"""Features of the work that the paper compares itself with, float64 [n], from raw counts of one
window.

Static features (Hoelscher et al. 2015), spectrogram (Sinapov et al. 2011), correlation features
(Kaboli et al. 2015, Chathuranga et al. 2015). The papers used other sensors (BioTac,
accelerometers, three magnetic axes), so each function says how we adapted it to a pressure skin.
Any grid, frame rate and data type is accepted. Raw counts are [T, R, C], or [T, R, C, A] if a taxel
has several axes: each axis is a series, and load and centre come from the normal axis.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer import features
from palpate.core.errors import FormatError

Array = NDArray[np.float64]

LOADED = 0.1
"""A taxel is in contact if its mean exceeds this share of the strongest taxel's mean."""
TIME_BINS, FREQUENCY_BINS = 5, 25
"""Size of the spectrogram of Sinapov et al. 2011 after down-sampling."""


def static(taxels: NDArray[Any], rate_hz: float) -> Array:
    """Features that do not depend on the order of the frames (Hoelscher et al. 2015), [2 M + 7]
    with M = R * C * A.

    taxels: raw counts; rate_hz is not used. The features are:

    - mean [M] and standard deviation over time [M] of each series
    - mean, standard deviation, minimum and maximum of the pressure, the mean count of a frame
    - row and column of the centre of pressure, in taxels from the middle of the grid, with the
      weights of eq. 4
    - the share of taxels in contact

    The choice is ours: a pressure skin lacks their best features, temperature and thermal flow. One
    frame is enough. Raises FormatError for an array that is not a sweep.
    """
    x = features.series_of(taxels)
    load = x[features.axes(taxels) - 1 :: features.axes(taxels)]
    mean, pressure = features.means(load), load.mean(axis=0)
    rows, cols = taxels.shape[1:3]
    position = np.indices((rows, cols)).reshape(2, -1) - (np.array([[rows], [cols]]) - 1) / 2
    area = np.mean(mean > LOADED * mean.max())
    whole = [features.means(pressure[None])[0], pressure.std(), pressure.min(), pressure.max()]
    centre = position @ features.taxel_weights(load)
    return np.concatenate([features.means(x), x.std(axis=1), whole, centre, [area]])


def spectrogram(taxels: NDArray[Any], rate_hz: float) -> Array:
    """Log power in 5 parts of the sweep x 25 bands of frequency (Sinapov et al. 2011), [125],
    log(counts^2).

    taxels: raw counts; rate_hz is not used. Only the number of bins is published; the rest is our
    interpretation: equal parts of the sweep, and equal bands from 0 to Nyquist. We subtract each
    part's mean, apply a Hann window, and average the power of the bins without DC within each band.
    Taxels are added with the weights of eq. 4, as the paper does for H. A part shorter than 50
    frames has fewer than 25 bins, so its spectrum is interpolated by appending zeros. Power is at
    least FLOOR: a silent skin gives log(FLOOR). Raises FormatError for an array that is not a
    sweep, and if a part would have fewer than four frames.
    """
    x = features.series_of(taxels)
    if x.shape[1] < 4 * TIME_BINS:
        raise FormatError(
            f"{x.shape[1]} frames are too few for a spectrogram; "
            f"use at least {4 * TIME_BINS}, or L-features"
        )
    weights = features.taxel_weights(x, features.axes(taxels))
    parts = []
    for part in np.array_split(x, TIME_BINS, axis=1):
        frames = part.shape[1]
        hann = np.sin(np.pi * (np.arange(frames) + 0.5) / frames) ** 2
        shaped = np.zeros((len(x), max(frames, 2 * FREQUENCY_BINS)))
        shaped[:, :frames] = (part - part.mean(axis=1, keepdims=True)) * hann
        power = weights @ features.power_spectrum(shaped, frames)[:, 1:]
        parts += [band.mean() for band in np.array_split(power, FREQUENCY_BINS)]
    log_power: Array = np.log(np.maximum(parts, features.FLOOR))
    return log_power


def correlation(taxels: NDArray[Any], rate_hz: float) -> Array:
    """Nine numbers for any grid: how each taxel varies, and how taxels vary together. taxels: raw
    counts.

    From Kaboli et al. 2015, summed over taxels with the weights of eq. 4:

    - Hjorth's activity, the log of the variance, in log(counts^2)
    - mobility, the deviation of the change per second divided by the deviation of the counts, in
      1/s
    - complexity, the mobility of the change divided by the mobility

    Also from Kaboli et al., over all pairs of taxels: mean and spread of the linear (Pearson) and
    non-linear (Spearman, by ranks) correlation. From Chathuranga et al. 2015: the log of the
    Frobenius norm of the covariance matrix, in log(counts^2), and the mean count.

    Their axes and cells are our taxels. Constant taxels are left out of correlations, which are 0
    if fewer than two taxels vary. Variances are at least FLOOR: for a silent skin mobility is
    `rate_hz` and complexity 1. Raises FormatError for an array that is not a sweep, fewer than
    three frames, or an invalid rate.
    """
    x = features.series_of(taxels)
    features.check_rate(rate_hz)
    from scipy.stats import rankdata  # only here: every process of the tests would load it

    if x.shape[1] < 3:
        raise FormatError(
            f"{x.shape[1]} frames are too few for a change of the change; "
            "use at least 3, or L-features"
        )
    centred = x - x.mean(axis=1, keepdims=True)
    varying = centred[centred.var(axis=1) > features.FLOOR]
    covariance = np.sqrt(_sum_of_squared_products(centred)) / x.shape[1]
    ranks = rankdata(varying, axis=1) - (x.shape[1] + 1) / 2  # equal values share their mean rank
    together = [*_pairs(varying), *_pairs(ranks)]
    last = [np.log(max(covariance, features.FLOOR)), features.means(x.mean(axis=0)[None])[0]]
    return np.concatenate(
        [_hjorth(x, rate_hz) @ features.taxel_weights(x, features.axes(taxels)), together, last]
    )


def _hjorth(x: Array, rate_hz: float) -> Array:
    """Activity, mobility and complexity [3, M] of each series in `x` [M, T]."""
    change = np.diff(x, axis=1)
    variances = [
        np.maximum(s.var(axis=1), features.FLOOR) for s in (x, change, np.diff(change, axis=1))
    ]
    mobility, of_change = (np.sqrt(after / before) for before, after in pairwise(variances))
    return np.array([np.log(variances[0]), mobility * rate_hz, of_change / mobility])


def _sum_of_squared_products(z: Array) -> float:
    """Sum over all i and j of (z_i . z_j)^2 for `z` [M, T], computed from the smaller of its two
    Gram matrices."""
    gram = z @ z.T if len(z) <= z.shape[1] else z.T @ z
    return float((gram**2).sum())


def _pairs(varying: Array) -> tuple[float, float]:
    """Mean and standard deviation of the correlation over all pairs in `varying` [m, T], whose
    series have mean 0 and are not constant.

    Computed from sums over all taxels, so a large grid needs no matrix of all pairs.
    """
    m = len(varying)
    if m < 2:
        return 0.0, 0.0
    z = varying / np.linalg.norm(varying, axis=1, keepdims=True)
    mean = float((np.linalg.norm(z.sum(axis=0)) ** 2 - m) / (m * (m - 1)))
    square = (_sum_of_squared_products(z) - m) / (m * (m - 1))
    return mean, float(np.sqrt(max(square - mean**2, 0.0)))
