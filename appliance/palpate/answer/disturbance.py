"""Disturbances of a sweep that the box can measure: noise, load, speed, lost frames and hum.

Each moves the embedding of a known material further than the limit of known materials. Its size is
known, so the means of the materials move with it and the limit grows with it. A sweep without
disturbance is judged as before.

Without disturbance: 673 instead of 747 of 816 altered slides right, 177 instead of 177 of 192
displaced ones, 39 instead of 52 of 480 junk windows named; 9 us less of 646 (`python -m
palpate_studies rules`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context, Refusal
from palpate.answer.window import TINY, Counts, Window, ones
from palpate.core.errors import BundleError
from palpate.core.schema import MOST, Positive, Within, check
from palpate.core.status import Reason, Remark
from palpate.core.types import Status, normal

Array = NDArray[Any]
Name = Literal["noise", "load", "speed", "lost", "hum"]
"""The disturbances. noise, load: see below. speed: natural logarithm of the taxels that the slide
passes in a second. lost: share of the frames that never arrived. hum: square root of the amplitude
that was removed, in counts; large hum moves the embedding hardly further than small hum."""
SAID: Mapping[Name, tuple[str, str]] = {
    "noise": ("less noise", "more noise"),
    "load": ("a lower load", "a higher load"),
    "speed": ("a slower slide", "a faster slide"),
    "lost": ("fewer lost frames", "more lost frames"),
    "hum": ("less hum", "more hum"),
}
"""Disturbances in messages: a value that is too low, or too high."""
ORDER = 4
"""Noise is measured in the fourth difference of the counts, in which the vibrations of a slide
hardly appear: at a tenth of the rate it has a hundredth of the power that noise has."""
FRAMES = 512
"""Frames in the middle of the window that show the noise; all of them would take three times as
long."""


def noise(taxels: Counts) -> float:
    """Natural logarithm of the noise power of the median taxel, in counts squared. taxels: raw
    counts [T, R, C] or [T, R, C, A] of a window; only the normal axis is used."""
    counts = Window.of(taxels).counts
    frames, values = counts.shape
    if frames <= ORDER:
        return -math.inf
    first = max(0, (frames - FRAMES) // 2)
    steps = counts[first : first + FRAMES].ravel()
    for _ in range(ORDER):
        steps = steps[values:] - steps[:-values]
    squares = (steps * steps).reshape(-1, values)
    powers = np.sort(ones(len(squares)).dot(squares)).tolist()  # those not finite are last
    middle = powers[(values - 1) // 2] + powers[values // 2]
    power = middle / 2 / len(squares) / math.comb(2 * ORDER, ORDER)
    return math.log(max(power, TINY)) if math.isfinite(power) else math.log(TINY)


def load(mean: Array, tare: Array) -> float:
    """Natural logarithm of the load of all taxels. mean, tare: counts [R, C] or [R, C, A] of the
    window and of the unloaded skin."""
    total = float(np.add.reduce(np.abs(normal(mean, 0) - normal(tare, 0)), axis=None))
    return math.log(max(total, TINY)) if math.isfinite(total) else math.nan


def speed(taxels_s: float) -> float:
    """The value of a slide that passes this many taxels in a second; NaN for 0, an unknown
    speed."""
    return math.log(taxels_s) if taxels_s else math.nan


def hum(counts: float) -> float:
    """The value of hum of this amplitude."""
    return math.sqrt(counts)


@dataclass(frozen=True, slots=True)
class Allowance:
    """The allowance of a bundle for one disturbance.

    of: its name. start: its value at the edge of training. end: the furthest value that export
    has proven. slope: growth of the limit of known materials, as a share of it, for a size of 1.
    tried: the furthest value that export has tried without proof; None without such a value. Raises
    BundleError for a value out of range.
    """

    of: Name
    start: float
    end: float
    slope: Annotated[float, Within(0, MOST)]
    tried: float | None = None

    def __post_init__(self) -> None:
        check(self, f"disturbances ({self.of})")
        if self.start == self.end:
            raise BundleError(
                f"disturbances have start and end {self.start} for {self.of}, which must differ; "
                "export the bundle again"
            )
        if self.tried is not None and self._way * (self.tried - self.end) < 0:
            raise BundleError(
                f"disturbances have tried {self.tried} for {self.of}, which must be beyond the end "
                f"{self.end}; export the bundle again"
            )

    @property
    def _way(self) -> int:
        return 1 if self.end > self.start else -1

    def size(self, value: float) -> float:
        """How far `value` is beyond the edge of training, at most up to `end`; 0 within it, and for
        a value that is not known (NaN)."""
        beyond = self._way * (value - self.start)
        return min(beyond, abs(self.end - self.start)) if beyond > 0 else 0.0

    def untried(self, value: float) -> bool:
        """Whether `value` is beyond what was tried."""
        furthest = self.end if self.tried is None else self.tried
        return self._way * (value - furthest) > 0

    def __str__(self) -> str:
        return SAID[self.of][self._way > 0]


@dataclass(frozen=True, slots=True)
class Disturbances:
    """The allowances of a bundle for disturbances. allowances: [D], in the order of the changes in
    means.npz. hum: least ratio of hum that is removed (signal.hum); None if none is. Raises
    BundleError for a number out of range."""

    allowances: tuple[Allowance, ...] = ()
    hum: Positive | None = None

    def __post_init__(self) -> None:
        check(self, "disturbances")

    def sizes(self, values: Mapping[str, float]) -> list[float]:
        """Sizes [D] of the disturbances of a sweep. values: by name; a missing value is not
        known."""
        return [a.size(values.get(a.of, math.nan)) for a in self.allowances]

    def beyond(self, name: str, values: Mapping[str, float]) -> float:
        """How far the value with this name is above training, 0 within it; see Allowance.size."""
        above = (a for a in self.allowances if a.of == name and a.end > a.start)
        return max((a.size(values.get(name, math.nan)) for a in above), default=0.0)

    def untried(self, values: Mapping[str, float]) -> list[str]:
        """The disturbances of a sweep that are beyond what export has tried, in words."""
        return [str(a) for a in self.allowances if a.untried(values.get(a.of, math.nan))]

    def growth(self, sizes: Sequence[float]) -> float:
        """Factor of the limit of known materials: that of the disturbance that allows most."""
        grown = (a.slope * size for a, size in zip(self.allowances, sizes, strict=True))
        return 1 + max(grown, default=0.0)

    def apply(self, context: Context) -> Refusal | None:
        """Refuse a sweep with a disturbance beyond what export has tried."""
        untried = self.untried(context.disturbed)
        if not untried:
            return None
        what = ", ".join(f"{one} than was tried with this bundle" for one in untried)
        return Refusal(Status.UNKNOWN, Remark(Reason.UNTRIED, {"what": what}))


class MeasureDisturbances:
    """Measures the disturbances of a sweep. unloaded: whether training knew the unloaded skin."""

    def __init__(self, *, unloaded: bool) -> None:
        self._unloaded = unloaded

    def apply(self, context: Context) -> None:
        """Measure them in a checked window without hum."""
        assert context.mean is not None
        tare = context.tare * self._unloaded
        context.disturbed = {
            "lost": context.sweep.lost / len(context.taxels),
            "hum": hum(context.hum),
            "noise": noise(context.window),
            "speed": speed(context.slide.taxels_s),
            "load": load(context.mean, tare),
        }
