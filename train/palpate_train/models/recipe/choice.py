"""The choice of heads by held-out groups of the training sweeps.

Candidates differ in the filters and their features, in the spectrum, in the loads of taxels, and in
whether heads see augmented copies. Each is scored by the cross entropy of sweeps whose group its
heads did not see, at its best temperature; every group counts the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate_train.answer.heads import ABSENT, HeadData, HeadPart, HeadPlan
from palpate_train.data.splitters import InnerPart
from palpate_train.metrics.temperature import weighted_platt_temperature
from palpate_train.models.methods import Log
from palpate_train.models.recipe import relations
from palpate_train.models.recipe.bank import LEAST_FILTERS
from palpate_train.models.recipe.paired import ERRORS, TINY, PairedDifference
from palpate_train.models.recipe.sizes import ModelSize

Array = NDArray[Any]
ENOUGH = 0.99
"""Accuracy on held-out parts from which on copies and stages improve too little for their share of
a fit's time, and stages for that of the bundle."""
MANY = 100
"""Number of held-out sweeps from which on they show what makes a sum worse. Fewer may show nothing
of that: there relations, which a dozen sweeps ask for too seldom, join, and slow waves have to
gain."""
Columns = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class ScoredPlan:
    """A candidate with its scores. logits: [n, K] of the held-out sweeps at the best temperature.
    losses: cross entropy [n] of each."""

    plan: HeadPlan
    logits: Array
    losses: Array


