"""The limits of known materials, by the cost of two mistakes: an unknown material with a label, and
a known one without.

Conditions and materials are left out together. A known sweep is judged by a fit that did not see
its value of a condition; for a fit without its material, too, the same sweep is an unknown one. A
fit to fewer values scatters more than the finished model. By how much is measured on the unknown
sweeps, which the finished model without their material judges, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.unknown import Known, shaped_distances
from palpate.core.errors import FormatError
from palpate.core.statistics import interval
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.data.sets import evenly
from palpate_train.metrics.tolerances import KEPT, LEFT_OUT

Array = NDArray[Any]
FIGURES = "unknown materials"
"""Key of the figures in a manifest."""
COST = "stranger_cost"
"""Entry of a fit's `about`: what multiplies COSTS."""
COSTS = {"strict": 3.0, "balanced": 1.0, "loose": 1 / 9}
"""Cost of an unknown sweep with a label, where a known sweep without one costs 1, for each limit.
On two simulated worlds and three materials, left out with a third of the positions, they answer 95,
98 and 99.7 % of known sweeps, and give 1, 2 and 7 % of unknown ones a label."""
MOST_UNKNOWN = 0.5
"""Largest share of held-out sweeps that a bundle may call unknown: export refuses it else."""
LEAST_KEPT = {"strict": 1 - MOST_UNKNOWN, "balanced": 1 - MOST_UNKNOWN, "loose": 0.9}
"""Least share of known sweeps within each limit, at any cost; the largest is KEPT. A box that
refuses more is of no use; a wider limit only lets strangers in."""
FEW_SWEEPS, LEAST_OF_FEW, LEAST_OF_GUESS, LEAST_BY_JUNK = 50, 0.7, 0.9, 0.85
"""Up to this number of sweeps of a material, the balanced limit keeps such a share. Few sweeps say
too little of strangers to give up more known sweeps for them, and their cross-fits are farther away
than new sweeps of the finished model. Of .5 to .95, .7 had the least cost on nine simulated sets.
Up to FEW materials say still less; with .7 three materials of 20 sweeps lost 15 to 18 points of
known sweeps for 11 to 19 of unknown ones (simulated). With two, one alone is left to compare: it
holds for any number of sweeps (trials/0006). With junk made of up to ten sweeps, .7 would answer 6
to 12 points less at a new place."""
FEW_STRANGERS = 3
"""This number of sweeps of NOT_THIS counts half as much as many do: a single one may be a slip."""
NO_JUNK: Mapping[str, Array] = MappingProxyType({})
STEPS, DRAWN = 500, 12
"""Numbers of limits that are compared, and that a manifest has shares for."""
WIDTH = 1.06
"""Bandwidth of the density of n values, as a multiple of their deviation times n ** -0.2 (Silverman
1986)."""
NORMAL = (AT := np.linspace(-8, 8, 4001)), np.array([*map(NormalDist().cdf, AT)])
"""The normal distribution, of which a table is enough: it is right to 5e-7."""
FEW = 3
"""Up to this number of materials, too few are left out, and the shares are a guess."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Squared distances [N] of sweeps to the nearest mean, with one condition left out; NaN where a
    sweep does not judge.

    known: by a fit without the sweep's value of the condition. strangers: the same without its
    material. finished: of the finished model without its material. labels: int [N]. values: int
    [N], of the condition. parts: number of parts in which the values were left out.
    """

    known: Array
    strangers: Array
    finished: Array
    learned: Array
    labels: Array
    values: Array
    parts: int

    def corrected(self) -> tuple[Array, Array]:
        """Logarithms of `known` and `strangers`, as expected of the finished model.

        A fit without a value learns the scatter between values from one value less, of `parts` - 1.
        So all of the correction counts if there are two parts, and little if there are many. But a
        new sweep is not nearer than one from which the model has learned.
        """
        known, strangers, finished = map(_log, (self.known, self.strangers, self.finished))
        both = np.isfinite(strangers) & np.isfinite(finished)
        if not both.any():
            return known, strangers
        of_all = [self.labels[both] == k for k in np.unique(self.labels[both])]
        inflated = [np.median(strangers[both][k]) - np.median(finished[both][k]) for k in of_all]
        shift = max(float(np.mean(inflated)), 0.0) / max(self.parts - 1, 1)
        return np.maximum(known - shift, _log(self.learned)), strangers - shift


@dataclass(frozen=True)
class StrangerLimits:
    """strict, balanced, loose: the limits. figures: for a manifest, JSON: `under`, the conditions;
    `known` and `strangers`, numbers of sweeps; `guess`, whether too few materials were left out;
    for each limit the shares of known sweeps that are `answered` and of unknown ones that are
    `named`, with their intervals, and `of one`, the least and the largest share of one unknown
    material; `curve`, the two shares for limits from the lowest to the highest that may be chosen;
    `by condition`, the two at these and at each limit."""

    strict: float
    balanced: float
    loose: float
    figures: Mapping[str, Any]

    def known(self, temperature: float) -> Known:
        """The entry `known` of a manifest."""
        return Known(self.strict, self.balanced, self.loose, temperature)


