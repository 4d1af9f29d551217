"""Contacts of a training set: the load that counts as contact, and the positions of the contacts.

The box uses both. A window without a load above the limit is `no-contact`, and a contact far from
all trained positions is displaced. If the recordings contain the unloaded skin, a load is the
difference from it. Otherwise raw counts are taken as loads, if they can be.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.contact import MOST_POSITIONS, ContactPositions, centre
from palpate.answer.unloaded import UnloadedSkin
from palpate.answer.window_check import SHARE
from palpate.core.types import normal
from palpate.sim import skin
from palpate_train.answer import embedding
from palpate_train.data.sets import Dataset
from palpate_train.data.thinning import evenly

Array = NDArray[Any]
BASELINE = 0.5
"""Raw counts are not taken as loads if every taxel in every sweep reads more than this share of the
highest reading: some taxels are hardly touched, and some contacts are stronger than others."""
MIN_LIMIT = 1 / 8
"""Smallest limit of the displacement, in taxels: attaching the skin again in the same place moves
the centre by this much (0.5 mm of 4 mm include over 95 % of the simulated attachments), even if few
or equal positions suggest less."""


@dataclass(frozen=True, slots=True, eq=False)
class ContactLimit:
    """The load from which a taxel is in contact.

    contact: counts above `tare`, None if the sweeps do not show a limit, with the reason in `why`.
    tare: raw counts [R, C] or [R, C, A] of the unloaded skin, 0 where they are unknown.
    """

    contact: float | None
    tare: Array
    why: str = ""

    def known_tare(self) -> tuple[float, ...]:
        """The tare as a manifest holds it; empty if it is unknown."""
        return tuple(self.tare.ravel().tolist()) if self.tare.any() else ()


@dataclass(frozen=True, slots=True, eq=False)
class ContactCentres:
    """Centres of contact in training, in taxels. centres: [P, 2], row and column. limit: distance
    from the nearest centre up to which a contact is in place."""

    centres: Array
    limit: float

    def in_mm(self, pitch_mm: float) -> ContactPositions:
        """The same for a skin with this distance between taxels, as a bundle holds it."""
        rows, cols = (self.centres * pitch_mm).round(3).T.tolist()
        return ContactPositions(
            float(pitch_mm), tuple(rows), tuple(cols), round(pitch_mm * self.limit, 3)
        )


@dataclass(frozen=True, slots=True)
class Contacts:
    """The limit and the centres of a training set; centres: None without a limit or a contact.
    pitch_mm: of a simulated skin, whose pitch is known; else None."""

    limit: ContactLimit
    centres: ContactCentres | None
    pitch_mm: float | None

    @classmethod
    def of(cls, sweeps: Dataset) -> Contacts:
        limit = find_limit(sweeps)
        simulated = all(part.startswith("sim:") for part in sweeps.source.split(" + "))
        return cls(limit, find_centres(sweeps, limit), skin.PITCH_MM if simulated else None)

    def positions(self, pitch_mm: float | None) -> ContactPositions | None:
        """The contact positions in mm; None if the pitch or the centres are unknown."""
        pitch_mm = self.pitch_mm if pitch_mm is None else pitch_mm
        return self.centres.in_mm(pitch_mm) if self.centres and pitch_mm is not None else None

    def arrays(self) -> dict[str, Array]:
        """The arrays that the file of a fit keeps."""
        return {"tare": self.limit.tare} | (
            {"centres": self.centres.centres} if self.centres else {}
        )

    def figures(self) -> dict[str, Any]:
        """The numbers that the file of a fit keeps, for JSON."""
        return {
            "contact": self.limit.contact,
            "why": self.limit.why,
            "limit": self.centres.limit if self.centres else None,
            "pitch_mm": self.pitch_mm,
        }

    @classmethod
    def read(cls, arrays: Mapping[str, Array], figures: dict[str, Any]) -> Contacts:
        """The Contacts that gave `arrays` and `figures`."""
        limit = ContactLimit(figures["contact"], arrays["tare"], figures["why"])
        centres = None
        if figures["limit"] is not None:
            centres = ContactCentres(arrays["centres"], figures["limit"])
        return cls(limit, centres, figures["pitch_mm"])


def find_limit(sweeps: Dataset) -> ContactLimit:
    """The limit for `sweeps`: SHARE of the weakest contact, measured by the mean of the strongest
    taxel on the normal axis."""
    means = sweeps.samples.mean(axis=1, dtype=np.float64)
    if sweeps.unloaded is not None:
        known = np.isfinite(sweeps.unloaded).all(axis=tuple(range(1, sweeps.unloaded.ndim)))
        if known.any():
            return _limit_above_unloaded(means[known], sweeps.unloaded[known], sweeps.samples.dtype)
    return _limit_of_raw_counts(means)


def _limit_above_unloaded(means: Array, unloaded: Array, counts: np.dtype[Any]) -> ContactLimit:
    """The limit from means [n, R, C] or [n, R, C, A] of sweeps, and mean and deviation of the
    unloaded skin beside them, [n, 2, R, C] or [n, 2, R, C, A].

    The box starts from one tare for all recordings. The limit is therefore above the drift between
    recordings, too.
    """
    tare = np.median(unloaded[:, 0], axis=0)
    weakest = normal(means - tare, 1).max(axis=(1, 2)).min()
    drift = normal(np.abs(unloaded[:, 0] - tare), 1).max(axis=(1, 2))
    noise = [UnloadedSkin.of(mean, deviation, counts).contact for mean, deviation in unloaded]
    least = float((drift + noise).max())
    if weakest <= least:
        return ContactLimit(
            None,
            0 * tare,
            f"the weakest sweep reads {weakest:.6g} counts above the unloaded skin, which itself "
            f"differs by up to {least:.6g}; send TARE with the finger lifted before each series "
            "that palpate record takes, and press more",
        )
    return ContactLimit(max(SHARE * float(weakest), least), tare)


def _limit_of_raw_counts(means: Array) -> ContactLimit:
    """The limit from means [n, R, C] or [n, R, C, A] of sweeps, if the unloaded skin is unknown."""
    tare, means = np.zeros(means.shape[1:]), normal(means, 1)
    lowest, highest = float(means.min()), float(means.max())
    if means[0].size > 1 and 0 < BASELINE * highest <= lowest:
        return ContactLimit(
            None,
            tare,
            f"no taxel reads less than {lowest:.6g} counts in any sweep, none more than "
            f"{highest:.6g}, and what the unloaded skin gives is not known; record with palpate "
            "record, and send TARE with the finger lifted",
        )
    weakest = float(means.max(axis=(1, 2)).min())
    if weakest < 0:  # of a tared skin that was pulled, or of a sensor without a level
        return ContactLimit(
            None,
            tare,
            f"the weakest sweep reads {weakest:.6g} counts, below 0; record with palpate record, "
            "and send TARE with the finger lifted",
        )
    return ContactLimit(SHARE * weakest, tare)


def find_centres(sweeps: Dataset, limit: ContactLimit) -> ContactCentres | None:
    """The centre of contact at each position of `sweeps`, or in each recording if positions are
    unknown; None without a limit or a contact. Loads are those of a box that was not tared.

    The limit of the distance keeps tolerances.KEPT of positions whose own sweeps were left out,
    judged by their farthest sweep, as embedding.limit computes it: all of a few positions.
    """
    if limit.contact is None:
        return None
    found = [centre(window, limit.tare, limit.contact) for window in sweeps.samples]
    touched = np.array([point is not None for point in found])
    if not touched.any():
        return None
    points = np.array([point for point in found if point])
    position = sweeps.groups.get("position", sweeps.group("recording"))[touched]
    member = np.unique(position, return_inverse=True)[1]
    centres = np.stack([points[member == p].mean(axis=0) for p in range(member.max() + 1)])
    reach = embedding.limit(farthest(points, member, centres)) if len(centres) > 1 else 0.0
    some = evenly(len(centres), MOST_POSITIONS)
    return ContactCentres(centres[some], max(MIN_LIMIT, reach))


def farthest(points: Array, member: Array, centres: Array) -> Array:
    """For each position [P] the distance of its farthest sweep from the nearest other position.

    points: [N, 2]; member: the position [N] of each; centres: [P, 2] of the positions.
    """
    distances = np.zeros(len(centres))
    for number in range(len(centres)):
        others = np.delete(centres, number, axis=0)
        nearest = np.linalg.norm(points[member == number][:, None] - others, axis=2).min(axis=1)
        distances[number] = nearest.max()
    return distances