class HeldOutScores:
    """Scores candidates on held-out parts.

    known: the data that heads are fitted to, for each part the same sweeps in the same order; their
    features may differ, if a trunk was trained without the part. copied: score augmented copies of
    the held-out sweeps as well, which then count as much as these. labels, clusters: of everything
    that is scored [n]; a cluster is the number of a part. groups: text [n], left out by the
    part. own: bool [n], True for a sweep and False for a copy.
    """

    def __init__(
        self,
        known: Sequence[HeadData],
        parts: Sequence[InnerPart],
        classes: int,
        copied: bool = False,
    ) -> None:
        self._known, self._parts, self._classes = known, parts, classes
        of, labels = known[0].source, known[0].labels
        self._copies = [part.out[of] & copied for part in parts]
        numbers = range(len(parts))
        self.labels = np.concatenate(
            [np.append(labels[parts[i].out], labels[of][self._copies[i]]) for i in numbers]
        )
        sizes = [(int(parts[i].out.sum()), int(self._copies[i].sum())) for i in numbers]
        self.own = np.concatenate([np.repeat([True, False], pair) for pair in sizes])
        self.clusters = np.repeat(numbers, [sum(pair) for pair in sizes])
        self.groups = np.array([part.group for part in parts])[self.clusters]
        kind = self.groups + np.where(self.own, "", "\n")
        _, member, counts = np.unique(kind, return_inverse=True, return_counts=True)
        self.weights = 1 / counts[member] / len(counts)
        self._logits: dict[tuple[Columns, bool], Array] = {}
        self._scales: dict[tuple[Columns, bool], float] = {}

    def score(self, parts: Sequence[HeadPart]) -> ScoredPlan:
        """The candidate that adds the logits of `parts`, each scaled by its weight; their own
        factors are ignored.

        Scaled to the same size, a discriminant that is mostly wrong would outvote others. At its
        best temperature each would count by how sure held-out sweeps let it be, but that says too
        little of conditions that training lacks. The scale is the geometric mean of both.
        """
        logits = [self._of(part) for part in parts]
        factors = [
            part.weight / self._scale(part, x) for part, x in zip(parts, logits, strict=True)
        ]
        total = np.sum([x * f for x, f in zip(logits, factors, strict=True)], axis=0)
        temperature = weighted_platt_temperature(total, self.labels, self.weights)
        plan = HeadPlan(
            tuple(replace(p, factor=f / temperature) for p, f in zip(parts, factors, strict=True))
        )
        return ScoredPlan(plan, total / temperature, self._losses(total / temperature))

    def loss(self, scored: ScoredPlan) -> float:
        """Mean cross entropy; every group counts the same."""
        return float(self.weights @ scored.losses)

    def accuracy(self, scored: ScoredPlan) -> float:
        """Accuracy on held-out sweeps; every group counts the same."""
        return float(self.weights @ self.right(scored))

    def wrong(self, scored: ScoredPlan) -> int:
        """Number of held-out sweeps that it classifies wrongly."""
        return int((~self.right(scored))[self.own].sum())

    def paired(self, one: ScoredPlan, other: ScoredPlan) -> PairedDifference:
        """How `one` differs from `other`."""
        won = self.weights * (self.right(one).astype(float) - self.right(other))
        saved = self.weights * (other.losses - one.losses)
        members = [self.groups == name for name in np.unique(self.groups)]
        return PairedDifference(
            won, saved, self.clusters, [(of, self.weights[of]) for of in members]
        )

    def right(self, scored: ScoredPlan) -> Array:
        """bool [n], the sweeps that it classifies correctly."""
        right: Array = scored.logits.argmax(axis=1) == self.labels
        return right

    def _losses(self, logits: Array) -> Array:
        losses: Array = -np.log(
            np.maximum(softmax(logits)[np.arange(len(logits)), self.labels], TINY)
        )
        return losses

    def _scale(self, part: HeadPart, logits: Array) -> float:
        """The geometric mean of the size of these logits [n, K] and of their best temperature. A
        material that a part has no other sweeps of counts for nothing."""
        key = part.columns, part.copies
        if key not in self._scales:
            x = np.where(logits == ABSENT, np.nan, logits)
            size = float(np.nanmean(np.abs(x - np.nanmean(x, axis=1, keepdims=True))))
            temperature = weighted_platt_temperature(logits, self.labels, self.weights)
            self._scales[key] = float(np.sqrt(max(size, TINY) * temperature))
        return self._scales[key]

    def _of(self, part: HeadPart) -> Array:
        """Logits [n, K] of one discriminant for the held-out sweeps."""
        key = part.columns, part.copies
        if key not in self._logits:
            self._logits[key] = np.concatenate(
                [self._tested(part, i) for i in range(len(self._parts))]
            )
        return self._logits[key]

    def _tested(self, part: HeadPart, number: int) -> Array:
        known, out = self._known[number], self._parts[number].out
        weight, bias = replace(part, factor=1.0).fit(known.take(~out), self._classes)
        tested = known.features[out]
        if (copies := self._copies[number]).any():
            tested = np.concatenate([tested, known.copied[copies]])
        return tested @ weight.T + bias


@dataclass(frozen=True, eq=False)
class FeatureColumns:
    """Numbers of the features of a trunk, by their source.

    magnitudes, shares: int [n], the two features of each filter. kinds: the filters of each kind,
    zero-sum ones first. levels, loads, relations, slow, bands: of the distribution, the loads, the
    relations [scales, n], the slow waves and the spectrum; may be empty.
    """

    magnitudes: Array
    shares: Array
    kinds: tuple[Array, ...]
    levels: Array
    loads: Array
    relations: Array
    slow: Array
    bands: Array

    @classmethod
    def of(cls, layout: Mapping[str, slice], free: Array, scales: int) -> FeatureColumns:
        """The columns of a trunk with this graph.layout. free: bool [n], of its filters. scales:
        number of scales of its relations."""
        magnitudes, shares, levels, loads, relations, slow, bands = (
            np.arange(layout[name].start, layout[name].stop) if name in layout else np.empty(0, int)
            for name in ("magnitudes", "shares", "levels", "loads", "relations", "slow", "bands")
        )
        kinds = tuple(np.flatnonzero(free == kind) for kind in np.unique(free))
        by_scale = relations.reshape(max(scales, 1), -1)
        return cls(magnitudes, shares, kinds, levels, loads, by_scale, slow, bands)

    def limited(self, size: ModelSize) -> FeatureColumns:
        """Only the features that a model of this size may see; of many filters evenly spaced
        ones."""
        kept = [
            kind[np.linspace(0, len(kind) - 1, min(len(kind), size.filters)).astype(int)]
            if size.filters is not None
            else kind
            for kind in self.kinds
        ]
        numbers = np.sort(np.concatenate([np.empty(0, int), *kept]))
        return replace(
            self,
            magnitudes=self.magnitudes[numbers],
            shares=self.shares[numbers],
            kinds=tuple(np.searchsorted(numbers, kind) for kind in kept if len(kind)),
            levels=self.levels if size.distribution else self.levels[:0],
            relations=self.relations[: size.scales],
            slow=self.slow if size.slow else self.slow[:0],
        )

    def filters(self) -> Array:
        """The filter [F] of each feature, -1 if it is not of a filter."""
        views = (self.levels, self.loads, self.relations, self.slow, self.bands)
        every = (self.magnitudes, self.shares, *views)
        filters = np.full(1 + max(int(part.max(initial=-1)) for part in every), -1)
        for part in (self.magnitudes, self.shares):
            filters[part] = np.arange(len(part))
        return filters


