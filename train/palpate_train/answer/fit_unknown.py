"""How alterations of a sweep move the embedding, and how much they count in its distances.

Hum, noise, another gain or speed move the embedding of a known material further than the limit of
known materials. They move it in a few directions, and another way for each material. The scatter of
altered copies is therefore added to the scatter of each material, with a weight for each kind of
alteration. The weights keep as many held-out copies as possible, and refuse as many sweeps of
materials that are left out. Directions that no alteration reaches count as before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.unknown import shaped_distances
from palpate.bundle.contents import Bundle
from palpate.bundle.manifest import MEANS
from palpate_train.answer.embedding import (
    Embedding,
    auroc,
    differing,
    limit,
    own_scatter,
    shapes_of,
    within,
)
from palpate_train.answer.rule import Rule
from palpate_train.data.sets import evenly
from palpate_train.metrics.tolerances import LEFT_OUT

Array = NDArray[Any]
Embed = Callable[[Array], Array]
"""Features [n, F], or raw counts [n, T, R, C] -> embeddings [n, r]."""
WEIGHTS = (0.0, 0.3, 1.0, 3.0)
"""Weights of the scatter of a kind of alteration, before it is divided by the number of kinds.
Larger weights let some materials pass that the model does not have: with 30, 72 % of plastic
smooth, with 3, 22 %. Sweeps of known materials cannot show that (docs/decisions/0005)."""
OWN = 0.5
"""Share of a material's own copies in its scatter; the rest is that of the copies of all
materials."""
ROUNDS = 3
"""Largest number of rounds over all kinds in the search of weights."""
FEWEST_JUDGED = 8
"""Least number of judged sweeps of each material, below which the weights would follow chance."""
TRAINED = (0.1, 0.3, 1.0, 3.0)
"""Weights of the directions in which the trained materials differ, against 1 for the features that
were not trained. Which of the two shows an unknown material depends on the skin."""


@dataclass(frozen=True, eq=False)
class DisturbedSweeps:
    """Embeddings of sweeps and of altered copies of some of them.

    z: [N, r], labels: int [N]. copies: by kind of alteration, the embeddings [M, r] of copies and
    the numbers [M] of their sweeps, with rising severity. disturbed: by kind, sizes of the
    disturbance that it makes, of the copies [M] and of the sweeps [N].
    """

    z: Array
    labels: Array
    copies: Mapping[str, tuple[Array, Array]]
    disturbed: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    def seen_by(self, embed: Embed) -> DisturbedSweeps:
        """The same in another embedding: of each row."""
        copies = {kind: (embed(z), source) for kind, (z, source) in self.copies.items()}
        return DisturbedSweeps(embed(self.z), self.labels, copies, self.disturbed)

    def take(self, kept: Array, labels: Array) -> DisturbedSweeps:
        """The sweeps `kept` (bool [N]) of these labels (ascending), and their copies; a label
        becomes its number among `labels`."""
        kept = kept & np.isin(self.labels, labels)
        number, copies = np.cumsum(kept) - 1, {}
        for kind, (z, source) in self.copies.items():
            copies[kind] = z[kept[source]], number[source[kept[source]]]
        numbered = np.searchsorted(labels, self.labels[kept])
        return DisturbedSweeps(self.z[kept], numbered, copies)


@dataclass(frozen=True, eq=False)
class Scatters:
    """Scatter of each material in an embedding. means: [K, r]. untrained: see Embedding. own:
    covariances [K, r, r] of its sweeps around its mean. by_kind: second moments [K, r, r] of the
    changes by each kind of alteration."""

    means: Array
    untrained: Array
    own: Array
    by_kind: Mapping[str, Array]

    @classmethod
    def of(cls, altered: DisturbedSweeps, embedding: Embedding) -> Scatters:
        """The scatter of sweeps in this embedding."""
        means = embedding.means.astype(np.float64)
        away = altered.z - means[altered.labels]
        own = [own_scatter(away[altered.labels == k]) for k in range(len(means))]
        kinds = {}
        for kind, (z, source) in altered.copies.items():
            change, labels = z - altered.z[source], altered.labels[source]
            every = _moment(change)
            each = [_moment(change[labels == k], every) for k in range(len(means))]
            kinds[kind] = OWN * np.stack(each) + (1 - OWN) * every
        return cls(means, embedding.untrained, np.stack(own), kinds)

    def shapes(self, weights: Mapping[str, float], trained: float) -> Array:
        """W [K, r, r], so that |away @ W|^2 is the squared distance of a difference `away`: that in
        the features that were not trained, and `trained` times that in the trained directions."""
        added = sum(weights[kind] * scatter for kind, scatter in self.by_kind.items())
        covariances = self.own + added / max(len(self.by_kind), 1)
        squares = within(covariances, self.untrained)
        squares += trained * within(covariances, differing(self.means))
        return shapes_of(squares)

    def without(self, k: int) -> Scatters:
        """The scatter of the other materials than `k`."""
        means, own = (np.delete(of, k, axis=0) for of in (self.means, self.own))
        kinds = {kind: np.delete(of, k, axis=0) for kind, of in self.by_kind.items()}
        return Scatters(means, self.untrained, own, kinds)

    def weight_of_trained(self, judged: DisturbedSweeps) -> float:
        """The one of TRAINED that tells `judged` sweeps of materials that are left out in turn best
        from the others (mean AUROC)."""
        k, areas = len(self.own), []
        away = judged.z[:, None] - self.means
        untrained = shaped_distances(away, shapes_of(within(self.own, self.untrained)))
        for number in np.unique(evenly(k, LEFT_OUT)):
            others, unknown = np.delete(np.arange(k), number), judged.labels == number
            shapes = shapes_of(within(self.own[others], differing(self.means[others])))
            trained = shaped_distances(away[:, others], shapes)
            near = [(untrained[:, others] + w * trained).min(axis=1) for w in TRAINED]
            areas.append([auroc(d[~unknown], d[unknown]) for d in near])
        return TRAINED[int(np.mean(areas, axis=0).argmax())]


@dataclass(frozen=True)
class ShapeRule:
    """Weights of the kinds of alterations, and of the trained directions.

    scale: of the shapes, so that a held-out sweep lies r from its mean on average, as it does
    without shapes. limit: largest squared distance of a known material. kept: by kind, the shares
    of held-out copies within the limit, without weights and with them. passed: the shares of
    held-out sweeps within the limit if their material is left out, likewise.
    """

    weights: Mapping[str, float]
    trained: float
    scale: float
    limit: float
    kept: Mapping[str, tuple[float, float]]
    passed: tuple[float, float]

    def shapes(self, scatters: Scatters) -> NDArray[np.float16]:
        """The matrices [K, r, r] for a bundle."""
        return (self.scale * scatters.shapes(self.weights, self.trained)).astype(np.float16)


def choose(scatters: Scatters, judged: DisturbedSweeps) -> ShapeRule | None:
    """The rule with the largest sum of the share of judged copies that are kept and the share of
    judged sweeps that are refused if their material is left out.

    judged: sweeps that `scatters` and the class means have not seen. None if they are too few.
    """
    means = scatters.means
    each = np.bincount(judged.labels, minlength=len(means))
    if each.min() < FEWEST_JUDGED or not judged.copies:
        return None
    trial = _Trial(scatters, judged, scatters.weight_of_trained(judged))
    none = dict.fromkeys(scatters.by_kind, 0.0)
    before = trial.shares(none)
    weights = _search(trial, dict.fromkeys(scatters.by_kind, 1.0))
    if (after := trial.shares(weights)).worth <= before.worth:
        weights, after = none, before
    shapes = scatters.shapes(weights, trial.trained)
    own = trial.distances(judged.z, shapes)[np.arange(len(judged.z)), judged.labels]
    scale = float(np.sqrt(means.shape[1] / own.mean()))
    rounded = (scale * shapes).astype(np.float16).astype(np.float64)
    beyond = limit(trial.distances(judged.z, rounded).min(axis=1))
    kept = {kind: (share, after.kept[kind]) for kind, share in before.kept.items()}
    return ShapeRule(weights, trial.trained, scale, beyond, kept, (before.passed, after.passed))


def _search(trial: _Trial, weights: dict[str, float]) -> dict[str, float]:
    """The best weights by coordinate ascent, one kind after another."""
    best = trial.shares(weights).worth
    for _ in range(ROUNDS):
        before = best
        for kind in weights:
            for weight in WEIGHTS:
                if (worth := trial.shares(weights | {kind: weight}).worth) > best:
                    best, weights = worth, weights | {kind: weight}
        if best == before:
            break
    return weights


@dataclass(frozen=True)
class _Shares:
    """kept: share of copies within the limit, by kind. passed: see ShapeRule."""

    kept: Mapping[str, float]
    passed: float

    @property
    def worth(self) -> float:
        return float(np.mean(list(self.kept.values()))) - self.passed


@dataclass(frozen=True)
class _Trial:
    """Judges weights by sweeps and copies that the scatters have not seen."""

    scatters: Scatters
    judged: DisturbedSweeps
    trained: float

    def distances(self, z: Array, shapes: Array) -> Array:
        """Squared distances [n, K] of embeddings z [n, r]."""
        return shaped_distances(z[:, None] - self.scatters.means, shapes)

    def shares(self, weights: Mapping[str, float]) -> _Shares:
        shapes, labels = self.scatters.shapes(weights, self.trained), self.judged.labels
        distances = self.distances(self.judged.z, shapes)
        beyond = limit(distances.min(axis=1))
        kept = {
            kind: float(np.mean(self.distances(z, shapes).min(axis=1) <= beyond))
            for kind, (z, _) in self.judged.copies.items()
        }
        distances[np.arange(len(labels)), labels] = np.inf
        near = distances.min(axis=1) <= beyond
        passed = [near[labels == k].mean() for k in range(distances.shape[1])]
        return _Shares(kept, float(np.mean(passed)))


def _moment(change: Array, otherwise: Array | None = None) -> Array:
    """The second moment [r, r] of changes [n, r]; `otherwise` of none."""
    if not len(change) and otherwise is not None:
        return otherwise
    moment: Array = change.T @ change / max(len(change), 1)
    return moment


def without(bundle: Bundle) -> Bundle:
    """The bundle that calls no material unknown. Early answers, disturbances and displaced contacts
    are judged by the same distances, so their rules lose theirs."""
    m = bundle.manifest
    if m.known is None:
        return bundle
    manifest = replace(
        m,
        files={name: entry for name, entry in m.files.items() if name != MEANS},
        known=None,
        displacement=None,
        disturbances=m.disturbances and replace(m.disturbances, allowances=()),
        early=m.early and replace(m.early, limits=()),
    )
    return replace(bundle, manifest=manifest, classes=None)


RULES = {"unknown": Rule("detection of unknown materials", without, tried=False)}
