"""Chooses the smallest model that suffices: one size of our family, with the reasons.

All sizes are judged on the same held-out sweeps, by heads that did not see them. We choose the
cheapest size within one standard error of the best (Breiman et al. 1984, sec. 3.4.3), with the
error of the paired difference; or the cheapest that reaches a wanted accuracy. The choice is
repeated without each held-out part in turn, and that part tests it: the accuracy to expect.
"""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import ApplianceError, BundleError, FormatError
from palpate.core.provenance import commit
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.data.transforms import Change
from palpate_train.export import measure, quantized_bundle
from palpate_train.export.measure import BundleCost
from palpate_train.metrics.score import confusion, interval, row_shares
from palpate_train.models.methods import Log
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.recipe import HeadChoice, Settings, Setup
from palpate_train.models.recipe.sizes import SIZES, UNLIMITED, ModelSize
from palpate_train.models.recipe.trunk import Trunk

Array = NDArray[Any]
Json = dict[str, Any]
ALL = "all"
FAMILY: Mapping[str, ModelSize] = {**SIZES, ALL: UNLIMITED}
"""All sizes by name."""


def sizes(stages: bool) -> tuple[str, ...]:
    """The names of the sizes to choose from. Without trained stages the size of that name is
    another."""
    return tuple(name for name in FAMILY if stages or name != "stages")


class NothingFits(ApplianceError):
    """No size is within the budget, or none can be packed."""


@dataclass(frozen=True)
class Budget:
    """The limits of the board, in the terms of export.measure; infinity for no limit.

    ms: processor time of a sweep in the box's classifier. kb: size of the whole bundle in units of
    1000 bytes. slower: assumed time on the board as a multiple of the time on this machine, until
    it is measured on the board.
    """

    ms: float = math.inf
    kb: float = math.inf
    slower: float = 1.0

    def used(self, cost: BundleCost) -> dict[str, float]:
        """The used share of each limit."""
        needs = {"ms": cost.ms * self.slower, "kb": cost.kb}
        return {k: v / limit for k, v in needs.items() if math.isfinite(limit := getattr(self, k))}

    def order(self, cost: BundleCost) -> tuple[float, float]:
        """The sort key of sizes: the larger of the used shares of the budget, or the bytes if it
        has no limits; then the time."""
        return max(self.used(cost).values(), default=cost.kb), cost.ms

    def over(self, cost: BundleCost) -> str:
        """Why a bundle exceeds the budget, or ""."""
        over = [
            f"{share * getattr(self, k):.3g} {k} of {getattr(self, k):g}"
            for k, share in self.used(cost).items()
            if share > 1
        ]
        return f"over the budget: {', '.join(over)}" if over else ""


@dataclass(frozen=True)
class SizeWish:
    """The wish of the user. accuracy: 0 for the highest possible. sizes: those to choose from."""

    budget: Budget = Budget()
    accuracy: float = 0.0
    sizes: tuple[str, ...] = tuple(FAMILY)


@dataclass(frozen=True)
class Difference:
    """The difference of two models' accuracy: mean, standard error and 95 % interval."""

    mean: float
    se: float
    low: float
    high: float

    @property
    def within(self) -> bool:
        """Whether the difference is at most one standard error."""
        return bool(self.mean <= self.se + 1e-12)

    def json(self) -> dict[str, float]:
        """The figures for scripts, rounded."""
        return {k: round(v, 4) for k, v in vars(self).items()}


def difference(better: Array, worse: Array, clusters: Array) -> Difference:
    """The difference of two models on the same sweeps, which removes the effect of hard sweeps.

    better, worse: bool [n], whether each sweep is right. clusters: int [n]; sweeps of a
    cluster succeed or fail together. The standard error is that over clusters, or that over sweeps
    if this is larger, because a few clusters may agree by chance.
    """
    from scipy.stats import t as student

    lost = better.astype(float) - worse
    member = np.unique(clusters, return_inverse=True)[1]
    mean, n = float(lost.mean()), int(member.max()) + 1
    by_sweep = float(lost.std(ddof=1)) / np.sqrt(len(lost)) if len(lost) > 1 else 0.0
    sums = np.bincount(member, lost - mean)
    by_cluster = np.sqrt(n / (n - 1) * np.sum(sums**2)) / len(lost) if n > 1 else 0.0
    se = max(by_sweep, float(by_cluster))
    half_width = float(student.ppf(0.975, max(n - 1, 1))) * se
    return Difference(mean, se, mean - half_width, mean + half_width)


