"""Whether a window is a slide over something: a material must not be learned from a finger at rest,
from noise, or from a single taxel.

Unlike the checks of an answer, it does not know the material. Over a slide a pattern passes from
taxel to taxel, which neither a resting finger nor noise gives. docs/decisions/0027 has the figures.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.types import SweepFormat, normal
from appliance.signal.slide import LEAST_HEIGHT, SlideMeter
from appliance.signal.vibration import PARTS, SlideLimits, vibration

FEW = 4
"""A skin of at least so many taxels touches a finger with more than one."""


class SlideCheck:
    """Checks windows of one format.

    tare: counts [R, C] or [R, C, A] of the unloaded skin. contact: least load of a taxel in counts,
    None if it is unknown. limits: least vibrations of the known materials, None if they are
    unknown. patterned: whether slides on this skin show a pattern, as those of training did;
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

    def __call__(self, taxels: NDArray[Any]) -> str:
        """The reason why a window of raw counts [T, R, C] or [T, R, C, A] is not a slide; "" if it
        is one, or if that cannot be seen on this skin."""
        load = np.abs(normal(taxels.mean(axis=0, dtype=np.float64) - self._tare, 0))
        if self._contact is not None:
            loaded = np.argwhere(load >= self._contact)
            if not len(loaded):
                return f"no contact: the strongest taxel has {load.max():.1f} raw counts"
            if len(loaded) == 1 and load.size >= FEW:
                row, column = loaded[0] + 1
                return f"only taxel {row}.{column} is loaded"
        if self._least is not None and len(taxels) >= 2 * PARTS:
            rests = np.flatnonzero(vibration(taxels, self._tare) < self._least) + 1
            if len(rests):
                where = " ".join(map(str, rests))
                return f"the finger rests: hardly any vibration in part {where} of {PARTS}"
        if self._meter.why:
            return ""
        slide = self._meter(taxels)
        if slide.height < LEAST_HEIGHT:
            return "no slide: no pattern passes from taxel to taxel, as with a resting finger"
        return ""
