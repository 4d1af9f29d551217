"""One window of raw counts, with what several rules need of it: computed when it is first needed,
once, and in float32. And its check without a model: contact, saturation, stuck and dead taxels, by
the limits of a bundle (`inspect`), or by limits from the unloaded skin (`inspect_bare`)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.answer.unloaded import QUIET, SHARE, UnloadedSkin
from palpate.core.schema import MOST, Positive, Within
from palpate.core.status import Reason, Remark
from palpate.core.types import LARGEST_READING, Status, normal

Array = NDArray[Any]
T = TypeVar("T")
TRIPLES = 100
"""Number of places in a stretch at which the noise is measured. More places take more time and
change the result by less than a tenth."""
TINY = 1e-30
"""Replaces 0 as a divisor, or where a logarithm is taken."""
FULL_SCALES = tuple(float(2**bits - 1) for bits in (8, 10, 12, 14, 15, 16, 24))
"""Highest counts of common converters; a skin does not announce its own."""
MANY_FULL = 0.01
"""With a larger share of the counts at full scale a window is saturated, unless export has proven
more for the bundle."""
STAYS = 0.02
"""Where an amplifier clips, a value that also moves below stays at the highest count for at least
this share of the frames."""


class once(Generic[T]):
    """A property that is computed when it is first read, in half the time of functools' own."""

    def __init__(self, compute: Callable[[Any], T]) -> None:
        self._compute, self.__doc__ = compute, compute.__doc__

    def __get__(self, window: Any, owner: type) -> T:
        value = window.__dict__[self._compute.__name__] = self._compute(window)
        return value