def estimate(right: Array, clusters: Array) -> dict[str, float]:
    """Accuracy with its 95 % interval. right: bool [n]; clusters: int [n]."""
    low, high = interval(right, clusters)
    return {
        k: round(float(v), 4) for k, v in (("mean", right.mean()), ("low", low), ("high", high))
    }


@dataclass(frozen=True, eq=False)
class JudgedSize:
    """A size with its answers to the held-out sweeps. named: int [n], their labels. trunk: of the
    stages, None without stages."""

    trunk: Trunk | None
    judged: HeadChoice
    named: Array


@dataclass(frozen=True, eq=False)
class Judgement:
    """All sizes on the same held-out sweeps.

    refused: the reason by size that cannot be fitted. labels, clusters: int [n] of the held-out
    sweeps. by: the groups that were left out.
    """

    setup: Setup
    sizes: dict[str, JudgedSize]
    refused: dict[str, str]
    labels: Array
    clusters: Array
    by: tuple[str, ...]

    def right(self, name: str) -> Array:
        """bool [n], the held-out sweeps that this size classifies correctly."""
        right: Array = self.sizes[name].named == self.labels
        return right

    def fit(self, name: str) -> Fit:
        """The finished model of this size."""
        one = self.sizes[name]
        return recipe.finish(one.trunk, one.judged, self.setup)

    def first_equals(self) -> dict[str, str]:
        """For each size the first one whose model is the same, often itself: a larger size may
        choose nothing more."""
        first: dict[tuple[object, ...], str] = {}
        equal = {}
        for name, one in self.sizes.items():
            parts = [(p.columns, p.copies, p.factor) for p in one.judged.chosen.plan.parts]
            equal[name] = first.setdefault((one.trunk is None, *parts), name)
        return equal

    def reduced(self, name: str) -> Settings:
        """The settings for a fit of this size to reduced sweeps: stages only if the size has them
        for the whole ones, and no strangers, which are whole."""
        steps = self.setup.settings.steps if self.sizes[name].trunk else 0
        return replace(self.setup.settings, size=FAMILY[name], steps=steps, strangers=None)

    @property
    def staged(self) -> bool:
        """Whether all sizes were judged on the sweeps that judge stages."""
        return any(one.trunk is not None for one in self.sizes.values())

    def behind(self, name: str, ahead: str) -> Difference:
        """The difference between the size `ahead` and `name`."""
        return difference(self.right(ahead), self.right(name), self.clusters)

    def choose(self, order: Sequence[str], accuracy: float, seen: Array) -> str:
        """The choice by the held-out sweeps `seen` (bool [n]) alone. order: the sizes to choose
        from, the cheapest first."""
        means = {name: self.right(name)[seen].mean() for name in order}
        if accuracy and (enough := [name for name in order if means[name] >= accuracy]):
            return enough[0]
        best = self.right(max(order, key=lambda name: means[name]))[seen]
        return next(
            name
            for name in order
            if difference(best, self.right(name)[seen], self.clusters[seen]).within
        )

    def expected(self, order: Sequence[str], accuracy: float) -> Json | None:
        """The accuracy of the choice made without each cluster, on that cluster, and how often each
        size was chosen; None with a single cluster."""
        right, chose = np.zeros(len(self.labels), bool), Counter[str]()
        clusters = np.unique(self.clusters)
        if len(clusters) < 2:
            return None
        for one in clusters:
            out = self.clusters == one
            name = self.choose(order, accuracy, ~out)
            right[out], chose[name] = self.right(name)[out], chose[name] + 1
        return estimate(right, self.clusters) | {"chose": dict(chose.most_common())}


