"""Checks a window without a model: contact, saturation, stuck and dead taxels.

Pure functions. `inspect` uses the limits of a bundle; `inspect_bare` derives limits from the
unloaded skin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.unloaded import QUIET, UnloadedSkin
from palpate.answer.window import Counts, Window
from palpate.core.schema import MOST, Positive, Within
from palpate.core.status import Reason, Remark
from palpate.core.types import Status, normal

FULL_SCALES = tuple(float(2**bits - 1) for bits in (8, 10, 12, 14, 15, 16, 24))
"""Highest counts of common converters; a skin does not announce its own."""
SHARE = 0.1
"""A loaded taxel has at least this share of the load of the strongest taxel, as in the limits of a
bundle (train/palpate_train/export/pack)."""
MANY_FULL = 0.01
"""With a larger share of the counts at full scale a window is saturated, unless export has proven
more for the bundle."""
STAYS = 0.02
"""Where an amplifier clips, a value that also moves below stays at the highest count for at least
this share of the frames."""


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


@dataclass(slots=True, eq=False)
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
