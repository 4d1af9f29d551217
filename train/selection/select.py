"""The room of the choice: the smallest model that a scene needs. In: a Scene. Out: what was taken and why, and its bundle.

The rungs are tried from the cheapest up. Taken is the cheapest within one standard error of the best (Breiman et al.
1984, sec. 3.4.3), the error being that of the paired difference. What such a choice is worth is told by nested
validation (Stone 1974): the same choice is made without each part in turn, which then judges what was chosen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import ApplianceError, FormatError
from train.data.sets import Dataset
from train.evaluation.evaluate import Where
from train.models import methods
from train.selection import prices as rungs
from train.selection.nested_cv import Difference, Refused, Trials, Unseen
from train.selection.prices import Price
from train.selection.scene import Scene

Array = NDArray[Any]
Json = dict[str, Any]
Log = Callable[[str], None]
IN_VAIN = 2
"""So many larger rungs of one family in a row that change nothing end the climb in it."""


class NothingFits(ApplianceError):
    """No rung is within the board's budget, or none can work with the scene's sweeps."""


@dataclass
class SizeSearch:
    """One choice as it is made, rung by rung in the order of cost. aside: the part that it must not see, or None.

    scores: of the rungs so far, as Trials.scores. vain: by family, its newest rung and how many in a row changed nothing.
    """

    trials: Trials
    aside: int | None
    scores: dict[str, Array] = field(default_factory=dict)
    vain: dict[str, tuple[str, int]] = field(default_factory=dict)

    def enough(self, name: str) -> str:
        """Why the next rung `name` need not be tried, "" where it could still change the choice.

        Enough is where even a faultless model would be within one standard error of what is chosen, and where two rungs
        of its family in a row changed nothing and the second was no better than the first.
        """
        if not self.scores:
            return ""
        chosen = self.scores[self.chosen]
        faultless = np.where(np.isfinite(chosen), 1.0, np.nan)
        if self.trials.difference(faultless, chosen).within:
            return "not tried: even a faultless one would be no more than a standard error better"
        if self.vain.get(_kin(name), ("", 0))[1] >= IN_VAIN:
            return f"not tried: {IN_VAIN} larger ones of its family changed nothing"
        return ""

    def needs(self) -> list[Unseen]:
        """Trainings that a rung takes."""
        return list(self.trials.seen_from(self.aside).values())

    def add(self, name: str) -> None:
        """A rung has been tried."""
        before = self.chosen if self.scores else ""
        self.scores[name] = self.trials.scores(name, self.aside)
        last, times = self.vain.get(_kin(name), ("", 0))
        rises = last and not self.trials.difference(self.scores[name], self.scores[last]).within
        self.vain[_kin(name)] = name, (times + 1 if self.chosen == before and not rises else 0)

    @property
    def best(self) -> str:
        """The rung with the highest mean; of equals the cheapest."""
        return max(self.scores, key=lambda name: self.trials.mean(self.scores[name]))

    @property
    def chosen(self) -> str:
        """The cheapest rung within one standard error of the best."""
        return next(name for name in self.scores if self.behind(name).within)

    def behind(self, name: str, ahead: str = "") -> Difference:
        """How far `name` is behind another rung, usually the best."""
        return self.trials.difference(self.scores[ahead or self.best], self.scores[name])


def _kin(name: str) -> str:
    return name.partition("-")[0]


@dataclass(frozen=True)
class Selection:
    """What was chosen. why_not: reasons by rung that was not tried. final: the choice with all data; inner: without each
    part in turn. prices: of all rungs, cheapest first."""

    trials: Trials
    prices: dict[str, Price]
    why_not: dict[str, str]
    final: SizeSearch
    inner: list[SizeSearch]

    @property
    def honest(self) -> Array:
        """Scores [groups, N] of what was chosen without each part, on that part: what the choice is worth."""
        scores = np.full_like(self.final.scores[self.final.chosen], np.nan)
        for p, climb in enumerate(self.inner):
            part = self.trials.parts[p]
            right = self.trials.right(climb.chosen, (p,))
            scores[self.trials.groups.index(part.group), part.out] = right[part.out]
        return scores

    def json(self, scene: Scene) -> Json:
        """What scripts read of it."""
        trials, final = self.trials, self.final
        order = list(self.prices)
        tried = list(final.scores)
        at = tried.index(final.chosen)
        rung = [self._rung(name, scene) for name in order]
        beside = {"smaller": tried[at - 1] if at else "", "larger": tried[at + 1] if at + 1 < len(tried) else ""}
        return {
            "chosen": final.chosen, "best": final.best, "rungs": rung, "accuracy": trials.accuracy(final.scores[final.chosen]),
            "honest": trials.accuracy(self.honest) | {
                "groups": {name: trials.accuracy(np.where(np.arange(len(trials.groups))[:, None] == g, self.honest, np.nan))
                           for g, name in enumerate(trials.groups)},
                "chose": dict(Counter(climb.chosen for climb in self.inner).most_common())},
            **{key: {"method": name} | final.behind(*pair).json() if name else None
               for key, name in beside.items()
               for pair in [(name, final.chosen) if key == "smaller" else (final.chosen, name)]},
            "next": next((name for name in order[order.index(final.chosen) + 1 :]), ""),
            "wanted": scene.accuracy,
            "parts": [{"group": p.group, "values": list(p.values)} for p in trials.parts],
            "conditions": [{"name": name, "accuracy": value} for name, value in self._conditions()],
            "confused": self._confused(),
        }  # fmt: skip

    def _rung(self, name: str, scene: Scene) -> Json:
        price = self.prices[name]
        told: Json = {
            "method": name,
            "ms": price.ms,
            "kb": price.kb,
            "mb": price.mb,
            "why_not": self.why_not.get(name, ""),
        }
        if price.refused:
            return told | {"ms": None, "kb": None, "mb": None, "used": {}, "accuracy": None, "behind": None}
        told["used"] = {k: round(v, 3) for k, v in price.used(scene.budget).items()}
        scores = self.final.scores.get(name)
        told["accuracy"] = None if scores is None else self.trials.accuracy(scores)
        told["behind"] = None if scores is None else self.final.behind(name).json()
        return told

    def _conditions(self) -> list[tuple[str, float]]:
        _, condition, sweep, probability = self.trials.tested(self.final.chosen)
        right = probability.argmax(1) == self.trials.sweeps.labels[sweep]
        return [(n, round(float(right[condition == c].mean()), 4)) for c, n in enumerate(self.trials.conditions)]

    def _confused(self) -> list[Json]:
        """What is taken for what, the most frequent first: shares of the sweeps of a material."""
        _, _, sweep, probability = self.trials.tested(self.final.chosen)
        names, counts = self.trials.sweeps.materials, np.zeros((probability.shape[1],) * 2)
        np.add.at(counts, (self.trials.sweeps.labels[sweep], probability.argmax(1)), 1)
        shares = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        wrong = [(shares[a, b], a, b) for a, b in np.argwhere((shares > 0) & ~np.eye(len(names), dtype=bool))]
        return [
            {"is": names[a], "named": names[b], "share": round(float(share), 4)}
            for share, a, b in sorted(wrong, reverse=True)
        ]


def choose(sweeps: Dataset, scene: Scene, effort: methods.Effort, where: Where, log: Log) -> Selection:
    """Climb the ladder. Raises NothingFits where no rung can be taken, and FormatError where the scene cannot be judged."""
    trials = Trials(sweeps, scene, effort, where, log)
    alone = [p for p in range(len(trials.parts)) if not trials.seen_from(p)]
    for p in alone:
        raise FormatError(f"{scene.path.name}: without {trials.parts[p].group} {trials.parts[p].values[0]} nothing is left "
                          "to choose by; a group that varies needs three values: one to train on, one to choose by, one "
                          "to judge the choice by")  # fmt: skip
    prices = rungs.prices(rungs.ladder(scene), sweeps, scene, effort, where, log)
    why_not = {name: price.refused or _over(price, scene) for name, price in prices.items()}
    final, inner = SizeSearch(trials, None), [SizeSearch(trials, p) for p in range(len(trials.parts))]
    for name in prices:
        if why_not[name]:
            continue
        why_not[name] = final.enough(name)
        climbing = [climb for climb in (final, *inner) if not climb.enough(name)]
        try:
            trials.run(name, sorted({unseen for climb in climbing for unseen in climb.needs()}))
        except Refused as e:
            why_not[name] = str(e)
            continue
        for climb in climbing:
            climb.add(name)
    if not final.scores:
        raise NothingFits(_nearest(prices, why_not, scene))
    for p, climb in enumerate(inner):
        trials.run(climb.chosen, [(p,)])
    return Selection(trials, prices, {k: v for k, v in why_not.items() if v}, final, inner)


def _over(price: Price, scene: Scene) -> str:
    """Why a rung does not fit the board, or nothing."""
    limits = {k: getattr(scene.budget, k) for k in ("ms", "kb", "mb")}
    needs = {"ms": price.ms * scene.budget.slower, "kb": price.kb, "mb": price.mb}
    over = [f"{needs[k]:.3g} {k} of {limits[k]:g}" for k, share in price.used(scene.budget).items() if share > 1]
    return f"over the budget: {', '.join(over)}" if over else ""


def _nearest(prices: dict[str, Price], why_not: dict[str, str], scene: Scene) -> str:
    """Why nothing could be taken, with the rung that is least over the budget."""
    over = {
        name: max(prices[name].used(scene.budget).values()) for name, why in why_not.items() if why.startswith("over")
    }
    if not over:
        return "; ".join(f"{name} cannot be used here: {why}" for name, why in why_not.items())
    name = min(over, key=lambda name: over[name])
    return f"no model fits the board; nearest is {name}, {why_not[name]}: raise the budget, or record shorter sweeps"
