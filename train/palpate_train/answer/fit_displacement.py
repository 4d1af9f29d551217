"""Sweeps with a displaced contact: their distances from known materials, and the rule for them.

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

from palpate.answer.contact import displacement
from palpate.answer.displacement import DisplacementRule
from palpate.answer.objects import softmax
from palpate.answer.unknown import Classes, DisplacedClasses
from palpate.bundle.contents import Bundle
from palpate.bundle.manifest import Manifest
from palpate_train.answer.embedding import Embedding, embed, limit
from palpate_train.answer.rule import Rule
from palpate_train.data.augment import Augmentation, augment
from palpate_train.data.sets import Dataset
from palpate_train.metrics import tolerances
from palpate_train.metrics.temperature import sufficient_temperature

Array = NDArray[Any]
MOST_WRONG = 0.0125
"""Share of held-out copies that may get a wrong label with status ok. Heads that were fitted to
copies name copies better than sweeps of a skin that was really displaced: with .0125 a fit for a
reattached skin gives 4 % of sim:T-HARD:201-236:2 a wrong label."""
UNSURE = np.arange(50, 100) / 100
"""Candidates for the least probability with which a displaced sweep is ok."""
NEVER = 1.01
"""A least probability that no sweep reaches."""


@dataclass(frozen=True, eq=False)
class AugmentedCopies:
    """Augmented copies of sweeps: features [M, F], labels [M], source [M], the number of the sweep
    of each.

    The head that names the material learns from them how materials vary. The embedding does not see
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
    """embedding: of embeddings z, fitted to those of augmented copies. rule: for the manifest."""

    embedding: Embedding
    rule: DisplacementRule

    def classes(self, classes: Classes) -> Classes:
        """`classes` of the embedding z, with those of displaced contacts."""
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
        return z, embed(z(fitted.features), fitted.labels, z.shapes.shape[1])

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
    those that the model was trained with; unchanged if it has no rule for displaced sweeps, or if
    its taxels stand in one column, which training does not displace.

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
    """Up to which displacement a material is named, in words; "" without a rule."""
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