class Window:
    """A stretch of T frames with V values each, in the order of a frame, N of them along the
    normal. taxels: raw counts [T, R, C] or [T, R, C, A]."""

    def __init__(self, taxels: Array) -> None:
        self.taxels = taxels
        self.series = taxels.reshape(len(taxels), -1)
        """Raw counts [T, V]."""

    @classmethod
    def of(cls, taxels: Counts) -> Window:
        """The window of raw counts, or the given one."""
        return taxels if isinstance(taxels, Window) else cls(taxels)

    def __len__(self) -> int:
        return len(self.taxels)

    @once
    def values(self) -> NDArray[np.float32]:
        """Counts [T, V] above the first frame: squares of large counts would round small vibrations
        away. NaN throughout for a value that is not readable."""
        values = self.series.astype(np.float32)
        first = values[0] if self.readable else np.where(self.unreadable, np.nan, values[0])
        together = next(n for n in (100, 64, 50, 32, 20, 10, 1) if not len(values) % n)
        rows = values.reshape(-1, together * len(first))  # long rows are quick to subtract
        rows -= (ones(together)[:, None] * first).ravel()
        return values

    @once
    def counts(self) -> NDArray[np.float32]:
        """The values along the normal, [T, N]."""
        axes = self.taxels.shape[3] if self.taxels.ndim == 4 else 1
        values = self.values
        return values if axes == 1 else np.ascontiguousarray(values[:, axes - 1 :: axes])

    @once
    def mean(self) -> NDArray[np.float64]:
        """Mean raw counts [V]."""
        above = ones(len(self)).dot(self.values)  # of whole counts exact
        return np.asarray(self.series[0] + above / np.float64(len(self)))

    @once
    def highest(self) -> Array:
        """Highest raw counts [V]."""
        return np.asarray(self.series.max(axis=0))

    @once
    def lowest(self) -> Array:
        """Lowest raw counts [V]."""
        return np.asarray(self.series.min(axis=0))

    @property
    def still(self) -> NDArray[np.bool_]:
        """The values that are constant, bool [V]."""
        still: NDArray[np.bool_] = self.lowest == self.highest
        return still

    @property
    def unreadable(self) -> NDArray[np.bool_]:
        """The values with a count that is not a number, or beyond LARGEST_READING, bool [V]."""
        with np.errstate(invalid="ignore"):
            largest = np.maximum(np.abs(self.highest), np.abs(self.lowest))
            unreadable: NDArray[np.bool_] = ~(largest <= LARGEST_READING)
        return unreadable

    @once
    def readable(self) -> bool:
        """Whether no value is unreadable."""
        return self.series.dtype.kind != "f" or bool(np.abs(self.series).max() <= LARGEST_READING)

    @once
    def noise(self) -> NDArray[np.float32]:
        """Mean magnitude of the second difference of three frames, float32 [V] in counts.

        It contains the fast part of the signal: white noise counts far more than a vibration below
        a quarter of the frame rate. 0 for fewer than three frames.
        """
        frames, values = self.values.shape
        step = max(3, frames // TRIPLES)
        places = frames // step
        if not places:
            return np.zeros(values, np.float32)
        triples = self.values[: places * step].reshape(places, step, values)
        second = triples[:, 0] + triples[:, 2]
        second -= 2 * triples[:, 1]
        noise: NDArray[np.float32] = ones(places).dot(np.abs(second)) / places
        return noise

    @once
    def quietest(self) -> float:
        """The least noise of a value; above 0 if all values change, surely."""
        return float(np.minimum.reduce(self.noise))


Counts = Array | Window


@lru_cache(maxsize=16)
def ones(number: int) -> NDArray[np.float32]:
    """Multiplies this number of values to give their sum, in a third of the time of numpy's sum."""
    return np.ones(number, np.float32)


class Waves:
    """Gives amplitudes float32 [F, 2, N] at `hz` [F] of series float32 [T, N], real and imaginary
    parts one after the other, with a Hann window and without a polynomial of degree `trend`, 0 or
    1. Phases are those in the middle: around it the real part of a wave is even and the imaginary
    part odd, so half of it suffices."""

    def __init__(self, hz: Array, frames: int, rate_hz: float, trend: int = 0) -> None:
        time = np.arange(frames) - (frames - 1) / 2
        turns: Array = np.exp(-2j * np.pi / rate_hz * hz[:, None] * time) * np.hanning(frames)
        for power in range(trend + 1):
            base = time**power / max(float(np.linalg.norm(time**power)), 1.0)
            turns -= (turns @ base)[:, None] * base
        half = turns[:, : (frames + 1) // 2]
        half[:, frames // 2 :] /= 2  # the frame in the middle is its own mirror image
        self._even, self._odd = half.real.astype(np.float32), half.imag.astype(np.float32)

    def __call__(self, series: Array) -> Array:
        """The amplitudes; not finite where a series is not."""
        frequencies, half = self._even.shape
        start, end = series[:half], series[: -half - 1 : -1].copy()  # long rows are quick to add
        amplitudes = np.empty((frequencies, 2, series.shape[1]), np.float32)
        np.matmul(self._even, start + end, out=amplitudes[:, 0])
        np.matmul(self._odd, start - end, out=amplitudes[:, 1])
        return amplitudes


@dataclass(frozen=True, slots=True)
class WindowLimits:
    """Limits for a window.

    contact: least mean over time of a loaded taxel, in counts above the tare. With None every taxel
    counts as loaded, since loads do not differ from the unloaded skin. full_scale: the sensor's
    highest count. saturated: largest accepted share of full-scale counts. dead_taxels: largest
    accepted number of taxels without a signal, of the stuck ones and of the dead ones.
    """

    contact: Annotated[float, Within(0, MOST)] | None
    full_scale: Positive
    saturated: Annotated[float, Within(0, 1)] = MANY_FULL
    dead_taxels: Annotated[int, Within(0, 255 * 255)] = 0


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """Result of the check of a window: status ok, or another status with a remark.

    degraded: the broken taxels that were bridged, None for none. mean: counts of the window that
    was checked, in the shape of a frame, if the check passed. full: share of the counts at
    full scale, likewise; silent: number of its stuck or dead taxels, the larger one.
    """

    status: Status
    remark: Remark | None = None
    degraded: str | None = None
    mean: NDArray[np.float64] | None = field(default=None, compare=False)
    full: float = field(default=0.0, compare=False)
    silent: int = field(default=0, compare=False)

    @property
    def detail(self) -> str:
        """The remark in words."""
        return self.remark.text if self.remark else ""


def _taxels(mask: NDArray[np.bool_]) -> Remark:
    """The taxels of a mask [R, C, A], with their axes if not all of several are meant: "taxel 1.2
    and 2.3 axis 1"."""
    named = []
    for r, c in np.argwhere(mask.any(axis=2)):
        axes = (
            ""
            if mask[r, c].all()
            else " axis " + " ".join(str(a + 1) for a in np.flatnonzero(mask[r, c]))
        )
        named.append(f"{r + 1}.{c + 1}{axes}")
    text = "taxel " + (" " if mask.shape[2] == 1 else " and ").join(named)
    return Remark(Reason.TAXELS, {"taxels": text})


def inspect(
    taxels: Counts, tare: NDArray[np.float64], limits: WindowLimits, *, either_way: bool = False
) -> Finding:
    """Check a window before it is classified. taxels: raw counts [T, R, C] or [T, R, C, A]; tare:
    counts [R, C] or [R, C, A] of the unloaded skin.

    A taxel is loaded by its normal axis. A loaded taxel always varies, on each axis, so a constant
    axis is stuck. A constant unloaded taxel is dead if all its direct neighbours are loaded; at the
    edge of the contact it may be unloaded. A taxel with a count that is not a number or impossibly
    large is always dead.
    Shear has a sign, so shear axes are saturated at both ends. either_way: a load may also lower
    the counts.
    """
    shape = (*tare.shape, 1)[:3]  # [R, C, A]
    window = Window.of(taxels)
    load = window.mean.reshape(shape) - tare.reshape(shape)
    load = np.abs(load) if either_way else load
    # possible with float32 counts; the network's output would then be meaningless
    if not (window.readable and math.isfinite(np.add.reduce(load, axis=None))):
        unreadable = window.unreadable.reshape(shape) | ~np.isfinite(load)
        return Finding(Status.DEAD_TAXEL, _taxels(unreadable))
    contact = -np.inf if limits.contact is None else limits.contact
    strongest = float(np.maximum.reduce(load[..., -1], axis=None))
    if strongest < contact:
        return Finding(Status.NO_CONTACT, Remark(Reason.UNLOADED, {"counts": strongest}))
    full = _at_full_scale(window, limits.full_scale, shape)
    if full is None and window.quietest > 0:
        return Finding(Status.OK, mean=window.mean.reshape(tare.shape))
    loaded = load[..., -1:] >= contact  # [R, C, 1]
    full, still = np.zeros(shape) if full is None else full, window.still.reshape(shape)
    stuck = still & loaded & (full < 1)
    if (count := int(stuck.any(axis=2).sum())) > limits.dead_taxels:
        return Finding(Status.STUCK_TAXEL, _taxels(stuck))
    share = float(full.mean())
    if share > limits.saturated:
        return Finding(Status.SATURATED, _taxels(full > 0))
    silent = still[..., -1:] & ~loaded
    if silent.any():
        dead = silent & enclosed(loaded[..., 0])[..., None]
        if dead.sum() > limits.dead_taxels:
            return Finding(Status.DEAD_TAXEL, _taxels(dead & still))
        count = max(count, int(dead.sum()))
    return Finding(Status.OK, mean=window.mean.reshape(tare.shape), full=share, silent=count)


def ceiling(measured: Window, full_scale: float) -> float:
    """The count at which the amplifier clips in a window.

    It is the highest count of all. A value has to be constant there. Another one has to stay there
    for STAYS of the frames. Otherwise it is `full_scale`.
    """
    highest = float(measured.highest.max())
    at = measured.highest == highest
    constant = (at & measured.still).sum()
    if not (highest < full_scale and constant):
        return full_scale
    stays = (measured.series[:, at & ~measured.still] == highest).mean(axis=0).max(initial=0.0)
    return highest if constant > 1 or stays >= STAYS else full_scale


def _at_full_scale(
    window: Window, full_scale: float, shape: tuple[int, ...]
) -> NDArray[np.float64] | None:
    """Share of the frames at full scale, of `shape` [R, C, A]; on shear axes at its negative, too.
    None if there are none, as mostly: counting takes longer than all the rest."""
    series = window.series
    top = np.maximum.reduce(series, axis=None)
    if top < full_scale and (shape[2] == 1 or series.min() > -full_scale):
        return None
    full: NDArray[np.float64] = (series >= full_scale).mean(axis=0).reshape(shape)
    full[..., :-1] += (series <= -full_scale).mean(axis=0).reshape(shape)[..., :-1]
    return full


def enclosed(loaded: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether all direct neighbours of a taxel are loaded, bool [R, C]. Places beyond the skin's
    edge count as loaded."""
    padded = np.ones((loaded.shape[0] + 2, loaded.shape[1] + 2), bool)
    padded[1:-1, 1:-1] = loaded
    enclosed: NDArray[np.bool_] = (
        padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    )
    return enclosed


def inspect_readings(taxels: NDArray[Any]) -> Finding:
    """Check a window of an unknown skin: a taxel with a count that is not a number or impossibly
    large is dead."""
    if (window := Window(taxels)).readable:
        return Finding(Status.OK)
    shape = (*taxels.shape[1:], 1)[:3]
    return Finding(Status.DEAD_TAXEL, _taxels(window.unreadable.reshape(shape)))


def inspect_bare(taxels: NDArray[Any], unloaded: UnloadedSkin) -> Finding:
    """As `inspect`, for a skin without a bundle, so that the strength of a contact and the highest
    count are unknown.

    It refuses only certain cases: `no-contact` if no taxel differs from the unloaded skin, in
    either direction, and none vibrates; `saturated` if the highest count is one of FULL_SCALES.
    """
    if (unreadable := inspect_readings(taxels)).status is not Status.OK:
        return unreadable
    load = np.abs(normal(taxels.mean(axis=0, dtype=np.float64) - unloaded.level, 0))
    strongest = float(load.max(initial=0, where=np.isfinite(load)))
    if (
        strongest < unloaded.contact
        and UnloadedSkin.measured(taxels).contact > QUIET * unloaded.contact
    ):
        return Finding(Status.OK)  # the skin slides over something
    highest = float(taxels.max())
    full_scale = highest if highest in FULL_SCALES else np.inf
    limits = WindowLimits(max(unloaded.contact, SHARE * strongest), full_scale)
    return inspect(taxels, unloaded.level, limits, either_way=True)