def judge(
    sweeps: Dataset, run: Run, settings: Settings, sizes: Sequence[str], staged: bool = False
) -> Judgement:
    """Judge these sizes. Features, copies and stages are computed once for all of them.

    Stages are judged only on the sweeps that they were not trained on; if a size has stages, or
    `staged` is set, all sizes are judged on these sweeps. Raises FormatError as recipe.fit, or if
    the windows are too short for every size.
    """
    setup = Setup.of(sweeps, run, settings)
    found, refused = {}, {}
    for name in sizes:
        try:
            fixed = setup.fixed.limited(FAMILY[name])
            found[name] = recipe.judged_size(fixed, setup, FAMILY[name])
        except FormatError as e:
            refused[name] = str(e)
    if not found:
        raise FormatError("; ".join(f"{name}: {why}" for name, why in refused.items()))
    staged = staged or any(trunk for trunk, _ in found.values())
    alike = {name: judged for name, (_, judged) in found.items()}
    for name, (trunk, judged) in found.items() if staged else ():
        if trunk is None:  # the same heads on the sweeps that judge stages
            scores = setup.scores(setup.fixed.data, [setup.judging])
            alike[name] = HeadChoice(scores, scores.score(judged.chosen.plan.parts))
    scores = next(iter(alike.values())).scores
    return Judgement(
        setup,
        {
            name: JudgedSize(*found[name], judged.chosen.logits.argmax(axis=1))
            for name, judged in alike.items()
        },
        refused,
        scores.labels,
        _values(setup, len(scores.labels)) if staged else scores.clusters,
        tuple(dict.fromkeys(scores.groups.tolist())),
    )


def _values(setup: Setup, n: int) -> Array:
    """int [n], the value of the left-out group for each sweep that judges stages, and then for its
    copies."""
    judging = setup.judging
    return np.resize(setup.sweeps.group(judging.group)[judging.out], n)


@dataclass(frozen=True)
class Selection:
    """The result of a choice. order: the sizes that fit the budget, the cheapest first. costs: of
    all bundles; why_not: the reason by size that cannot be used. fit: of the chosen size."""

    judgement: Judgement
    wanted: SizeWish
    order: list[str]
    costs: dict[str, BundleCost]
    why_not: dict[str, str]
    chosen: str
    fit: Fit

    @property
    def best(self) -> str:
        """The size with the highest accuracy; the cheapest of equal ones."""
        return max(self.order, key=lambda name: self.judgement.right(name).mean())

    def json(self) -> Json:
        """The result for scripts."""
        judged, order = self.judgement, self.order
        at = order.index(self.chosen)
        smaller, larger = order[at - 1] if at else "", (order[at + 1 :] or [""])[0]
        named = [*order, *(name for name in self.wanted.sizes if name not in order)]
        return {
            "chosen": self.chosen,
            "best": self.best,
            "rungs": [self._rung(name) for name in named],
            "accuracy": estimate(judged.right(self.chosen), judged.clusters),
            "honest": judged.expected(order, self.wanted.accuracy),
            "smaller": self._neighbour(smaller, -1),
            "larger": self._neighbour(larger, 1),
            "wanted": self.wanted.accuracy,
            "groups": list(judged.by),
            "held_out": len(judged.labels),
            "confused": self._confused(),
        }

    def _rung(self, name: str) -> Json:
        """A line of the table of sizes."""
        cost, known = self.costs.get(name), name in self.judgement.sizes
        right = self.judgement.right(name) if known else None
        return {
            "method": name,
            "about": FAMILY[name].about,
            "ms": cost.ms if cost else None,
            "kb": cost.kb if cost else None,
            "mb": cost.mb if cost else None,
            "used": {k: round(v, 3) for k, v in self.wanted.budget.used(cost).items()}
            if cost
            else {},
            "accuracy": None if right is None else estimate(right, self.judgement.clusters),
            "behind": self.judgement.behind(name, self.best).json() if known else None,
            "why_not": self.why_not.get(name, ""),
        }

    def _neighbour(self, name: str, sign: int) -> Json | None:
        """The difference of the chosen size and a neighbour in cost; sign: 1 for a larger one."""
        if not name:
            return None
        pair = (name, self.chosen) if sign < 0 else (self.chosen, name)
        return {"method": name} | self.judgement.behind(*pair).json()

    def _confused(self) -> list[Json]:
        """Confused pairs of materials, the most frequent first: shares of the sweeps of a
        material."""
        judged = self.judgement
        names = judged.setup.sweeps.materials
        answers = np.eye(len(names))[judged.sizes[self.chosen].named]
        shares = row_shares(confusion(judged.labels, answers))
        wrong = [
            (shares[a, b], a, b)
            for a, b in np.argwhere((shares > 0) & ~np.eye(len(names), dtype=bool))
        ]
        return [
            {"is": names[a], "named": names[b], "share": round(float(share), 4)}
            for share, a, b in sorted(wrong, reverse=True)
        ]


