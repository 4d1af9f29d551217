"""Whether a window is a slide over something: a material must not be learned from a finger at rest,
from noise, or from a single taxel.

Unlike the checks of an answer, it does not know the material. Over a slide a pattern passes from
taxel to taxel, which neither a resting finger nor noise gives. docs/decisions/0001 has the figures.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.slide import CHANCE, NO_PATTERN, PARTS, SlideLimits, SlideMeter, vibration
from palpate.answer.window import Window
from palpate.core.types import SweepFormat, normal

FEW = 4
"""A skin of at least so many taxels touches a finger with more than one."""
MANY, CLEAR = 4, 2 * CHANCE
"""Fewest sweeps by which others are judged, and the least median height of their patterns. The
median of simulated slides is 20, that of skins whose slides show no pattern 3 to 6."""
NO_SLIDE = f"no slide: {NO_PATTERN}, as with a resting finger"
RESTING = math.log(4)
"""A sweep rests if its vibration over load is less than a quarter of the median of its material, in
logarithms. Slides over one material differ by less in the simulator."""
RESTS = "the finger rests: other sweeps of this material vibrate four times as much"
UNCHECKED = "slides on this skin show no pattern, so a finger that always rests is not noticed"


class SlideCheck:
    """Checks windows of one format.

    tare: counts [R, C] or [R, C, A] of the unloaded skin. contact: least load of a taxel in counts,
    None if it is unknown. limits: least vibrations of the known materials, None if they are
    unknown. patterned: whether slides on this skin show a pattern, as in training;
    SlideMeter measures it.
    """

    def __init__(
        self,
        format: SweepFormat,
        tare: NDArray[np.float64],
        contact: float | None = None,
        limits: SlideLimits | None = None,
        *,
        patterned: bool = True,
    ) -> None:
        self._tare, self._contact = tare, contact
        self._least = min(limits.least) if limits and limits.least else None
        # the height of a pattern does not depend on the pitch
        self._meter = SlideMeter(format, 1.0 if patterned else None)

    def __call__(self, taxels: NDArray[Any]) -> str | None:
        """The reason why a window of raw counts [T, R, C] or [T, R, C, A] is not a slide; None if
        it is one, or if that cannot be seen on this skin."""
        window = Window(taxels)
        load = np.abs(normal(window.mean.reshape(self._tare.shape) - self._tare, 0))
        if self._contact is not None:
            if load.max() < self._contact:
                return f"no contact: the strongest taxel has {load.max():.1f} raw counts"
            if (why := only_taxel(load, self._contact)) is not None:
                return why
        if self._least is not None and len(taxels) >= 2 * PARTS:
            rests = np.flatnonzero(vibration(window, self._tare) < self._least) + 1
            if len(rests):
                where = " ".join(map(str, rests))
                return f"the finger rests: hardly any vibration in part {where} of {PARTS}"
        if self._meter.why is not None:
            return None
        return NO_SLIDE if self._meter(window).height < CHANCE else None


@dataclass(frozen=True, slots=True)
class Slid:
    """What is measured of a window to judge others by: height of the pattern that passes, 0 where
    the skin cannot show one; median vibration of its parts."""

    height: float
    vibration: float


@dataclass(frozen=True, slots=True)
class SlideFinding:
    """why: the reason why a window is not a slide, None if none is seen. certain: whether it is
    judged by sweeps of its own material. unchecked: what could not be seen, "" if all."""

    why: str | None = None
    certain: bool = True
    unchecked: str = ""


class SlidesAmong:
    """Judges windows of one format by one another, where no bundle knows the skin: a window without
    a pattern is not a slide if the others show one; if they show none, a window rests that vibrates
    less than the others of its material."""

    def __init__(self, format: SweepFormat) -> None:
        self._meter = SlideMeter(format, 1.0)

    def measured(self, taxels: NDArray[Any]) -> Slid:
        """The measures of a window [T, R, C] or [T, R, C, A]."""
        height = 0.0 if self._meter.why is not None else self._meter(taxels).height
        parts = vibration(taxels, np.zeros(taxels.shape[1:])) if len(taxels) > PARTS else [0.0]
        return Slid(height, float(np.median(parts)))

    def __call__(self, one: Slid, own: Sequence[Slid], among: Sequence[Slid]) -> SlideFinding:
        """own: sweeps of its material, among: of all; mostly slides, this one may be among them."""
        if _patterned(among):
            if one.height >= CHANCE:
                return SlideFinding()
            return SlideFinding(NO_SLIDE, certain=_patterned(own))
        if len(own) < MANY:
            return SlideFinding(
                unchecked=f"rest not checked: it takes {MANY} sweeps of the material"
            )
        if one.vibration < float(np.median([other.vibration for other in own])) - RESTING:
            return SlideFinding(RESTS)
        return SlideFinding()

    def among(
        self, windows: Iterable[NDArray[Any]], materials: Sequence[str]
    ) -> tuple[list[str | None], str]:
        """The reason for each of these windows, of `materials`, and what could not be seen."""
        found = [self.measured(taxels) for taxels in windows]
        of = {
            own: [one for one, name in zip(found, materials, strict=True) if name == own]
            for own in materials
        }
        pairs = zip(found, materials, strict=True)
        unchecked = UNCHECKED if len(found) >= MANY and not _patterned(found) else ""
        return [self(one, of[own], found).why for one, own in pairs], unchecked


def _patterned(slid: Sequence[Slid]) -> bool:
    """Whether slides on a skin show a pattern, by sweeps that are mostly slides."""
    return len(slid) >= MANY and float(np.median([one.height for one in slid])) >= CLEAR


def only_taxel(load: NDArray[np.float64], contact: float) -> str | None:
    """The reason if a single taxel of `load` [R, C] reaches `contact`, on a skin of FEW taxels or
    more; None else."""
    loaded = np.argwhere(load >= contact)
    if len(loaded) != 1 or load.size < FEW:
        return None
    row, column = loaded[0] + 1
    return f"only taxel {row}.{column} is loaded"