Heads = tuple[HeadPart, ...]


@dataclass(frozen=True)
class Candidates:
    """The heads to choose from. copies: whether all discriminants see augmented copies at first,
    because the skin will be put back. loads: whether held-out groups can show what loads are good
    for; the level of one session shows its materials.

    Sweeps are too few to distinguish more candidates than these.
    """

    columns: FeatureColumns
    copies: bool = False
    loads: bool = False

    def usual(self) -> Heads:
        """The usual candidate."""
        return next(iter(self.plain().values()))

    def plain(self) -> dict[str, Heads]:
        """The usual candidate, and magnitudes alone; the spectrum, if the size has no filters.

        It adds three discriminants for each kind of filters. All see the magnitudes, the
        second also the shares and the spectrum, the third also the distribution and the spectrum.
        An average is seldom worse than the better of two, and no held-out part has to show which
        that is.
        """
        levels, bands = self.columns.levels, self.columns.bands
        if not self.columns.kinds:
            return {"spectrum": (HeadPart(tuple(bands.tolist()), self.copies),)}
        magnitudes = self.by_kind(shares=False)
        usual = (*magnitudes, *_with(self.by_kind(shares=True), bands))
        if len(levels):
            usual += _with(magnitudes, np.append(levels, bands))
        return {"magnitudes, shares, distribution": usual, "magnitudes": magnitudes}

    def extended(self, best: Heads) -> dict[str, Heads]:
        """The best plain candidate with the spectrum and with copies, and the spectrum alone."""
        bands, kept = self.columns.bands, "without more of the spectrum"
        bases = {kept: best}
        if len(bands):
            bases["with the spectrum"] = _with(best, bands)
            bases["the spectrum alone"] = (HeadPart(tuple(bands.tolist()), self.copies),)
        return {
            f"{name}{', with copies' * copies}": tuple(replace(p, copies=copies) for p in parts)
            for name, parts in bases.items()
            for copies in sorted({self.copies, True})
            if (name, copies) != (kept, self.copies)
        }

    def reduced(self) -> dict[str, Callable[[Heads], Heads]]:
        """Views to leave out of the usual candidate: each changes heads to heads without it."""
        views = {"distribution": self.columns.levels, "spectrum": self.columns.bands}
        without: dict[str, Callable[[Heads], Heads]] = {
            f"without {name}": partial(_without, columns=columns)
            for name, columns in views.items()
            if len(columns)
        }
        return without | ({"without copies": _without_copies} if self.copies else {})

    def related(self, best: Heads) -> dict[str, Heads]:
        """The relations with two discriminants of filters of all kinds; in a size without
        filters, one discriminant of relations and spectrum.

        Few scales and all scales each have a discriminant: few carry over to a new speed, all to
        a new force. With more discriminants of filters they would have too little weight.
        """
        of = self.columns
        if not of.relations.size:
            return {}

        def head(*views: Array) -> HeadPart:
            numbers = np.concatenate([view.ravel() for view in views])
            return HeadPart(tuple(numbers.tolist()), best[0].copies)

        if not of.kinds:
            return {"relations and spectrum": (head(of.relations, of.bands),)}
        filters = [head(of.magnitudes, of.shares, of.bands)]
        if len(of.levels):
            filters.append(head(of.magnitudes, of.levels, of.bands))
        return {"relations beside filters": (*filters, *self._few_and_all(best))}

    def _few_and_all(self, best: Heads) -> Heads:
        """A discriminant of the relations at few scales, and one of all."""
        of, copies = self.columns, best[0].copies
        views = of.relations[: relations.SHORT], of.relations
        return tuple(dict.fromkeys(HeadPart(tuple(v.ravel().tolist()), copies) for v in views))

    def steady(self, best: Heads) -> dict[str, Heads]:
        """Shares, distribution, and one and few scales of the relations, a discriminant each: they
        carry over to a new speed, and magnitudes in the same sum would outvote them. A single
        taxel has no relations."""
        of = self.columns
        if not (len(of.shares) and len(of.levels)):
            return {}

        def apart(*views: tuple[Array, float]) -> Heads:
            return tuple(
                HeadPart(tuple(view.ravel().tolist()), best[0].copies, weight=weight)
                for view, weight in views
            )

        views = (of.shares, 1.0), (of.levels, 1.0)
        if not of.relations.size:
            both = apart(*views)
            return {"without magnitudes": both, "with shares and distribution": (*best, *both)}
        few = (of.relations[:1], 1.0), (of.relations[: relations.SHORT], float(len(views)))
        return {"without magnitudes, with few scales": apart(*views, *few)}

    def tuned(self, best: Heads) -> dict[str, Heads]:
        """The best candidate of a single taxel with a discriminant of the spectrum: in one of a
        thousand features of filters it has little weight."""
        of = self.columns
        if of.relations.size or not (len(of.bands) and of.kinds):
            return {}
        return {"with the spectrum beside": _beside(best, of.bands)}

    def loaded(self, best: Heads) -> dict[str, Heads]:
        """The best candidate with the loads, in a discriminant of their own and in each."""
        loads = self.columns.loads
        if not (self.loads and len(loads)):
            return {}
        alone = HeadPart(tuple(loads.tolist()), best[0].copies)
        return {"with loads beside": (*best, alone), "with loads in each": _with(best, loads)}

    def unshown(self, best: Heads) -> dict[str, Heads]:
        """Joins the best candidate of a few sweeps unless it makes it worse: the relations, if it
        has none."""
        of = self.columns
        seen = np.concatenate([part.columns for part in best])
        if self.copies or not of.relations.size or np.isin(of.relations, seen).any():
            return {}
        return {"with relations beside": (*best, *self._few_and_all(best))}

    def beside(self, best: Heads) -> dict[str, Heads]:
        """Joins the best candidate unless it makes it worse: a discriminant of the slow waves. On a
        skin that is put back the waves move from taxel to taxel."""
        slow = self.columns.slow
        if self.copies or not len(slow):
            return {}
        return {"with slow waves beside": _beside(best, slow)}

    def by_kind(self, shares: bool) -> Heads:
        """A discriminant of each kind of filters, zero-sum ones first: of their magnitudes, or of
        magnitudes and shares."""
        of = self.columns
        pools = (of.magnitudes, of.shares) if shares else (of.magnitudes,)
        seen = [np.concatenate([pool[filters] for pool in pools]) for filters in of.kinds]
        return tuple(HeadPart(tuple(columns.tolist()), self.copies) for columns in seen)


