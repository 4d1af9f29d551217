"""Sweeps with a displaced contact: their distances from known materials, and the rule for them.

A skin that was put back elsewhere changes the features of a known material more than another
material would. If the contact is displaced, distances are therefore measured relative to the
scatter of augmented copies of the training sweeps, and certainty is limited by the accuracy on
copies of held-out sweeps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate.answer.unknown import Classes, DisplacedClasses, DisplacementRule
from palpate_train.calibration.novelty import Embedding, embed, limit
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


def fit_displacement(
    whole: Array,
    labels: Array,
    groups: Array,
    held: Array,
    fixed: int,
    copied: AugmentedCopies,
    logits: Array,
) -> DisplacementFit | None:
    """The rule for displaced sweeps; None without copies to fit it to and to judge it by.

    whole, labels, groups, held: features [N, F], int [N], int [N] and bool [N] as in
    CalibrationInputs. logits: [m, K] of the held-out copies, calibrated for contacts that are in
    place, by a head that saw none of their groups.
    """
    fitted, judging = copied.take(~copied.held), copied.take(copied.held)
    if (
        not len(judging.labels)
        or min(len(np.unique(of)) for of in (fitted.labels, labels[~held])) <= labels.max()
    ):
        return None

    def turn(fit: Array) -> tuple[Embedding, Embedding]:
        """An embedding of the sweeps `fit` (bool [N]), and an embedding of the copies after the
        first."""
        z = embed(whole[fit], labels[fit], fixed)
        return z, embed(z(fitted.features), fitted.labels, z.shapes.shape[1])

    across, judge = turn(~held)
    novelty = judge.novelty(across(judging.features))
    beyond = limit(novelty)
    temperature = sufficient_temperature(logits, judging.labels, groups[judging.source])
    p = softmax(logits / temperature)
    wrong = (p.argmax(1) != judging.labels) & (novelty <= beyond)
    enough = [
        float(level) for level in UNSURE if np.mean(wrong & (p.max(1) >= level)) <= MOST_WRONG
    ]
    return DisplacementFit(
        turn(np.ones(len(labels), bool))[1],
        DisplacementRule(beyond, temperature, enough[0] if enough else NEVER),
    )
