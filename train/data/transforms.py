"""Reductions: the same sweeps with fewer frames, taxels or bits. In: a Dataset, a Change. Out: a
Dataset.

Each change is one that an integrator can set on a sensor, and is done here as it would be there.
Only the length of the window is set on the box, which takes the middle of each sweep in any case.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from train.data.sets import Dataset

Array = NDArray[Any]
BANDS = 6
"""Of a taxel's spectrum, equally wide on a logarithmic scale: its contribution to the classes is
judged by them."""
RIDGE = 0.1
"""Variance of each band that counts as noise. With more, a second copy of a taxel would add
something; less relies on too few sweeps."""
BATCH = 32
"""Sweeps whose spectra are in memory at the same time."""


@dataclass(frozen=True)
class Change:
    """What is left out; by default nothing.

    window: share of the frames that is kept, the middle. rate: so many frames are averaged into one
    by the readout board, without any other filter. taxels: those that are kept, with all axes,
    numbered row by row; () for all. bits: so many of the lowest are cut off.
    """

    window: float = 1.0
    rate: int = 1
    taxels: tuple[int, ...] = ()
    bits: int = 0

    def of(self, sweeps: Dataset) -> Dataset:
        """The changed sweeps, of the same data type. A grid remains one where whole rows and
        columns are left, else the taxels form one column. Raises FormatError where no frame is
        left."""
        x = sweeps.samples
        if self.taxels:
            x = _kept(x, self.taxels)
        if self.bits:
            x = _coarse(x, self.bits)
        if self.rate > 1:
            x = _averaged(x, self.rate)
        if self.window < 1:
            frames = max(round(self.window * x.shape[1]), 1)
            first = (x.shape[1] - frames) // 2
            x = x[:, first : first + frames]
        if x is sweeps.samples:
            return sweeps
        unloaded = sweeps.unloaded  # of fewer taxels nothing is known
        if x.shape[2:] != sweeps.samples.shape[2:]:
            unloaded = None
        return replace(sweeps, samples=x, rate_hz=sweeps.rate_hz / self.rate, unloaded=unloaded)

    def __str__(self) -> str:
        left = [
            f"{k} {len(v) if k == 'taxels' else v}"
            for k, v in vars(self).items()
            if v != getattr(WHOLE, k)
        ]
        return ", ".join(left) or "all"

    def and_then(self, other: Change) -> Change:
        """Both changes, which must leave out different things."""
        changed = {
            k: v for one in (self, other) for k, v in vars(one).items() if v != getattr(WHOLE, k)
        }
        return Change(**changed)


WHOLE = Change()


def _kept(x: Array, taxels: tuple[int, ...]) -> Array:
    n, frames, grid_rows, cols, *axes = x.shape
    row, col = np.divmod(np.array(sorted(taxels)), cols)
    rows, columns = np.unique(row), np.unique(col)
    format = (
        (len(rows), len(columns)) if len(rows) * len(columns) == len(taxels) else (len(taxels), 1)
    )
    kept = x.reshape(n, frames, grid_rows * cols, *axes)[:, :, sorted(taxels)]
    return np.ascontiguousarray(kept).reshape(n, frames, *format, *axes)


def _coarse(x: Array, bits: int) -> Array:
    """Integers lose their lowest bits; floating-point counts are taken as eight bits over the range
    of the set."""
    if x.dtype.kind != "f":
        coarse: Array = x >> bits << bits
        return coarse
    low, high = float(x.min()), float(x.max())
    step = max((high - low) / 2 ** (8 - bits), np.finfo(np.float32).tiny)
    rounded: Array = low + np.floor((x - low) / step) * step
    return rounded.astype(x.dtype)


def _averaged(x: Array, rate: int) -> Array:
    n, frames = x.shape[0], x.shape[1] // rate
    mean: Array = (
        x[:, : frames * rate].reshape(n, frames, rate, *x.shape[2:]).mean(axis=2, dtype=np.float64)
    )
    return (mean if x.dtype.kind == "f" else np.rint(mean)).astype(x.dtype)


def order(sweeps: Dataset) -> list[int]:
    """Taxels by how well they separate materials, the best first: the last one is the first to be
    removed.

    Backward elimination (Marill and Green 1963) by Fisher's criterion trace(W^-1 B) (Fukunaga 1990,
    sec. 10.2) of the log powers in BANDS bands of each taxel, on all its axes, scaled to variance 1
    and with RIDGE in W, the scatter within materials. Removing one taxel from the inverse is a step
    in closed form, so that nothing is trained.
    """
    format, powers = sweeps.format, _powers(sweeps.samples)  # [N, M, BANDS]
    n, taxels, bands = len(powers), format.rows * format.cols, format.axes * BANDS
    x = powers.reshape(n, -1)
    x = (x - x.mean(0)) / np.maximum(x.std(0), 1e-9)
    within, between = x.copy(), np.zeros((x.shape[1],) * 2)
    for label in np.unique(sweeps.labels):
        chosen = sweeps.labels == label
        mean = x[chosen].mean(0)
        within[chosen] -= mean
        between += chosen.mean() * np.outer(mean, mean)
    inverse = np.linalg.inv(within.T @ within / n + RIDGE * np.eye(within.shape[1]))
    blocks = {taxel: slice(taxel * bands, (taxel + 1) * bands) for taxel in range(taxels)}
    removed: list[int] = []
    while blocks:
        loss = inverse @ between @ inverse
        costs = {
            t: float(np.trace(np.linalg.solve(inverse[b, b], loss[b, b])))
            for t, b in blocks.items()
        }
        least = min(costs, key=lambda t: costs[t])
        b = blocks.pop(least)
        inverse = inverse - inverse[:, b] @ np.linalg.solve(inverse[b, b], inverse[b, :])
        removed.append(least)
    return removed[::-1]


def _powers(samples: Array) -> Array:
    """Log power [N, M, BANDS] of sweeps, the mean of each taxel and axis subtracted; M = R * C *
    A."""
    n, frames = samples.shape[:2]
    bins = np.geomspace(1, max(frames // 2 + 1, 2), BANDS + 1)
    starts = np.minimum(bins.astype(int)[:-1], frames // 2)
    ends = np.maximum(bins.astype(int)[1:], starts + 1)
    parts = []
    for first in range(0, n, BATCH):
        x = (
            samples[first : first + BATCH]
            .reshape(-1, frames, samples[0, 0].size)
            .astype(np.float64)
        )
        power = np.abs(np.fft.rfft(x - x.mean(axis=1, keepdims=True), axis=1)) ** 2 / frames
        parts.append(
            np.stack(
                [power[:, a:b].mean(axis=1) for a, b in zip(starts, ends, strict=True)], axis=2
            )
        )
    powers: Array = np.concatenate(parts)
    log_powers: Array = np.log(powers + 1e-3 * powers.mean() + np.finfo(float).tiny)
    return log_powers
