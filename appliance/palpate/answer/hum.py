"""The hum of the mains in a window: found, and subtracted before the network sees the counts.

Hum is a sine of 50 or 60 Hz that all taxels have in phase. A network may not respond to 50 Hz and
yet see other counts, because hum dithers small vibrations that are rounded. A texture can be
periodic as well. The hum of a window is therefore removed only if it stands out more than in any
training sweep. Pure functions of raw counts; windows of one format.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context
from palpate.core.types import SweepFormat, digitized, normal

Array = NDArray[Any]
MAINS_HZ = (50.0, 60.0)
ASIDE = (3, 4, 5)
"""Distances of the frequencies beside the hum to which it is compared, in periods per window. A
Hann window keeps the hum within two."""
QUIET = 4
"""Hum is searched in one of so many taxels: those that vibrate least beside its frequency, because
all taxels have the same hum."""
IN_PHASE = 0.9
"""Least length of the sum of the taxels' amplitudes, as a share of the sum of their lengths."""
OFF_HZ, STEPS = 0.3, 13
"""Largest error of the mains' frequency, and number of frequencies that are tried within it."""
TINY = 1e-30
"""Replaces a divisor of 0."""


class HumFilter:
    """Finds and removes hum in windows of one format. hz: the frequencies of mains that it finds;
    a window may be too short or a rate too low for them."""

    def __init__(self, format: SweepFormat) -> None:
        self._times = np.arange(format.window) / format.rate_hz
        self._type = format.numpy_type
        seconds = format.window / format.rate_hz
        reach = max(ASIDE) / seconds
        self.hz = tuple(hz for hz in MAINS_HZ if 2 * reach < hz and hz + reach < format.rate_hz / 2)
        self._window = np.hanning(format.window)
        self._window /= self._window.sum() / 2  # so that a sine gives its amplitude
        aside = np.array([0, *ASIDE, *(-step for step in ASIDE)]) / seconds
        waves = np.array([self._wave(hz + aside) for hz in self.hz])  # [mains, F, T]
        # a product of real numbers takes a quarter of the time
        parts = np.stack([waves.real, waves.imag]).reshape(-1, format.window)
        self._parts = np.ascontiguousarray(parts, np.float32)

    def _wave(self, hz: Array) -> NDArray[np.complex64]:
        """Multiplies counts [T, V] to give complex amplitudes [F, V] at `hz` [F]."""
        turns = np.exp(-2j * np.pi * hz[:, None] * self._times) * self._window
        turns -= turns.mean(axis=1, keepdims=True)  # the constant part of the counts
        wave: NDArray[np.complex64] = turns.astype(np.complex64)
        return wave

    def ratio(self, taxels: Array) -> float:
        """How much the hum of one window stands out: its amplitude by those beside it. 0 without
        hum in phase. taxels: raw counts [T, R, C] or [T, R, C, A]; only the normal axis is
        used."""
        return max((ratio for ratio, _ in self._found(taxels)), default=0.0)

    def __call__(self, taxels: Array, least: float) -> tuple[Array, float]:
        """One window without hum, and the amplitude of this hum in counts; the window as it is and
        0 if no hum stands out by `least`."""
        found = self._found(taxels, least)
        if not found:
            return taxels, 0.0
        series = taxels.reshape(len(taxels), -1).astype(np.float64)
        series -= series.mean(axis=0)
        hz = self._refined(series, max(found)[1])
        turns = 2 * np.pi * hz * self._times
        waves = np.linalg.qr(np.stack([np.sin(turns), np.cos(turns)], axis=1))[0]
        hum = waves @ (waves.T @ series)
        clean = digitized(taxels - hum.reshape(taxels.shape), self._type)
        of_normal = normal(hum.reshape(taxels.shape), 1)
        return clean, float(np.sqrt(2 * (of_normal**2).mean()))

    def _found(self, taxels: Array, least: float = 0.0) -> list[tuple[float, float]]:
        """Ratio, at least `least`, and frequency of the hum at each frequency of mains."""
        if not self.hz or len(taxels) != len(self._times):
            return []
        counts = normal(taxels, 1).reshape(len(taxels), -1).astype(np.float32)
        counts -= counts[0]
        found = []
        with np.errstate(all="ignore"):  # float32 counts may be infinite
            parts = (self._parts @ counts).reshape(2, len(self.hz), 1 + 2 * len(ASIDE), -1)
            power = (parts * parts).sum(axis=0)
            beside = power[:, 1:].mean(axis=1)
            # the ratio of two sums is at most the largest ratio of their parts
            possible = (power[:, 0] >= least**2 * beside).any(axis=1)
            for i in np.flatnonzero(possible):
                near = np.sqrt(beside[i])
                quiet = np.argsort(near)[: max(1, len(near) // QUIET)]
                at = parts[0, i, 0, quiet] + 1j * parts[1, i, 0, quiet]
                size = np.abs(at).sum()
                in_phase = bool(np.abs(at.sum()) >= IN_PHASE * size > 0)
                ratio = float(size / max(near[quiet].sum(), TINY)) if in_phase else 0.0
                if np.isfinite(ratio) and ratio >= least:
                    found.append((ratio, self.hz[i]))
        return found

    def _refined(self, series: Array, hz: float) -> float:
        """The frequency near `hz` at which all taxels together have most power."""
        tried = hz + np.linspace(-OFF_HZ, OFF_HZ, STEPS)
        power = np.abs(self._wave(tried) @ series.sum(axis=1))
        return float(tried[power.argmax()])


class RemoveHum:
    """Removes hum that stands out by `least` from windows of one format."""

    def __init__(self, format: SweepFormat, least: float) -> None:
        self._filter, self._least = HumFilter(format), least

    def apply(self, context: Context) -> None:
        """Remove the hum."""
        context.taxels, context.hum = self._filter(context.taxels, self._least)