STEPS: tuple[tuple[str, Callable[[PairedDifference], bool]], ...] = (
    ("extended", lambda found: found.better),
    ("related", lambda found: found.helps or found.better),
    ("steady", lambda found: found.carries),
    ("tuned", lambda found: found.gains),
    ("loaded", lambda found: found.helps),
)
"""The methods of Candidates that add to the choice so far, and when the best of theirs takes its
place."""


def choose(scores: HeldOutScores, candidates: Candidates, log: Log) -> ScoredPlan:
    """The usual candidate without what makes it worse, then the steps of STEPS, each from the
    candidate with the lowest loss. Copies take a third of the time of a fit, so they are only
    offered below ENOUGH, and if copies that correct all wrong labels would do so by more than
    chance."""

    def score(name: str, parts: Heads) -> ScoredPlan:
        log(f"choosing: {name}")
        return scores.score(parts)

    chosen, *rivals = [score(*named) for named in candidates.plain().items()]
    for name, lessen in candidates.reduced().items():
        if parts := lessen(chosen.plan.parts):
            less = score(name, parts)
            chosen = less if scores.paired(chosen, less).worse else chosen
    for step, accepts in STEPS:
        start = min([chosen, *rivals], key=scores.loss)
        heads: dict[str, Heads] = getattr(candidates, step)(start.plan.parts)
        if scores.accuracy(start) >= ENOUGH or scores.wrong(start) <= ERRORS**2:
            heads = {name: parts for name, parts in heads.items() if not _copied(parts, start)}
        rivals += [score(*named) for named in heads.items()]
        best = min(rivals, key=scores.loss, default=chosen)
        chosen, rivals = best if accepts(scores.paired(best, chosen)) else chosen, []
    few = scores.accuracy(chosen) < ENOUGH and scores.own.sum() < MANY
    for named in candidates.unshown(chosen.plan.parts).items() if few else ():
        joined = score(*named)
        chosen = chosen if scores.paired(joined, chosen).worse else joined
    for named in candidates.beside(chosen.plan.parts).items():
        found = scores.paired(joined := score(*named), chosen)
        chosen = joined if (found.gains if few else not found.worse) else chosen
    return chosen


