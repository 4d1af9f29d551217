"""The hum of the mains in a window: found, and subtracted before the network sees the counts.

Hum is a comb: 50 or 60 Hz and its multiples, as rectifiers and motors make them, which all taxels
have in phase. A network may not respond to 50 Hz and yet see other counts, because hum dithers
small vibrations that are rounded. A texture can be periodic as well. Hum is therefore removed only
if one of its lines stands out more than in any training sweep. An unfinished window shows hum as
soon as it is long enough for a line. Functions of raw counts; windows of one format.

Without hum: 728 instead of 747 of 816 altered slides right, 177 instead of 177 of 192 displaced
ones, 52 instead of 52 of 480 junk windows named; 60 us less of 646 (`python -m palpate_studies
rules`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context
from palpate.answer.window import TINY, Counts, Waves, Window
from palpate.core.types import SweepFormat, digitized, normal

Array = NDArray[Any]
MAINS_HZ = (50.0, 60.0)
ASIDE = (3, 4, 5)
"""Distances from a line to the frequencies to which it is compared, in periods per window. A Hann
window keeps a line within two."""
ONE_IN = 4
"""A line is searched in one of so many taxels: the taxels that vibrate least near its frequency,
because all taxels have the same hum."""
IN_PHASE = 0.9
"""Least length of the sum of the taxels' amplitudes, as a share of the sum of their lengths."""
SEARCHED = 2
"""Multiples in which hum is searched: each comb of the mains has one of them, as its strongest
line or as one of several."""
MULTIPLES = 12
"""Multiples that are removed; those above are small, and their tables would be large."""
FAINT = 2.0
"""Least ratio of the other lines of a comb that was found."""
OFF_HZ, STEPS = 0.3, 13
"""Largest error of the mains' frequency, and number of frequencies that are tried within it."""


