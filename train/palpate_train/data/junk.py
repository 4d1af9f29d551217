"""Junk made of recorded sweeps: windows in which no single known material was slid over.

Each kind is an entry of JUNK. It is made of the raw counts of slides, so it has their loads and
their noise. An answer with a label is wrong, whatever the label is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.answer import disturbance
from palpate.core.types import digitized
from palpate_train.data.corruptions import HUM_HZ
from palpate_train.data.sets import Dataset

Array = NDArray[Any]
TAPS_HZ = 5.0
FOR_LIMITS = 24
"""Windows of each kind by which limits are found."""


@dataclass(frozen=True, eq=False)
class Slides:
    """Slides that junk is made of. x: float32 [n, T, R, C] or [n, T, R, C, A], raw counts. others:
    the same number of slides over other materials. tare: counts of the unloaded skin in the shape
    of a frame, 0 if unknown."""

    x: Array
    others: Array
    tare: Array
    rate_hz: float
    rng: Generator

    @classmethod
    def of(cls, sweeps: Dataset, each: int, tare: Array, rng: Generator) -> Slides:
        """From at most `each` sweeps, of at least two materials."""
        some = rng.permutation(len(sweeps))[:each]
        labels = sweeps.labels
        others = [rng.choice(np.flatnonzero(labels != labels[i])) for i in some]
        x = sweeps.samples.astype(np.float32, copy=False)
        return cls(x[some], x[others], tare, sweeps.rate_hz, rng)

    @property
    def load(self) -> Array:
        """Mean counts of each window, [n, 1, ...]."""
        load: Array = self.x.mean(axis=1, keepdims=True, dtype=np.float64)
        return load.astype(np.float32)

    @property
    def rest(self) -> Array:
        """A finger that rests: the load, with the noise that each window has."""
        power = np.array([disturbance.noise(one) for one in self.x])
        noise: Array = np.exp(power / 2).reshape(-1, *(1,) * (self.x.ndim - 1)) * self.white()
        return self.load + noise

    def white(self) -> Array:
        """White noise of deviation 1 in the shape of the windows."""
        return self.rng.standard_normal(self.x.shape, np.float32)

    def wave(self, hz: float) -> Array:
        """A sine of amplitude 1 that all taxels have, [n, T, ...]."""
        turns = hz * np.arange(self.x.shape[1]) / self.rate_hz + self.rng.random((len(self.x), 1))
        sine: Array = np.sin(2 * np.pi * turns)
        return sine.reshape(*turns.shape, *(1,) * (self.x.ndim - 2))

    def from_half(self, later: Array) -> Array:
        """The windows with `later` in their second halves."""
        made, half = self.x.copy(), self.x.shape[1] // 2
        made[:, half:] = np.broadcast_to(later, made.shape)[:, half:]
        return made

    @property
    def deviation(self) -> Array:
        """Of each taxel in each window, [n, 1, ...]."""
        deviation: Array = self.x.std(axis=1, keepdims=True, dtype=np.float64)
        return deviation.astype(np.float32)


def _confused(of: Slides) -> Array:
    """Slides whose taxels are confused."""
    rows, cols = of.x.shape[2:4]
    order = of.rng.permutation(rows * cols)
    flat = of.x.reshape(*of.x.shape[:2], rows * cols, *of.x.shape[4:])
    return flat[:, :, order].reshape(of.x.shape)


def _phases(of: Slides) -> Array:
    """Slides whose taxels keep their spectra and get random phases."""
    bins = np.fft.rfft(of.x, axis=1)
    bins[:, 1:] *= np.exp(2j * np.pi * of.rng.random(bins[:, 1:].shape))
    made: Array = np.fft.irfft(bins, of.x.shape[1], axis=1)
    return made


JUNK: dict[str, Callable[[Slides], Array]] = {
    "finger rests": lambda of: of.rest,
    "rests, 50 Hz hum": lambda of: of.rest + of.deviation.mean() * of.wave(HUM_HZ),
    "stops halfway": lambda of: of.from_half(of.rest),
    "lifted halfway": lambda of: of.from_half(of.tare + of.rest - of.load),
    "taps": lambda of: of.tare + (of.rest - of.tare) * of.wave(TAPS_HZ).clip(0),
    "load and noise": lambda of: of.load + of.deviation * of.white(),
    "two materials joined": lambda of: of.from_half(of.others),
    "two materials mixed": lambda of: (of.x + of.others) / 2,
    "taxels confused": _confused,
    "random phases": _phases,
}
"""How to make windows of each kind, before they are rounded."""

SLIDES_FIRST = ("stops halfway", "lifted halfway", "two materials joined")
"""Kinds that begin as slides over one material: until then its label is right."""


def windows(kind: str, sweeps: Dataset, each: int, tare: Array, seed: int) -> Array:
    """Raw counts of at most `each` windows of a kind, in the type of `sweeps`."""
    rng = np.random.default_rng([seed, *kind.encode()])
    return digitized(JUNK[kind](Slides.of(sweeps, each, tare, rng)), sweeps.samples.dtype)
