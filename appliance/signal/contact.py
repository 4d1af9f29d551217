"""The room of the skin's place: digits of a contact in, its centre and how far that is from where it was in training out.

Pure functions. `classifier` asks once a sweep whether the skin has moved, `place_live` many times a second for a person.
The taxels see a contact only where they lie: of one that reaches over the skin's edge the centre comes out nearer to
the skin's middle than it is. So far off a distance is told too small, never with the wrong sign: move, and look again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import BundleError

MOST_POSITIONS, MOST_MM = 1000, 1e6
"""A bundle may name so many positions, since each sweep is compared with all of them; and no length above a kilometre."""
LEAST_PART = 0.25
"""A direction whose share of the distance is smaller is not named: it changes the distance by under 3 %."""
IN_PLACE = "in place"

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class ContactPositions:
    """Where the contact's centre lay in training. Raises BundleError where a number makes no sense.

    pitch_mm: from taxel to taxel. rows_mm, cols_mm: one entry for each position, mm from the centre of taxel 1.1 (row
    1, column 1) towards higher rows and columns. limit_mm: a sweep whose centre is farther than this from the nearest
    of them is `moved`.
    """

    pitch_mm: float
    rows_mm: tuple[float, ...]
    cols_mm: tuple[float, ...]
    limit_mm: float

    def __post_init__(self) -> None:
        for name in ("pitch_mm", "limit_mm"):
            value = getattr(self, name)
            if not _length(value) or value <= 0:
                raise BundleError(f"place.{name} {value!r} must be mm above 0; export the bundle again")
        for name in ("rows_mm", "cols_mm"):
            values = getattr(self, name)
            if type(values) is not tuple or not 1 <= len(values) <= MOST_POSITIONS or not all(map(_length, values)):
                raise BundleError(f"place.{name} must be 1 to {MOST_POSITIONS} places in mm; export the bundle again")
        if len(self.rows_mm) != len(self.cols_mm):
            raise BundleError(
                f"place has {len(self.rows_mm)} rows_mm and {len(self.cols_mm)} cols_mm, where each position has one of "
                "both; export the bundle again"
            )

    def offset(self, centre: Point) -> Point:
        """From the nearest trained position to `centre` (taxels, as the function gives it): mm along rows and columns."""
        rows = centre[0] * self.pitch_mm - np.array(self.rows_mm)
        cols = centre[1] * self.pitch_mm - np.array(self.cols_mm)
        nearest = np.hypot(rows, cols).argmin()
        return float(rows[nearest]), float(cols[nearest])

    def within(self, offset: Point) -> bool:
        """Whether a contact this far (mm) from a trained position counts as in place."""
        return bool(np.hypot(*offset) <= self.limit_mm)


def _length(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= MOST_MM


def centre(taxels: NDArray[Any], tare: NDArray[np.float64], contact: float) -> Point | None:
    """The contact's centre: row and column, counted in taxels from 0.0 at the centre of taxel 1.1; None without contact.

    taxels: digits [T, R, C] of a window or of the latest frames. tare: the unloaded skin [R, C]. contact: digits above
    it from which a taxel is loaded (the bundle's threshold).
    It is the mean place of the loaded taxels, weighted by their load over time: the centre of pressure of the part
    that the skin sees. A fit of the contact's form would not be drawn to the skin's middle, but the gains of taxels
    differ from one attachment to the next, and that throws a fit off by more.
    A taxel at full scale counts as that.
    """
    series = np.ascontiguousarray(taxels.reshape(len(taxels), -1).T)  # twice as fast to reduce
    load = series.mean(axis=1, dtype=np.float64).reshape(tare.shape) - tare
    load = mended(np.where(np.isfinite(load) & (load >= contact), load, 0))
    total = load.sum()
    if total <= 0:
        return None
    rows, cols = load.sum(axis=1), load.sum(axis=0)
    return float(rows @ np.arange(len(rows)) / total), float(cols @ np.arange(len(cols)) / total)


def mended(load: NDArray[np.float64]) -> NDArray[np.float64]:
    """`load` [R, C] (0 and less: not loaded) with dead taxels filled in: one that is silent between two loaded ones of its row
    or column gets their mean. A contact has no hole, and one would push its centre away."""
    padded = np.zeros((load.shape[0] + 2, load.shape[1] + 2))
    padded[1:-1, 1:-1] = load
    sides = np.stack([
        [padded[:-2, 1:-1], padded[2:, 1:-1]],
        [padded[1:-1, :-2], padded[1:-1, 2:]],
    ])  # fmt: skip
    between = (sides > 0).all(axis=1)
    filled = (sides.mean(axis=1) * between).sum(axis=0) / np.maximum(between.sum(axis=0), 1)
    return np.where(load > 0, load, filled)


def advice(offset: Point, shape: tuple[int, int]) -> str:
    """What is wrong with a contact this far (mm, rows and columns) from a trained position on a skin of `shape` taxels:
    "2.1 mm too far towards row 4". The larger direction comes first, a slight one is left out."""
    least = LEAST_PART * np.hypot(*offset)
    parts = [
        (abs(mm), f"{name} {n if mm > 0 else 1}")
        for mm, name, n in zip(offset, ("row", "column"), shape, strict=True)
        if abs(mm) >= least
    ]
    (most, where), *others = sorted(parts, reverse=True)
    return f"{most:.1f} mm too far towards {where}" + "".join(f" and {mm:.1f} mm towards {to}" for mm, to in others)


def moved(taxels: NDArray[Any], tare: NDArray[np.float64], contact: float, place: ContactPositions) -> str:
    """ "" where the contact of a sweep [T, R, C] lies where some lay in training, else "moved 2.1 mm too far towards
    row 4". tare, contact: as for `centre`."""
    found = centre(taxels, tare, contact)
    if found is None or place.within(offset := place.offset(found)):
        return ""
    return f"moved {advice(offset, tare.shape)}"