@dataclass(frozen=True, eq=False)
class _Sweeps:
    """Logarithms of distances [n], with the material and the cluster of each."""

    logs: Array
    labels: Array
    clusters: Array

    @classmethod
    def of(cls, parts: Sequence[tuple[Array, Array, Array]]) -> _Sweeps:
        logs, labels, clusters = (np.concatenate(part) for part in zip(*parts, strict=True))
        judged = np.isfinite(logs)
        return cls(logs[judged], labels[judged], clusters[judged])

    @property
    def by_material(self) -> list[Array]:
        return [self.logs[self.labels == k] for k in np.unique(self.labels)]

    def within(self, limit: float) -> list[float]:
        """The share within a limit, and its interval."""
        right = self.logs <= np.log(limit)
        return [round(float(right.mean()), 4), *interval(right, self.clusters)]

    def of_one(self, limit: float) -> list[float]:
        """The least and the largest share of a material within a limit."""
        shares = [round(float(np.mean(of <= np.log(limit))), 4) for of in self.by_material]
        return [min(shares), max(shares)]


def limits(
    left_out: Mapping[str, LeftOut],
    stranger_cost: float = 1.0,
    junk: Mapping[str, Array] = NO_JUNK,
) -> StrangerLimits:
    """The limits of the least expected cost, over sweeps of all conditions, by their names.

    junk: squared distances [m] of windows without a slide over one material, by kind. A label for
    one costs as much as one for an unknown material, and so does one for a sweep of NOT_THIS, a
    kind of its own.

    Each material has the same weight. Densities have smooth tails, so that a few sweeps promise
    nothing that they do not show. Without unknown sweeps the limits keep KEPT.
    stranger_cost: multiplies COSTS. Raises FormatError without a known sweep, and for a
    cost of 0 or less.
    """
    if not 0 < stranger_cost < np.inf:
        raise FormatError(f"a stranger cannot cost {stranger_cost}; give a number above 0")
    known, strangers = _both(left_out.values())
    if not len(known.logs):
        raise FormatError(
            "no known sweep is left to find the limit with; record each material in several "
            "positions"
        )
    reach = 3 * WIDTH * max(_deviation(one.by_material) for one in (known, strangers))
    every = np.concatenate([known.logs, strangers.logs])
    grid = np.linspace(every.min() - reach, every.max() + reach, STEPS)
    kept, named = (_share_below(grid, one.by_material) for one in (known, strangers))
    made = [_log(distances) for kind, distances in junk.items() if kind != NOT_THIS]
    own = [_log(junk[NOT_THIS])] if NOT_THIS in junk else []
    weight = (counted := sum(map(len, own))) / (counted + FEW_STRANGERS)
    wrong = named + _share_below(grid, made) + weight * _share_below(grid, own)
    most, chosen = int(np.argmax(kept >= KEPT)), {}
    least_kept = LEAST_KEPT | _least_of_few(known, len(left_out), bool(made))
    for name, cost in COSTS.items():
        cheapest = _cheapest(kept, wrong, stranger_cost * cost)
        least = int(np.argmax(kept >= least_kept[name]))
        chosen[name] = float(np.exp(grid[np.clip(cheapest, least, most)]))
    spread = np.linspace(np.argmax(kept >= LEAST_KEPT["strict"]), most, DRAWN).round().astype(int)
    figures: dict[str, Any] = {
        "under": list(left_out),
        "known": _judging(one.known for one in left_out.values()),
        "strangers": _judging(one.strangers for one in left_out.values()),
        "guess": len(known.by_material) <= FEW,
        "curve": np.round(np.stack([kept, named], 1)[spread], 4).tolist(),
    } | _by_condition(left_out, grid[spread], chosen)
    for name, limit in chosen.items():
        figures[name] = {"answered": known.within(limit)}
        if len(strangers.logs):
            figures[name] |= {"named": strangers.within(limit), "of one": strangers.of_one(limit)}
        for logs in own:
            figures[NOT_THIS] = len(logs)
            figures[name][NOT_THIS] = round(float(np.mean(logs <= np.log(limit))), 4)
    return StrangerLimits(**chosen, figures=figures)


def _least_of_few(known: _Sweeps, conditions: int, junk: bool) -> dict[str, float]:
    """The least share of known sweeps that the balanced limit keeps of few sweeps, or of two
    materials, by its name; nothing of more."""
    materials = len(known.by_material)
    if materials >= FEW and len(known.logs) > FEW_SWEEPS * materials * conditions:
        return {}
    if junk:
        return {"balanced": LEAST_BY_JUNK}
    return {"balanced": LEAST_OF_GUESS if materials <= FEW else LEAST_OF_FEW}