def choose(sweeps: Dataset, run: Run, settings: Settings, wanted: SizeWish) -> Selection:
    """Judge the sizes, measure their bundles, and choose.

    Raises NothingFits if no size can be used, and FormatError as recipe.fit.
    """
    judged = judge(sweeps, run, settings, wanted.sizes)
    first = judged.first_equals()
    fits = {name: judged.fit(name) for name in dict.fromkeys(first.values())}
    measured, unpacked = bundle_costs(fits, sweeps, run.log)
    costs = {name: measured[same] for name, same in first.items() if same in measured}
    refused = {name: unpacked[same] for name, same in first.items() if same in unpacked}
    over = {name: why for name, cost in costs.items() if (why := wanted.budget.over(cost))}
    why_not = judged.refused | refused | over
    within = [name for name in costs if name not in over]
    order = sorted(within, key=lambda name: wanted.budget.order(costs[name]))
    if not order:
        raise NothingFits(_nearest(costs, why_not, wanted.budget))
    chosen = judged.choose(order, wanted.accuracy, np.ones(len(judged.labels), bool))
    return Selection(judged, wanted, order, costs, why_not, chosen, fits[first[chosen]])


def reduced(choice: Selection, change: Change) -> tuple[Fit, BundleCost]:
    """The chosen size fitted to reduced sweeps, and the cost of its bundle. Raises FormatError if
    the reduced sweeps cannot be fitted or packed."""
    setup = choice.judgement.setup
    sweeps, run = change.of(setup.sweeps), replace(setup.run, folder=None)
    made = recipe.fit(sweeps, run, choice.judgement.reduced(choice.chosen))
    costs, refused = bundle_costs({choice.chosen: made}, sweeps, run.log)
    for why in refused.values():
        raise FormatError(why)
    return made, costs[choice.chosen]


def bundle_costs(
    fits: Mapping[str, Fit], sweeps: Dataset, log: Log
) -> tuple[dict[str, BundleCost], dict[str, str]]:
    """The costs of the fits' bundles, measured in turns, and the reasons of bundles that cannot be
    packed."""
    refused: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as aside:
        folders: dict[str, Path] = {}
        for name, fit in fits.items():
            log(f"bundle of {name}")
            folder = Path(aside) / name
            try:
                quantized_bundle.export(fit, folder, name, "1", commit(), proven=False)
            except (FormatError, BundleError) as e:
                refused[name] = str(e)
            else:
                folders[name] = folder
        log(f"{len(folders)} bundles take turns")
        found = measure.measure_all(list(folders.values()), sweeps.samples) if folders else []
    return dict(zip(folders, found, strict=True)), refused


def _nearest(costs: Mapping[str, BundleCost], why_not: Mapping[str, str], budget: Budget) -> str:
    """The reason why no size can be used; it gives the size that exceeds the budget least."""
    if not costs:
        return "; ".join(f"{name} cannot be used here: {why}" for name, why in why_not.items())
    name = min(costs, key=lambda name: budget.order(costs[name]))
    return (
        f"no model fits the board; the nearest is {name}, {why_not[name]}: "
        "raise the budget, or record shorter sweeps"
    )
