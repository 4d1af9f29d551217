"""Contacts of a training set: the load that counts as contact, and the positions of the contacts.

The box uses both. A window without a load above the limit is `no-contact`, and a contact far from
all trained positions is displaced. If the recordings contain the unloaded skin, a load is the
difference from it. Otherwise raw counts are taken as loads, if they can be.

A skin that was put back elsewhere changes the features of a known material more than another
material would. If the contact is displaced, distances are therefore measured relative to the
scatter of augmented copies of the training sweeps, and certainty is limited by the accuracy on
copies of held-out sweeps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.contact import (
    MOST_POSITIONS,
    ContactPositions,
    DisplacementRule,
    centre,
    displacement,
)
from palpate.answer.objects import softmax
from palpate.answer.unknown import Classes, DisplacedClasses
from palpate.answer.unloaded import SHARE, UnloadedSkin
from palpate.bundle.contents import Bundle
from palpate.bundle.manifest import Manifest
from palpate.core.types import normal
from palpate.sim import skin
from palpate_train.answer import embedding
from palpate_train.answer.embedding import Embedding, embed, limit
from palpate_train.answer.rule import Rule
from palpate_train.data.augment import Augmentation, augment
from palpate_train.data.sets import Dataset, evenly
from palpate_train.metrics import tolerances
from palpate_train.metrics.temperature import sufficient_temperature

Array = NDArray[Any]
BASELINE = 0.5
"""Raw counts are not taken as loads if every taxel in every sweep reads more than this share of the
highest reading: some taxels are hardly touched, and some contacts are stronger than others."""
MIN_LIMIT = 1 / 8
"""Smallest limit of the displacement, in taxels: attaching the skin again in the same place moves
the centre by this much (0.5 mm of 4 mm include over 95 % of the simulated attachments), even if few
or equal positions suggest less."""
MOST_WRONG = 0.0125
"""Share of held-out copies that may get a wrong label with status ok. Heads that were fitted to
copies name copies better than sweeps of a skin that was really displaced: with .0125 a fit for a
reattached skin gives 4 % of sim:T-HARD:201-236:2 a wrong label."""
UNSURE = np.arange(50, 100) / 100
"""Candidates for the least probability with which a displaced sweep is ok."""
NEVER = 1.01
"""A least probability that no sweep reaches."""


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


Centres = tuple[Array, float]
"""Centres of contact in training, in taxels [P, 2], row and column; and the distance from the
nearest centre up to which a contact is in place."""


@dataclass(frozen=True, slots=True)
class Contacts:
    """The limit and the centres of a training set; centres: None without a limit or a contact.
    pitch_mm: of a simulated skin, whose pitch is known; else None."""

    limit: ContactLimit
    centres: Centres | None
    pitch_mm: float | None

    @classmethod
    def of(cls, sweeps: Dataset) -> Contacts:
        limit = find_limit(sweeps)
        simulated = all(part.startswith("sim:") for part in sweeps.source.split(" + "))
        return cls(limit, find_centres(sweeps, limit), skin.PITCH_MM if simulated else None)

    def positions(self, pitch_mm: float | None) -> ContactPositions | None:
        """The contact positions in mm; None if the pitch or the centres are unknown."""
        pitch_mm = self.pitch_mm if pitch_mm is None else pitch_mm
        if self.centres is None or pitch_mm is None:
            return None
        rows, cols = (self.centres[0] * pitch_mm).round(3).T.tolist()
        limit_mm = round(pitch_mm * self.centres[1], 3)
        return ContactPositions(float(pitch_mm), tuple(rows), tuple(cols), limit_mm)

    def arrays(self) -> dict[str, Array]:
        """The arrays that the file of a fit keeps."""
        return {"tare": self.limit.tare} | ({"centres": self.centres[0]} if self.centres else {})

    def figures(self) -> dict[str, Any]:
        """The numbers that the file of a fit keeps, for JSON."""
        return {
            "contact": self.limit.contact,
            "why": self.limit.why,
            "limit": self.centres[1] if self.centres else None,
            "pitch_mm": self.pitch_mm,
        }

    @classmethod
    def read(cls, arrays: Mapping[str, Array], figures: dict[str, Any]) -> Contacts:
        """The Contacts that gave `arrays` and `figures`."""
        limit = ContactLimit(figures["contact"], arrays["tare"], figures["why"])
        reach = figures["limit"]
        centres = None if reach is None else (arrays["centres"], reach)
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
    unloaded skin for each, [n, 2, R, C] or [n, 2, R, C, A].

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


def find_centres(sweeps: Dataset, limit: ContactLimit) -> Centres | None:
    """The centre of contact at each position of `sweeps`, or in each recording if positions are
    unknown; None without a limit or a contact. Loads are computed as on a box that was not tared.

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
    return centres[evenly(len(centres), MOST_POSITIONS)], max(MIN_LIMIT, reach)


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


