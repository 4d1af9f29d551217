"""Whether a finger slides, and how: by the pattern that passes one taxel after another, and by the
vibration of the taxels in tenths of a window, against the load.

The phase between two taxels at a distance d along the slide is 2 pi f d / v at a frequency f and a
speed v. Cross-spectra of pairs, divided by the square root of their magnitude, are summed at these
phases for a grid of speeds, and the highest sum shows the speed (Knapp and Carter 1976, with an
exponent of 0.5). docs/decisions/0007 has the accuracy. A finger that rests gives a load and hardly
any vibration. How little a slide vibrates depends on the material, so a bundle holds the least
vibration of each in training; the gain of the skin does not change it.

Without slide: 758 instead of 747 of 816 altered slides right, 181 instead of 177 of 192 displaced
ones, 116 instead of 52 of 480 junk windows named; 4 us less of 646 (`python -m palpate_studies
rules`).

Without vibration: 748 instead of 747 of 816 altered slides right, 179 instead of 177 of 192
displaced ones, 63 instead of 52 of 480 junk windows named; 9 us less of 646 (`python -m
palpate_studies rules`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context, Refusal, Slide, Stage, StageInputs
from palpate.answer.window import TINY, Counts, Waves, Window, ones
from palpate.core.errors import BundleError
from palpate.core.schema import LEAST, Positive, Within, check
from palpate.core.sentences import DIRECTIONS
from palpate.core.status import Reason, Remark
from palpate.core.types import Status, SweepFormat, normal

Array = NDArray[Any]

BAND_HZ = 40.0
"""Highest frequency that is used. Friction vibrations are mostly above it; they have no lag."""
LEAST_CYCLES = 2
"""Fewest cycles of a frequency in a window. Slower changes come from the force."""
WAVES = 2.0
"""Waves per taxel pitch of the finest pattern that is used: a taxel blurs finer patterns."""
SEPARATIONS = 3
"""Longest distance of a pair, in taxels."""
BLOCK = 6
"""Most rows and columns that are used, so that the time has a limit."""
LONGEST_S = 4.0
"""Longest part of a window that is used, likewise."""
LEAST_LAGS = SEPARATIONS + 1
"""The slowest speed passes this many taxels in a window: the longest pair, and what it shares."""
MOST_LAGS = 100.0
"""The fastest speed passes this many taxels a second. BAND_HZ then has waves of 2.5 pitches."""
STEP = 0.04
"""Natural logarithm of the ratio of two neighbouring speeds of the grid."""
LEAST_TAXELS = 3
"""Fewest taxels whose counts change. The signal that all have in common is removed, and of two
taxels nothing is left that has a direction."""
CHANCE = 5.0
"""Height that few windows of noise, of rests and of taxels from different slides exceed
(docs/decisions/0005)."""
LEAST_HEIGHT = 7.0
"""Least height of a peak, in standard deviations of a sum with random phases."""
RATIO = 1.5
"""Least ratio of a peak to the next separate peak of its axis, and to the sum without a lag. The
other axis is left out, because a pattern of straight ridges passes along both."""
NO_PATTERN = "no pattern passes from taxel to taxel"
NO_PITCH = "the distance between taxels is unknown; export with --pitch-mm"
APART = round(math.log(2) / 2 / STEP)
"""Peaks further apart than this many steps of the grid, half an octave, are separate."""
MARGIN = 1.2
"""A speed within this factor of the trained range counts as trained."""
PARTS = 10
"""Parts of a window. Early answers are given after whole parts."""


@dataclass(frozen=True, slots=True)
class SpeedRange:
    """Range of the measured speeds in training. Raises BundleError for a number out of range."""

    least_mm_s: Annotated[float, Within(LEAST, 1e6)]
    most_mm_s: Annotated[float, Within(LEAST, 1e6)]

    def __post_init__(self) -> None:
        check(self, "speeds")
        if self.least_mm_s > self.most_mm_s:
            raise BundleError(f"speeds {self} must be the lower first; export the bundle again")

    def outside(self, slide: Slide) -> str:
        """A message with the speed of `slide` if it is outside of the range by more than MARGIN;
        "" otherwise, and without a speed."""
        speed = slide.speed_mm_s
        if speed is None or self.least_mm_s / MARGIN <= speed <= self.most_mm_s * MARGIN:
            return ""
        return f"slid at {speed:.0f} mm/s, trained {self}"

    def __str__(self) -> str:
        return f"{self.least_mm_s:.0f} to {self.most_mm_s:.0f}"


class SlideMeter:
    """Measures windows of one format on a skin with a known pitch. The tables are computed once.

    pitch_mm: distance between neighbouring taxels; None if unknown. why: the reason why no window
    can be measured, None if windows can be measured. slowest_mm_s, fastest_mm_s: range of
    speeds; 0 where there is such a reason.
    """

    def __init__(self, format: SweepFormat, pitch_mm: float | None) -> None:
        self.slowest_mm_s = self.fastest_mm_s = 0.0
        self._shape = min(format.rows, BLOCK), min(format.cols, BLOCK)
        seconds = min(format.window / format.rate_hz, LONGEST_S)
        slowest, fastest = LEAST_LAGS / seconds, min(MOST_LAGS, format.rate_hz)
        self.why: str | None = None
        if pitch_mm is None:
            self.why = NO_PITCH
        elif format.rows * format.cols < LEAST_TAXELS:
            self.why = f"fewer than {LEAST_TAXELS} taxels"
        elif fastest < 2 * slowest:
            self.why = (
                f"a window of {seconds:.3g} s at {format.rate_hz:g} Hz is too short, or a frame "
                "longer than the time from taxel to taxel"
            )
        if self.why is not None or pitch_mm is None:
            return
        self._pitch_mm = pitch_mm
        self.slowest_mm_s, self.fastest_mm_s = slowest * pitch_mm, fastest * pitch_mm
        self._each = max(1, int(format.rate_hz / (4 * BAND_HZ)))
        self._frames = int(seconds * format.rate_hz) // self._each
        hz = np.arange(self._frames // 2 + 1) * (format.rate_hz / self._each / self._frames)
        hz = hz[(hz >= LEAST_CYCLES / seconds - 1e-9) & (hz <= BAND_HZ)]
        self._waves = Waves(hz, self._frames, format.rate_hz / self._each, trend=1)
        self._pairs, self._of_pair = _pairs(*self._shape)
        steps = math.floor(math.log(fastest / slowest) / STEP)
        self._taxels_s = slowest * np.exp(STEP * np.arange(steps + 1))
        self._tables(hz, seconds)

    def _tables(self, hz: Array, seconds: float) -> None:
        """Cosine, sine and use of each separation and frequency at each speed of the grid, and
        without a lag at last: [3, 1, V + 1, D * F], whose rows are quick to multiply by one."""
        speeds = np.append(self._taxels_s, np.inf)[:, None, None]
        lag_s = np.arange(1, SEPARATIONS + 1)[:, None] / speeds
        phase = 2 * np.pi * hz * lag_s
        use = (hz <= WAVES * speeds) & (lag_s <= seconds / 2)
        tables = np.stack([np.cos(phase) * use, np.sin(phase) * use, use / 2])
        self._grid = tables.reshape(3, 1, len(speeds), -1).astype(np.float32)

    def __call__(self, taxels: Counts) -> Slide:
        """The slide in one window of raw counts [T, R, C] or [T, R, C, A] of the format; only the
        normal axis is used."""
        if self.why is not None:
            return Slide(why=self.why)
        spectra = self._spectra(Window.of(taxels))
        if spectra is None:
            return Slide(why=f"the counts of fewer than {LEAST_TAXELS} taxels change")
        return self._slide(self._heights(spectra.view(np.complex64)))

    def _spectra(self, window: Window) -> Array | None:
        """Spectra [M, 2 * F] of the M taxels of the block that moves most, real and imaginary parts
        side by side, without the part that they have in common; None if too few of them change.
        Silent and broken taxels are 0, and none is louder than the median."""
        counts = window.counts[: self._frames * self._each]
        if counts.shape[1] > BLOCK * BLOCK:
            counts = _busiest(counts.reshape(-1, *window.taxels.shape[1:3]), self._shape)
        # four times as fast as sum(axis=1)
        summed = np.einsum("tev->tv", counts.reshape(self._frames, self._each, -1))
        # real and imaginary parts in one row: qemu 7.2 cannot run np.maximum on every other number
        parts = self._waves(summed).reshape(-1, summed.shape[1]).T.copy()
        power = np.vecdot(parts, parts)
        ordered = np.sort(power).tolist()  # NaN is last
        if not 0 < ordered[0] <= ordered[-1] < math.inf:
            silent = ~np.isfinite(power) | (power == 0)
            parts[silent] = power[silent] = 0
            ordered = sorted(power[~silent].tolist())
            if len(ordered) < LEAST_TAXELS:
                return None
        parts *= 1 / np.sqrt(np.maximum(power, np.float32(ordered[len(ordered) // 2])))[:, None]
        common = np.add.reduce(parts)
        shares = parts.dot(common) / max(float(common.dot(common)), TINY)
        parts -= shares[:, None] * common
        return parts

    def _heights(self, spectra: Array) -> Array:
        """Heights [2, 2, V + 1] of the sums for slides towards higher and lower numbers, along rows
        and columns, at each speed and without a lag."""
        size = np.abs(spectra)
        # the root of a product is the product of roots, and there are fewer roots than products
        rooted = spectra * (1 / np.sqrt(np.maximum(size, TINY)))
        first, second = rooted.take(self._pairs, 0)
        sums = self._of_pair.dot((first * second.conj()).view(np.float32))
        first, second = size.take(self._pairs, 0)
        spread = self._of_pair.dot(first * second)
        given = np.array([sums[:, ::2], sums[:, 1::2], spread]).reshape(3, 2, 1, -1)
        straight, across, variance = np.vecdot(given, self._grid)
        heights = np.array([straight - across, straight + across])
        heights /= np.sqrt(np.maximum(variance, TINY))
        return heights

    def _slide(self, heights: Array) -> Slide:
        """The slide at the highest peak of an axis on which the pattern has a lag, or the reason
        why it is not one."""
        speeds = len(self._taxels_s)
        tops = np.maximum.reduce(heights[..., :speeds], axis=(0, 2)).tolist()
        stills = heights[0, :, speeds].tolist()
        lagging = [
            top if top >= RATIO * still else 0.0 for top, still in zip(tops, stills, strict=True)
        ]
        height = max(0.0, *lagging)
        if height < LEAST_HEIGHT:
            return Slide(height=height, why=NO_PATTERN)
        axis = lagging.index(height)
        heights = heights[:, axis, :speeds]
        sign, at = divmod(int(heights.argmax()), speeds)
        if at in (0, speeds - 1):
            limit = self.slowest_mm_s if at == 0 else self.fastest_mm_s
            why = f"{'slower' if at == 0 else 'faster'} than {limit:.3g} mm/s"
            return Slide(height=height, why=why)
        before, top, after = heights[sign, at - 1 : at + 2].tolist()
        heights[sign, max(0, at - APART) : at + APART + 1] = 0
        if height < RATIO * np.maximum.reduce(heights, axis=None):
            return Slide(height=height, why="the pattern fits several speeds")
        bend = before - 2 * top + after
        shift = (before - after) / (2 * bend) if bend else 0.0  # the vertex of a parabola
        taxels_s = float(self._taxels_s[at]) * math.exp(STEP * shift)
        speed = float(f"{taxels_s * self._pitch_mm:.3g}")
        return Slide(speed, DIRECTIONS[2 * axis + sign], height, taxels_s=taxels_s)


def _pairs(rows: int, cols: int) -> tuple[Array, Array]:
    """Pairs of taxels along rows and columns: the numbers of both taxels, int [2, P], and the
    axis and separation of each pair as float32 [2 * SEPARATIONS, P] of 0 and 1."""
    number = np.arange(rows * cols).reshape(rows, cols)
    first, second, kinds = [], [], []
    for kind in range(2 * SEPARATIONS):
        axis, far = divmod(kind, SEPARATIONS)
        grid = number if axis == 0 else number.T
        lower, higher = grid[: -far - 1].ravel(), grid[far + 1 :].ravel()
        first.append(lower)
        second.append(higher)
        kinds += [kind] * len(lower)
    of_pair = (np.arange(2 * SEPARATIONS)[:, None] == kinds).astype(np.float32)
    return np.stack([np.concatenate(first), np.concatenate(second)]), of_pair


def _busiest(taxels: Array, shape: tuple[int, int]) -> Array:
    """The block of `shape` of frames [T, R, C] whose counts change most, judged by 64 frames. A
    loud taxel counts like the median of the changing taxels."""
    some = taxels[:: max(1, len(taxels) // 64)].astype(np.float64)
    moving = np.nan_to_num(some.std(axis=0))
    if moving.any():
        moving = np.minimum(moving, np.median(moving[moving > 0]))
    total = np.pad(moving, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    rows, cols = shape
    sums = total[rows:, cols:] - total[:-rows, cols:] - total[rows:, :-cols] + total[:-rows, :-cols]
    r, c = np.unravel_index(sums.argmax(), sums.shape)
    return taxels[:, r : r + rows, c : c + cols]


class MeasureSlide:
    """Measures the slide in whole windows. pitch_mm: None if it is unknown or no speed is wanted;
    then only the height of the pattern, and taxels a second, are measured. bridged: also in sweeps
    with bridged taxels, where ShowsPattern does not look. able: whether slides on this skin can be
    measured at all."""

    def __init__(
        self, format: SweepFormat, pitch_mm: float | None, *, bridged: bool = True
    ) -> None:
        self._format, self._pitch_mm, self._bridged = format, pitch_mm, bridged
        self._meters = dict[int, SlideMeter]()  # by frames
        self.able = self._of(format.window).why is None

    def _of(self, frames: int) -> SlideMeter:
        if frames not in self._meters:
            format = replace(self._format, window=frames)
            self._meters[frames] = SlideMeter(format, self._pitch_mm or 1.0)
        return self._meters[frames]

    def height(self, context: Context) -> float:
        """Height of the pattern in a sweep, which may be unfinished."""
        if context.whole:
            return context.slide.height
        return self._of(len(context.taxels))(context.window).height

    def apply(self, context: Context) -> None:
        """Measure the slide."""
        if not context.whole or (context.degraded and not self._bridged):
            return
        slide = self._of(len(context.taxels))(context.window)
        if not self._pitch_mm:
            slide = Slide(height=slide.height, why=NO_PITCH, taxels_s=slide.taxels_s)
        context.slide = slide


class ShowsPattern:
    """Refuses a sweep without the pattern that passed in all training sweeps. least: its least
    height. An unfinished sweep has to reach it, too: of slides whose taxels are confused 1 of 24
    gets an early answer, without this rule 20, and known sweeps need 0.38 instead of 0.30 of the
    window."""

    def __init__(self, least: float, height: Callable[[Context], float]) -> None:
        self._least, self._height = least, height

    def apply(self, context: Context) -> Refusal | None:
        """Refuse a sweep without a pattern. Bridged taxels move with their neighbours, which hides
        the pattern."""
        if context.degraded is None and self._height(context) < self._least:
            return Refusal(Status.NO_SLIDE, Remark(Reason.NO_PATTERN))
        return None


@dataclass(frozen=True, slots=True)
class SlideLimits:
    """least: [K], for each trained label the least `vibration` of a part in which the finger
    slides; empty if that is unknown. pattern: least height of the pattern that passes from taxel to
    taxel in a slide, as signal.slide measures it; None if slides need not show one. whole: whether
    whole windows have to vibrate so, too; if not, `least` is of few sweeps, and what lies below is
    only answered later. Raises BundleError for a number out of range."""

    least: tuple[float, ...]
    pattern: Positive | None = None
    whole: bool = True

    def __post_init__(self) -> None:
        check(self, "sliding")

    def resting(self, vibrations: Array, label: int) -> list[int]:
        """The parts, counted from 1, that vibrate too little for the label with this number; none
        for an enrolled label, whose limit is unknown."""
        if label >= len(self.least):
            return []
        least = self.least[label]
        return [part for part, found in enumerate(vibrations.tolist(), 1) if found < least]

    def judges(self, given: StageInputs) -> list[Stage]:
        """Whether a pattern shows, and whether the finger vibrates."""
        vibrates = Vibrates(self, given)
        if self.pattern is None or given.height is None:
            return [vibrates]
        return [ShowsPattern(self.pattern, given.height), vibrates]


def vibration(taxels: Counts, tare: Array, parts: int = PARTS) -> Array:
    """Natural logarithm of vibration over load in each part, float64 [parts].

    taxels: raw counts [T, R, C] or [T, R, C, A], at least `parts` frames; only the normal axis
    counts. tare: counts [R, C] or [R, C, A] of the unloaded skin. The vibration is the root of the
    mean variance of the taxels within a part, the load their mean count above the tare.
    """
    window = Window.of(taxels)
    each = len(window) // parts
    series = window.counts[: parts * each].reshape(parts, each, -1)
    offset = normal(window.series[0].reshape(tare.shape) - tare, 0)
    means, flat = ones(each) @ series / each, series.reshape(parts, -1)
    variance = (np.vecdot(flat, flat) / each - np.vecdot(means, means)) / offset.size
    total = np.add.reduce(offset, axis=None)
    load = np.abs(means.dot(ones(offset.size)) + total) / offset.size
    result: Array = 0.5 * np.log(np.maximum(variance, TINY)) - np.log(np.maximum(load, TINY))
    return result


class Vibrates:
    """Refuses a sweep in which the finger rests in a part of the window so far, where a slide over
    the label of the answer vibrates more. A load beyond that of training counts as that of
    training: vibrations grow less than it."""

    def __init__(self, limits: SlideLimits, given: StageInputs) -> None:
        self._limits, self._given = limits, given

    def apply(self, context: Context) -> Refusal | None:
        """Refuse a sweep with a rest."""
        parts = PARTS * len(context.taxels) // self._given.format.window
        if context.whole and not self._limits.whole:
            return None
        if not parts or len(context.taxels) < 2 * parts:
            return None
        beyond = self._given.beyond("load", context.disturbed)
        label = int(self._given.decided(context.probabilities).argmax())
        found = self._limits.resting(vibration(context.window, context.tare, parts) + beyond, label)
        if not found:
            return None
        where, name = " ".join(map(str, found)), self._given.labels[label]
        numbers = {"parts": where, "of": PARTS, "label": name}
        return Refusal(Status.NO_SLIDE, Remark(Reason.RESTS, numbers))
