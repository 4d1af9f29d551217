"""Reductions of a sweep set: the same sweeps with fewer frames, taxels or bits.

Each change models a setting of the sensor. Only the length of the window is a setting of the box,
which always takes the middle of each sweep.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from palpate.core.sweep_set import Array
from palpate_train.data.sets import Dataset

BANDS = 6
"""Number of bands of a taxel's spectrum, equally wide on a logarithmic scale. Taxels are ranked by
the log powers in them."""
RIDGE = 0.1
"""Variance of each band that counts as noise. With a larger value a copy of a taxel would still
count as useful; a smaller value trusts the scatter of few sweeps too much."""
BATCH = 32
"""Number of sweeps whose spectra are in memory at the same time."""


@dataclass(frozen=True)
class Change:
    """A reduction; the default changes nothing.

    window: share of the frames to keep, from the middle. rate: number of consecutive frames that
    the readout board averages into a frame, without any other filter. taxels: taxels to keep with
    all their axes, numbered row by row; () keeps all. bits: number of lowest bits to cut off.
    """

    window: float = 1.0
    rate: int = 1
    taxels: tuple[int, ...] = ()
    bits: int = 0

    def of(self, sweeps: Dataset) -> Dataset:
        """The changed sweeps, in the same data type.

        The taxels stay a grid if whole rows and columns are kept, else they form a single column.
        Raises FormatError if no frame is left.
        """
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
        unloaded = sweeps.unloaded
        if x.shape[2:] != sweeps.samples.shape[2:]:
            unloaded = None  # its shape would no longer fit
        return replace(sweeps, samples=x, rate_hz=sweeps.rate_hz / self.rate, unloaded=unloaded)

    def __str__(self) -> str:
        left = (f"{k} {len(v) if k == 'taxels' else v}" for k, v in self._changed().items())
        return ", ".join(left) or "all"

    def and_then(self, other: Change) -> Change:
        """Both changes, which must leave out different things."""
        return Change(**self._changed() | other._changed())

    def _changed(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if v != getattr(WHOLE, k)}


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
    """`x` without its lowest `bits`. Float counts are treated as 8 bits over the set's range."""
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


def rank_taxels(sweeps: Dataset) -> list[int]:
    """All taxels, ordered by how well they separate the materials, the best first.

    Backward elimination (Marill and Green 1963) by Fisher's criterion trace(W^-1 B) (Fukunaga 1990,
    sec. 10.2). Its features are the log powers in BANDS bands of each taxel, on all its axes,
    scaled to variance 1. W is the scatter within materials plus RIDGE. Removing a taxel updates the
    inverse in closed form; nothing is trained.
    """
    format, powers = sweeps.format, log_powers(sweeps.samples)  # [N, M, BANDS]
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


def log_powers(samples: Array, taxels: Array | slice = slice(None)) -> Array:
    """Log power [N, M, BANDS] of sweeps [N, T, R, C(, A)] without their means; M = R * C * A, or
    the number of `taxels`."""
    n, frames = samples.shape[:2]
    bins = np.geomspace(1, max(frames // 2 + 1, 2), BANDS + 1)
    starts = np.minimum(bins.astype(int)[:-1], frames // 2)
    ends = np.maximum(bins.astype(int)[1:], starts + 1)
    parts = []
    for first in range(0, n, BATCH):
        x = (
            samples[first : first + BATCH]
            .reshape(-1, frames, samples[0, 0].size)[:, :, taxels]
            .astype(np.float64)
        )
        power = np.abs(np.fft.rfft(x - x.mean(axis=1, keepdims=True), axis=1)) ** 2 / frames
        parts.append(
            np.stack(
                [power[:, a:b].mean(axis=1) for a, b in zip(starts, ends, strict=True)], axis=2
            )
        )
    powers: Array = np.concatenate(parts)
    logs: Array = np.log(powers + 1e-3 * powers.mean() + np.finfo(float).tiny)
    return logs