@dataclass(frozen=True, eq=False)
class AugmentedCopies:
    """Augmented copies of sweeps: features [M, F], labels [M], source [M], the number of the sweep
    of each.

    The head that gives the label learns from them how materials vary. The embedding does not see
    them, because an unknown material would then lie among the known ones. held: bool [M], copies of
    sweeps that the trunk did not see; heads are judged by them and not fitted to them.
    """

    features: Array
    labels: Array
    source: Array
    held: Array

    def take(self, index: Array) -> AugmentedCopies:
        """The copies that `index` (bool [M]) selects."""
        return AugmentedCopies(
            self.features[index], self.labels[index], self.source[index], self.held[index]
        )


@dataclass(frozen=True)
class DisplacementFit:
    """embedding: of embeddings z, fitted to embeddings of copies. rule: for the manifest."""

    embedding: Embedding
    rule: DisplacementRule

    def classes(self, classes: Classes) -> Classes:
        """`classes` of the embedding z, with the classes of displaced contacts."""
        of = self.embedding
        shown = DisplacedClasses(of.projection, of.means - of.offset, of.shapes)
        return replace(classes, displaced=shown)


def fit(
    whole: Array,
    labels: Array,
    groups: Array,
    held: Array,
    embedded: Callable[[Array, Array], Embedding],
    copied: AugmentedCopies,
    logits: Array,
    kept: float = tolerances.KEPT,
) -> DisplacementFit | None:
    """The rule for displaced sweeps; None without copies to fit it to and to judge it by.

    whole, labels, groups, held: features [N, F], int [N], int [N] and bool [N] as in
    CalibrationInputs. embedded: embeds features with their labels. logits: [m, K] of the held-out
    copies, calibrated for contacts that are in place, by a head that saw none of their groups.
    kept: share of the held-out copies within the limit of known materials.
    """
    fitted, judging = copied.take(~copied.held), copied.take(copied.held)
    if (
        not len(judging.labels)
        or min(len(np.unique(of)) for of in (fitted.labels, labels[~held])) <= labels.max()
    ):
        return None

    def turn(by: Array) -> tuple[Embedding, Embedding]:
        """An embedding of the sweeps `by` (bool [N]), and an embedding of the copies after the
        first."""
        z = embedded(whole[by], labels[by])
        kept = max(z.shapes.shape[1], len(z.offset) - len(z.means) + 1)  # no direction is lost
        return z, embed(z(fitted.features), fitted.labels, kept)

    across, judge = turn(~held)
    novelty = judge.novelty(across(judging.features))
    beyond = limit(novelty, kept)
    # a displaced sweep is never surer than one in place
    temperature = max(sufficient_temperature(logits, judging.labels, groups[judging.source]), 1.0)
    p = softmax(logits / temperature)
    wrong = (p.argmax(1) != judging.labels) & (novelty <= beyond)
    enough = [
        float(level) for level in UNSURE if np.mean(wrong & (p.max(1) >= level)) <= MOST_WRONG
    ]
    return DisplacementFit(
        turn(np.ones(len(labels), bool))[1],
        DisplacementRule(beyond, temperature, enough[0] if enough else NEVER),
    )


def limited(manifest: Manifest, train: Dataset, seed: int = 0) -> Manifest:
    """`manifest` with the largest displacement in copies of `train`, which are displaced as far as
    the copies that the model was trained with; unchanged if it has no rule for displaced sweeps,
    or if its taxels stand in one column, which training does not displace.

    A skin that was put back has other gains, which shift the measured place as well. Among trained
    positions this error is `limit_mm` at most, which is added.
    """
    rule, place, contact = manifest.displacement, manifest.contact, manifest.thresholds.contact
    if rule is None or place is None or contact is None or train.format.cols < 2:
        return manifest
    rng, shift = np.random.default_rng(seed), _shift(manifest.made)
    some = train.take(rng.permutation(len(train))[: tolerances.COPIES])
    loads = some.samples.mean(axis=1, dtype=np.float64) - manifest.tare
    still = dict.fromkeys(vars(Augmentation()), 0.0)
    only_moved = Augmentation(**still | {"shift": shift, "displaced": 1.0})
    moved = augment(
        loads.reshape(len(some), -1, 1).astype(np.float32), train.format.rows, only_moved, rng
    )
    means = moved.reshape(loads.shape) + manifest.tare
    mm = [displacement(mean, manifest.tare, contact, place).mm for mean in means]
    farthest = float(np.quantile(mm, tolerances.KEPT_COPIES)) + place.limit_mm
    return replace(manifest, displacement=replace(rule, farthest_mm=round(farthest, 3)))


def _shift(made: Mapping[str, Any]) -> float:
    """Largest displacement of training copies in rows."""
    used = made.get("recipe", {}).get("augmentation", {})
    return float(used.get("shift", Augmentation().shift))


def text(manifest: Manifest) -> str:
    """Up to which displacement a sweep is classified, in words; "" without a rule."""
    rule = manifest.displacement
    if rule is None:
        return ""
    if rule.farthest_mm is None:
        return "displaced contacts: named at any distance"
    return f"displaced contacts: named up to {rule.farthest_mm:.1f} mm"


def without(bundle: Bundle) -> Bundle:
    """The bundle that judges displaced contacts as it judges others."""
    classes = bundle.classes and replace(bundle.classes, displaced=None)
    return replace(bundle, manifest=replace(bundle.manifest, displacement=None), classes=classes)


RULES = {"displacement": Rule("a rule for displaced contacts", without, limited=limited)}