def _by_condition(
    left_out: Mapping[str, LeftOut], curve: Array, chosen: Mapping[str, float]
) -> dict[str, Any]:
    """The figures of each condition. curve: logarithms of limits."""
    drawn = {"curve": curve, **{name: np.log([of]) for name, of in chosen.items()}}
    judged = {
        name: {what: _shares(one, at) for what, at in drawn.items()}
        for name, one in left_out.items()
        if np.isfinite(one.known).any() and np.isfinite(one.strangers).any()
    }
    return {"by condition": judged}


def _judging(distances: Iterable[Array]) -> int:
    """The number of sweeps that judge under one condition at least."""
    judged: Array = np.any([np.isfinite(of) for of in distances], axis=0)
    return int(judged.sum())


def _shares(one: LeftOut, logs: Array) -> list[list[float]]:
    """The share of known sweeps within each limit, and that of unknown ones."""
    pair = [of.by_material for of in _both([one])]
    return [
        [round(float(np.mean([np.mean(own <= at) for own in of])), 4) for of in pair] for at in logs
    ]


def _both(left_out: Iterable[LeftOut]) -> tuple[_Sweeps, _Sweeps]:
    """Known and unknown sweeps of all conditions. Known ones are alike at one value of a condition,
    unknown ones if they are of one material."""
    known, strangers, first = [], [], 0
    for one in left_out:
        of_known, of_strangers = one.corrected()
        known.append((of_known, one.labels, one.values + first))
        strangers.append((of_strangers, one.labels, one.labels))
        first += int(one.values.max(initial=0)) + 1
    none = np.empty(0), np.empty(0, int), np.empty(0, int)
    return _Sweeps.of(known or [none]), _Sweeps.of(strangers or [none])


def _log(distances: Array) -> Array:
    """Logarithms; NaN stays, and 0 is taken for the least float32."""
    logs: Array = np.log(np.maximum(distances, np.finfo(np.float32).tiny))
    return logs


def _cheapest(kept: Array, named: Array, cost: float) -> int:
    """The number of the limit with the least cost; of equal ones the highest."""
    total = (1 - kept) + cost * named
    return len(total) - 1 - int(np.argmin(total[::-1]))


def _deviation(by_material: Sequence[Array]) -> float:
    """The deviation of values around the median of their material; at least a thousandth."""
    away = [of - np.median(of) for of in by_material]
    return max(float(np.concatenate(away).std()), 1e-3) if away else 1e-3


def _share_below(grid: Array, by_material: Sequence[Array]) -> Array:
    """The smooth share of values below each value of `grid`, the mean of all materials."""
    wide, share = WIDTH * _deviation(by_material), np.zeros(len(grid))
    for of in by_material:
        steps = (grid[:, None] - of) / (wide * len(of) ** -0.2)
        share += np.interp(steps, *NORMAL).mean(axis=1) / len(by_material)
    return share


def nearest_other(
    z: Array, labels: Array, means: Array, shapes_without: Callable[[int], Array]
) -> Array:
    """Squared distances [n] of embeddings z [n, r] to the nearest mean of another material than
    their own. means: [K, r]. shapes_without: gives the shapes [K - 1, r, r] of a model without
    material k. NaN without another material. Of many materials LEFT_OUT are left out, and the
    others get NaN."""
    distances = np.full(len(z), np.nan)
    if len(means) < 2:
        return distances
    for k in np.intersect1d(evenly(len(means), LEFT_OUT), labels):
        own, others = labels == k, np.delete(means, k, axis=0)
        distances[own] = shaped_distances(z[own][:, None] - others, shapes_without(k)).min(axis=1)
    return distances


def answered(figures: Mapping[str, Any]) -> float:
    """The share of known sweeps within the balanced limit."""
    return float(figures["balanced"]["answered"][0])


def lines(figures: Mapping[str, Any], limit: str = "balanced") -> list[str]:
    """The cost of a limit in words. figures: of a fit or a manifest; without FIGURES there is
    nothing to tell."""
    if not (found := figures.get(FIGURES)):
        return []
    shares, under = found[limit], " or ".join(found["under"])
    known = f"of {found['known']} known sweeps under a new {under}"
    told = [f"{known} {_percent(shares['answered'])} are answered"]
    if named := shares.get("named"):
        guess = " (a guess: few materials were left out)" if found["guess"] else ""
        foreign = f"of {found['strangers']} sweeps of materials that you did not teach"
        of_one = [f"{100 * of:.0f}" for of in shares.get("of one", ())]
        each = f", of one material {' to '.join(of_one)} %" if of_one else ""
        told.append(f"{foreign} {_percent(named)} get a label{each}{guess}")
    if own := found.get(NOT_THIS):
        share = 100 * shares[NOT_THIS]
        told.append(f"of {own} sweeps of {NOT_THIS!r} {share:.0f} % get a label")
    return told


def _percent(share: Sequence[float]) -> str:
    middle, low, high = (100 * of for of in share)
    return f"{middle:.1f} % [{low:.1f}, {high:.1f}]"
