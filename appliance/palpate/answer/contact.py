"""Position of the contact on the skin: its centre, and its distance from the trained positions.
Pure functions of raw counts.

The classifier calls them once per sweep to detect a displacement of the contact; `alignment` calls
them many times per second to show it. If the contact extends beyond the skin's edge, no taxel
measures that part, so the computed centre is too close to the middle of the skin. The distance is
then too small but never has the wrong sign, so following it and measuring again leads to the right
position. For a skin with several axes only the normal axis counts.

Without displacement: 747 instead of 747 of 816 altered slides right, 141 instead of 177 of 192
displaced ones, 52 instead of 52 of 480 junk windows named; 5 us less of 646 (`python -m
palpate_studies rules`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context, Displacement, Refusal, Stage, StageInputs
from palpate.answer.window import Window
from palpate.core.errors import BundleError
from palpate.core.schema import LEAST, Positive, Within, check
from palpate.core.status import Reason, Remark
from palpate.core.types import Status, normal

LEAST_PART = 0.25
"""A direction with a smaller share of the distance is left out: it changes the distance by less
than 3 %."""
MOST_POSITIONS = 1000
"""Largest number of positions in a bundle, since each sweep is compared with all of them."""
IN_PLACE = "in place"

Point = tuple[float, float]
_Length = Annotated[float, Within(LEAST, 1e6)]
_Places = Annotated[tuple[Annotated[float, Within(-1e6, 1e6)], ...], Within(1, MOST_POSITIONS)]
"""In mm, up to 1 km."""


@dataclass(frozen=True, slots=True)
class ContactPositions:
    """Positions of the contact's centre in training. Raises BundleError for a number out of range.

    pitch_mm: distance between taxels. rows_mm, cols_mm: one entry per position, mm from the centre
    of taxel 1.1 (row 1, column 1) towards higher rows and columns. limit_mm: a sweep whose centre
    is farther than this from the nearest position counts as displaced.
    """

    pitch_mm: _Length
    rows_mm: _Places
    cols_mm: _Places
    limit_mm: _Length

    def __post_init__(self) -> None:
        check(self, "place")
        if len(self.rows_mm) != len(self.cols_mm):
            raise BundleError(
                f"place has {len(self.rows_mm)} rows_mm and {len(self.cols_mm)} cols_mm, where "
                "each position has one of both; export the bundle again"
            )

    def offset(self, centre: Point) -> Point:
        """Vector from the nearest trained position to `centre` (in taxels, from `centre()`): mm
        along rows and columns."""
        away = complex(*centre) * self.pitch_mm - _points(self.rows_mm, self.cols_mm)
        nearest = away[np.abs(away).argmin()]
        return float(nearest.real), float(nearest.imag)

    def within(self, offset: Point) -> bool:
        """Whether a contact at this offset (mm) from a trained position counts as in place."""
        return math.hypot(*offset) <= self.limit_mm


@lru_cache(maxsize=4)
def _points(rows_mm: tuple[float, ...], cols_mm: tuple[float, ...]) -> NDArray[np.complex128]:
    return np.array(rows_mm) + 1j * np.array(cols_mm)


def centre(taxels: NDArray[Any], tare: NDArray[np.float64], contact: float) -> Point | None:
    """The contact's centre (row, column) in taxels, 0.0 at the centre of taxel 1.1; None without
    contact.

    taxels: raw counts [T, R, C] or [T, R, C, A] of a window or of the latest frames. tare: mean
    counts [R, C] or [R, C, A] of the unloaded skin. contact: counts above the tare from which a
    taxel is loaded (the bundle's threshold). The centre is the mean position of the loaded taxels,
    weighted by their mean load: the centre of pressure of the part that the skin covers. A fit of
    the contact's shape would have no bias towards the middle of the skin, but the gains of taxels
    differ between attachments, which causes larger errors in a fit. A saturated taxel counts at
    full scale.
    """
    mean = Window(taxels).mean.reshape(taxels.shape[1:])
    return centre_of(normal(mean, 0), normal(tare, 0), contact)


def centre_of(mean: NDArray[np.float64], tare: NDArray[np.float64], contact: float) -> Point | None:
    """As `centre`, from the mean counts [R, C] along the normal. tare: [R, C]."""
    load = mean - tare
    least, most = np.minimum.reduce(load, axis=None), np.maximum.reduce(load, axis=None)
    if not contact <= least <= most < np.inf:
        load = fill_dead_taxels(np.where((load >= contact) & (load < np.inf), load, 0))
    total, row, column = (_moments(*load.shape) @ load.ravel()).tolist()
    return (row / total, column / total) if total > 0 else None


@lru_cache(maxsize=4)
def _moments(rows: int, cols: int) -> NDArray[np.float64]:
    """One, the row and the column of each taxel, [3, R * C]."""
    row, column = np.divmod(np.arange(rows * cols), cols)
    return np.stack([np.ones(rows * cols), row, column])


def fill_dead_taxels(load: NDArray[np.float64]) -> NDArray[np.float64]:
    """`load` [R, C] in counts (0 or less: not loaded) with dead taxels filled in: an unloaded taxel
    between two loaded taxels of its row or column gets their mean. A contact has no hole, and a
    hole would shift its centre."""
    if (load > 0).all():
        return load
    padded = np.zeros((load.shape[0] + 2, load.shape[1] + 2))
    padded[1:-1, 1:-1] = load
    sides = np.stack(
        [
            [padded[:-2, 1:-1], padded[2:, 1:-1]],
            [padded[1:-1, :-2], padded[1:-1, 2:]],
        ]
    )
    between = (sides > 0).all(axis=1)
    filled = (sides.mean(axis=1) * between).sum(axis=0) / np.maximum(between.sum(axis=0), 1)
    return np.where(load > 0, load, filled)


def advice(offset: Point, shape: Sequence[int]) -> str:
    """Describes the offset (mm along rows, columns) from a trained position on a skin of `shape`
    [R, C], for example "2.1 mm too far towards row 4". The larger direction comes first; a
    direction below LEAST_PART is left out."""
    least = LEAST_PART * math.hypot(*offset)
    parts = [
        (abs(mm), f"{name} {n if mm > 0 else 1}")
        for mm, name, n in zip(offset, ("row", "column"), shape, strict=True)
        if abs(mm) >= least
    ]
    (most, where), *others = sorted(parts, reverse=True)
    return f"{most:.1f} mm too far towards {where}" + "".join(
        f" and {mm:.1f} mm towards {to}" for mm, to in others
    )


def displacement(
    mean: NDArray[np.float64],
    tare: NDArray[np.float64],
    contact: float,
    positions: ContactPositions,
) -> Displacement:
    """The displacement of a sweep's contact. mean: counts [R, C] or [R, C, A] of its window. tare,
    contact: as for `centre`."""
    found = centre_of(normal(mean, 0), normal(tare, 0), contact)
    if found is None or positions.within(offset := positions.offset(found)):
        return Displacement()
    return Displacement(math.hypot(*offset), f"moved {advice(offset, tare.shape[:2])}")


class LocateContact:
    """Finds the displacement of the contact. contact: as for `centre`."""

    def __init__(self, positions: ContactPositions, contact: float) -> None:
        self._positions, self._contact = positions, contact

    def apply(self, context: Context) -> None:
        """Measure the displacement of a checked window."""
        assert context.mean is not None
        context.displacement = displacement(
            context.mean, context.tare, self._contact, self._positions
        )


@dataclass(frozen=True, slots=True)
class DisplacementRule:
    """Rule for sweeps whose contact is displaced from `Manifest.contact`. Raises BundleError for a
    number out of range.

    limit: as Known.balanced, for the distances of displaced sweeps. temperature: divisor of logits
    that are calibrated for sweeps without displacement. unsure: least probability for status ok;
    above 1 a single displaced sweep is never ok. farthest_mm: displacement from which on a sweep
    gets no label, because no training copy is displaced as far; None if unknown.
    """

    limit: Positive
    temperature: Positive
    unsure: Positive
    farthest_mm: Positive | None = None

    def __post_init__(self) -> None:
        check(self, "displacement")

    def judges(self, given: StageInputs) -> list[Stage]:
        """Whether the contact is within reach."""
        return [self]

    def apply(self, context: Context) -> Refusal | None:
        """Refuse a contact that is displaced further than any training copy."""
        farthest = self.farthest_mm
        if farthest is not None and context.displacement.mm > farthest:
            return Refusal(Status.UNKNOWN, Remark(Reason.TOO_FAR, {"farthest_mm": farthest}))
        return None