@dataclass(frozen=True, slots=True, eq=False)
class HumLines:
    """The lines that a window of some length can show.

    hz, mains, order: [L], frequency, mains frequency, and the multiple. waves: at each line and
    at frequencies around it, F = L * (1 + 2 * len(ASIDE)). powers: float32 [2 * L, 2 * F], gives
    the power at each line, and then its mean around each line, of squares of `waves`.
    """

    hz: Array
    mains: Array
    order: Array
    waves: Waves
    powers: NDArray[np.float32]

    @classmethod
    def of(cls, frames: int, rate_hz: float, multiples: int) -> HumLines:
        """Of windows with this number of frames, up to some multiple of the mains."""
        seconds = frames / rate_hz
        reach = max(ASIDE) / seconds
        least, most = max(2 * reach, TINY), rate_hz / 2 - reach
        lines = [
            (mains * k, mains, k)
            for mains in MAINS_HZ
            for k in range(1, 1 + int(min(multiples, max(0.0, most) // mains)))
            if least < mains * k < most
        ]
        hz, mains, order = np.array(lines).reshape(-1, 3).T
        aside = np.array([0, *ASIDE, *(-step for step in ASIDE)]) / seconds
        every = (hz[:, None] + aside).ravel()
        at, beside = aside == 0, (aside != 0) / (len(aside) - 1)
        powers = [np.kron(np.eye(len(hz)), one.repeat(2)) for one in (at, beside)]
        waves = Waves(every, frames, rate_hz)
        return cls(hz, mains, order, waves, np.concatenate(powers).astype(np.float32))


class HumFilter:
    """Finds and removes hum in windows of one format, unfinished ones included. hz: the frequencies
    of mains that a whole window shows; it may be too short or its rate too low for them."""

    def __init__(self, format: SweepFormat, least: float = math.inf) -> None:
        self._rate_hz, self._type, self._least = format.rate_hz, format.numpy_type, least
        self._frames = format.window
        self._lines: dict[tuple[int, bool], HumLines] = {}  # by frames, and whether of a whole comb
        self.hz = tuple(sorted(set(self._of(format.window).mains.tolist())))

    def ratio(self, taxels: Counts) -> float:
        """How much the hum of one window stands out: the amplitude of a line, divided by the
        amplitudes around it. 0 without a line in phase. taxels: raw counts [T, R, C] or
        [T, R, C, A]; only the normal axis is used."""
        window = Window.of(taxels)
        return float(self._ratios(self._of(len(window)), window).max(initial=0.0))

    def __call__(self, taxels: Counts, least: float) -> tuple[Array, float]:
        """One window without hum, and the amplitude of this hum in counts; the window as it is and
        0 if no line stands out by `least`."""
        window = Window.of(taxels)
        taxels, searched = window.taxels, self._of(len(window))
        found = self._ratios(searched, window, least)
        if not found.any() or found.max() < least:
            return taxels, 0.0
        series = taxels.reshape(len(taxels), -1).astype(np.float64)
        series -= series.mean(axis=0)
        common = series.sum(axis=1, keepdims=True).astype(np.float32)
        every = self._comb(searched, int(found.argmax()), window, common)
        turns = 2 * np.pi / self._rate_hz * np.outer(np.arange(len(taxels)), every)
        waves = np.linalg.qr(np.concatenate([np.sin(turns), np.cos(turns)], axis=1))[0]
        hum = (waves @ (waves.T @ series)).reshape(taxels.shape)
        clean = digitized(taxels - hum, self._type)
        return clean, float(np.sqrt(2 * (normal(hum, 1) ** 2).mean()))

    def apply(self, context: Context) -> None:
        """Remove the hum that stands out by the filter's `least`."""
        context.taxels, context.hum = self(context.window, self._least)

    def _of(self, frames: int, *, comb: bool = False) -> HumLines:
        """The lines of windows of this length: the searched lines, or all."""
        lines = self._lines.get((frames, comb))
        if lines is None:
            lines = HumLines.of(frames, self._rate_hz, MULTIPLES if comb else SEARCHED)
            if frames == self._frames or not comb:  # lines of unfinished hummed windows are large
                self._lines[frames, comb] = lines
        return lines

    def _comb(
        self, searched: HumLines, strongest: int, window: Window, common: Array
    ) -> list[float]:
        """The frequencies of the lines that the window has of a comb. strongest: number of the line
        that was found. common: float32 [T, 1], sum of all taxels."""
        mains, order = searched.mains[strongest], searched.order[strongest]
        hz = self._refined(common, searched.hz[strongest], OFF_HZ * order)
        lines = self._of(len(window), comb=True)
        present = (lines.mains == mains) & (self._ratios(lines, window) >= FAINT)
        others = [k for k in lines.order[present] if k != order]
        off_hz = OFF_HZ / STEPS
        return [hz, *(self._refined(common, hz / order * k, off_hz * k) for k in others)]

    def _ratios(self, lines: HumLines, window: Window, least: float = 0.0) -> Array:
        """Ratio of each line [L], 0 for a line that is not in phase or surely below `least`."""
        found = np.zeros(len(lines.hz))
        if not len(found):
            return found
        parts = lines.waves(window.counts)
        squares = np.square(parts).reshape(lines.powers.shape[1], -1)
        power, beside = (lines.powers @ squares).reshape(2, len(found), -1)
        # the ratio of two sums is at most the largest ratio of their parts
        possible = power >= least**2 * beside
        if not np.logical_or.reduce(possible, axis=None):
            return found
        parts = parts.reshape(len(found), -1, *parts.shape[1:])[:, 0]
        for i in np.flatnonzero(possible.any(axis=1)):
            near = np.sqrt(beside[i])
            quiet = np.argsort(near)[: max(1, len(near) // ONE_IN)]
            at = parts[i, 0, quiet] + 1j * parts[i, 1, quiet]
            size = np.abs(at).sum()
            ratio = size / max(near[quiet].sum(), TINY)
            if np.abs(at.sum()) >= IN_PHASE * size > 0 and np.isfinite(ratio):
                found[i] = ratio
        return found

    def _refined(self, common: Array, hz: float, off_hz: float) -> float:
        """The frequency within `off_hz` of `hz` at which all taxels together, float32 [T, 1], have
        most power: the highest of some frequencies, and the vertex of a parabola around it."""
        tried = hz + np.linspace(-off_hz, off_hz, STEPS)
        real, imaginary = Waves(tried, len(common), self._rate_hz)(common)[:, :, 0].T
        found = np.abs(real + 1j * imaginary)
        power = np.log(found + TINY, dtype=np.float64)
        top = int(power.argmax())
        if top in (0, STEPS - 1):
            return float(tried[top])
        before, at, after = power[top - 1 : top + 2]
        bend = before - 2 * at + after
        shift = (before - after) / (2 * bend) if bend < 0 else 0.0
        return float(tried[top] + shift * (tried[1] - tried[0]))