def _without(parts: Heads, columns: Array) -> Heads:
    """`parts` without these features; of parts that then see the same, one."""
    dropped = set(columns.tolist())
    left = (replace(p, columns=tuple(c for c in p.columns if c not in dropped)) for p in parts)
    return tuple(dict.fromkeys(replace(p, factor=1.0) for p in left if p.columns))


def _copied(parts: Heads, start: ScoredPlan) -> bool:
    """Whether `parts` see copies that the parts of `start` do not see."""
    return parts[0].copies and not start.plan.parts[0].copies


def _without_copies(parts: Heads) -> Heads:
    return tuple(replace(p, copies=False) for p in parts)


def _beside(parts: Heads, columns: Array) -> Heads:
    """`parts`, and a discriminant of these features that counts as much as all others together."""
    weight = sum(p.weight for p in parts)
    return (*parts, HeadPart(tuple(columns.tolist()), parts[0].copies, weight=weight))


def _with(parts: Heads, more: Array) -> Heads:
    """`parts`, each with the features `more` as well."""
    return tuple(
        replace(p, columns=tuple(dict.fromkeys([*p.columns, *more.tolist()]))) for p in parts
    )


def with_fewer_filters(
    scores: HeldOutScores, chosen: ScoredPlan, filters: Array, log: Log, least: int = LEAST_FILTERS
) -> ScoredPlan:
    """`chosen` with half of its filters, a quarter and so on, but at least `least`, as long as
    this `holds` on held-out parts. filters: the filter [F] of each feature, -1 if it has none."""
    full, used = chosen, np.unique(filters[chosen.plan.columns()])
    used = used[used >= 0]
    while len(used) >= 2 * least:
        used = used[::2]
        log(f"choosing: {len(used)} filters")
        kept = (filters < 0) | np.isin(filters, used)
        parts = [
            replace(p, columns=tuple(c for c in p.columns if kept[c])) for p in full.plan.parts
        ]
        less = scores.score(parts)
        if not scores.paired(less, full).holds:
            break
        chosen = less
    return chosen
