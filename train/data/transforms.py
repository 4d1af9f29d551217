"""The room of less: the same sweeps with fewer frames, taxels or bits. In: a Dataset, a Change. Out: a Dataset.

Each change is something that an integrator can set on a sensor, and done here as it would be done there; only a shorter
window is the box's own matter, which takes the middle of each sweep anyhow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from train.data.sets import Dataset

Array = NDArray[Any]
BANDS = 6
"""Of a taxel's spectrum, equally wide on a logarithmic scale: what its share in telling materials is judged by."""
RIDGE = 0.1
"""Variance of each that counts as noise. More would make a second copy of a taxel worth something; less trusts few sweeps."""
AT_ONCE = 32
"""Sweeps whose spectra are in memory together."""


@dataclass(frozen=True)
class Change:
    """What is left out; as it stands, nothing.

    window: share of the frames that is kept, the middle. rate: so many frames are averaged into one by the readout
    board, which is all the filter that there is. taxels: those that are kept, by number row by row; () for all.
    bits: so many of the lowest are cut off.
    """

    window: float = 1.0
    rate: int = 1
    taxels: tuple[int, ...] = ()
    bits: int = 0

    def of(self, sweeps: Dataset) -> Dataset:
        """The changed sweeps, of the same digit type. A grid stays one where whole rows and columns are left, else the
        taxels stand in one column. Raises FormatError where no frame is left."""
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
        return sweeps if x is sweeps.samples else replace(sweeps, samples=x, rate_hz=sweeps.rate_hz / self.rate)

    def __str__(self) -> str:
        left = [f"{k} {len(v) if k == 'taxels' else v}" for k, v in vars(self).items() if v != getattr(WHOLE, k)]
        return ", ".join(left) or "all"

    def and_then(self, other: Change) -> Change:
        """Both; each leaves out something else."""
        told = {k: v for one in (self, other) for k, v in vars(one).items() if v != getattr(WHOLE, k)}
        return Change(**told)


WHOLE = Change()


def _kept(x: Array, taxels: tuple[int, ...]) -> Array:
    n, frames, _, cols = x.shape
    row, col = np.divmod(np.array(sorted(taxels)), cols)
    rows, columns = np.unique(row), np.unique(col)
    form = (len(rows), len(columns)) if len(rows) * len(columns) == len(taxels) else (len(taxels), 1)
    return np.ascontiguousarray(x.reshape(n, frames, -1)[:, :, sorted(taxels)]).reshape(n, frames, *form)


def _coarse(x: Array, bits: int) -> Array:
    """Whole digits lose their lowest bits; floating ones count as eight bits of the range of the set."""
    if x.dtype.kind != "f":
        return x >> bits << bits
    low, high = float(x.min()), float(x.max())
    step = max((high - low) / 2 ** (8 - bits), np.finfo(np.float32).tiny)
    return (low + np.floor((x - low) / step) * step).astype(x.dtype)


def _averaged(x: Array, rate: int) -> Array:
    n, frames = x.shape[0], x.shape[1] // rate
    mean = x[:, : frames * rate].reshape(n, frames, rate, *x.shape[2:]).mean(axis=2, dtype=np.float64)
    return (mean if x.dtype.kind == "f" else np.rint(mean)).astype(x.dtype)


def order(sweeps: Dataset) -> list[int]:
    """Taxels by what they tell of the material, the most telling first: the last one goes first when some must go.

    Backward elimination (Marill and Green 1963) by Fisher's criterion trace(W^-1 B) (Fukunaga 1990, sec. 10.2) of the
    log powers in BANDS bands of each taxel, of variance 1 and with RIDGE in W, the scatter within materials. Taking one
    taxel out of the inverse is a step in closed form, so that nothing is trained.
    """
    seen = _powers(sweeps.samples)  # [N, M, BANDS]
    n, taxels, bands = seen.shape
    x = seen.reshape(n, -1)
    x = (x - x.mean(0)) / np.maximum(x.std(0), 1e-9)
    within, between = x.copy(), np.zeros((x.shape[1],) * 2)
    for label in np.unique(sweeps.labels):
        those = sweeps.labels == label
        mean = x[those].mean(0)
        within[those] -= mean
        between += those.mean() * np.outer(mean, mean)
    inverse = np.linalg.inv(within.T @ within / n + RIDGE * np.eye(within.shape[1]))
    blocks = {taxel: slice(taxel * bands, (taxel + 1) * bands) for taxel in range(taxels)}
    gone: list[int] = []
    while blocks:
        loss = inverse @ between @ inverse
        costs = {t: float(np.trace(np.linalg.solve(inverse[b, b], loss[b, b]))) for t, b in blocks.items()}
        least = min(costs, key=lambda t: costs[t])
        b = blocks.pop(least)
        inverse = inverse - inverse[:, b] @ np.linalg.solve(inverse[b, b], inverse[b, :])
        gone.append(least)
    return gone[::-1]


def _powers(samples: Array) -> Array:
    """Log power [N, M, BANDS] of sweeps [N, T, R, C], each taxel's mean taken away."""
    n, frames = samples.shape[:2]
    bins = np.geomspace(1, max(frames // 2 + 1, 2), BANDS + 1)
    starts = np.minimum(bins.astype(int)[:-1], frames // 2)
    ends = np.maximum(bins.astype(int)[1:], starts + 1)
    seen = []
    for first in range(0, n, AT_ONCE):
        x = samples[first : first + AT_ONCE].reshape(-1, frames, samples[0, 0].size).astype(np.float64)
        power = np.abs(np.fft.rfft(x - x.mean(axis=1, keepdims=True), axis=1)) ** 2 / frames
        seen.append(np.stack([power[:, a:b].mean(axis=1) for a, b in zip(starts, ends, strict=True)], axis=2))
    every = np.concatenate(seen)
    return np.log(every + 1e-3 * every.mean() + np.finfo(float).tiny)
