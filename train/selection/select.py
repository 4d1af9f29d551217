"""Selects the smallest model that a scene needs, with the reasons.

The candidates are tried from the cheapest up. We choose the cheapest one within one standard error
of the best (Breiman et al. 1984, sec. 3.4.3), with the error of the paired difference. Nested
validation (Stone 1974) estimates the accuracy of such a choice: the choice is repeated without each
part in turn, and that part tests the chosen model.
"""

from __future__ import annotations

import json
import math
import platform
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from appliance.core.errors import ApplianceError, BundleError, FormatError
from appliance.core.storage import put
from train.data.progress import Progress
from train.data.sets import Dataset, digest
from train.evaluation.evaluate import Where
from train.evaluation.fold import fingerprint
from train.export import measure, pack
from train.export.measure import Measurement
from train.metrics.score import confusion, row_shares
from train.models import methods
from train.models.methods import Effort, Method
from train.models.recipe.sizes import SIZES
from train.selection.nested_cv import Difference, Refused, Trials, Unseen
from train.selection.scene import Budget, Scene

Array = NDArray[Any]
Json = dict[str, Any]
Log = Callable[[str], None]
LARGER_WITHOUT_GAIN = 2
"""Number of consecutive larger candidates of a family without a gain that ends the search in it."""


class NothingFits(ApplianceError):
    """No candidate is within the board's budget, or none can work with the scene's sweeps."""


@dataclass(frozen=True)
class BundleCost:
    """The cost of a method's bundle on this machine, in the units of the scene's budget.

    ms: median processor time of a sweep. kb: size of the whole bundle in units of 1000 bytes. mb:
    resident memory in MiB. refused: the reason if it could not be packed; all else is
    NaN then.
    """

    ms: float = math.nan
    kb: float = math.nan
    mb: float = math.nan
    refused: str = ""

    @classmethod
    def of(cls, measurement: Measurement) -> BundleCost:
        """The three figures of a measurement."""
        return cls(measurement.ms_p50, measurement.bundle_kb, measurement.rss_mib)

    def order(self, budget: Budget) -> tuple[float, float]:
        """The sort key of candidates: the larger of the shares of the board's time and of its
        storage.

        If neither has a limit it is the size. Memory does not count, as it is nearly the same for
        all. Ties are sorted by time.
        """
        shares = [share for key, share in self.used(budget).items() if key != "mb"]
        return max(shares, default=self.kb), self.ms

    def used(self, budget: Budget) -> dict[str, float]:
        """The used share of each part of the budget that has a limit."""
        needs = {"ms": self.ms * budget.slower, "kb": self.kb, "mb": self.mb}
        return {
            k: v / limit for k, v in needs.items() if math.isfinite(limit := getattr(budget, k))
        }


def candidates(scene: Scene) -> list[str]:
    """The methods of the scene. By default, the cheap classical methods of the paper, and the
    recipe in all sizes."""
    if scene.methods:
        return list(scene.methods)
    known, sizes = methods.every(), (f"palpate-{name}" for name in SIZES)
    return [name for name in ("L-gauss", "L-svm", "H-svm", *sizes, "palpate") if name in known]


def bundle_costs(
    names: Sequence[str],
    sweeps: Dataset,
    scene: Scene,
    effort: Effort,
    where: Where,
    progress: Progress,
) -> dict[str, BundleCost]:
    """The cost of each method's bundle, the cheapest first and refused ones last.

    Bundles are packed one after another and kept. Then they are all measured together, and their
    figures are kept together.
    """
    with tempfile.TemporaryDirectory() as aside:
        kept = (where.cache or Path(aside)) / "bundles"
        found: dict[str, BundleCost] = {}
        folders: dict[str, Path] = {}
        for method in methods.find(names, effort):
            folder, refused = _packed(method, sweeps, scene, kept)
            if refused:
                found[method.name] = BundleCost(refused=refused)
            else:
                folders[method.name] = folder
            progress(f"bundle of {method.name}; all are timed in turns")
        found |= _measured(folders, sweeps, kept)
    return dict(
        sorted(found.items(), key=lambda item: (bool(item[1].refused), item[1].order(scene.budget)))
    )


def _packed(method: Method, sweeps: Dataset, scene: Scene, kept: Path) -> tuple[Path, str]:
    """The folder of the method's bundle, and the reason if there is none. A bundle in `kept` is not
    packed again."""
    about = [
        "bundle",
        platform.node(),
        digest(sweeps),
        method.name,
        method.effort,
        scene.full_scale,
    ]
    folder = kept / fingerprint(about, methods.module_of(method.name), "train.export.pack")
    reason = folder.with_suffix(".refused")
    if folder.exists():
        return folder, ""
    if reason.exists():
        return folder, reason.read_text()
    try:
        with threadpool_limits(1):
            pack.pack_to_measure(pack.trained(method, sweeps, 1), folder, scene.full_scale or None)
    except (FormatError, BundleError) as e:
        put(reason, str(e).encode(), parents=True)
        return folder, str(e)
    return folder, ""


def _measured(folders: dict[str, Path], sweeps: Dataset, kept: Path) -> dict[str, BundleCost]:
    """The costs of the bundles, measured together; kept costs if the same bundles were measured
    before."""
    if not folders:
        return {}
    about = [platform.node(), *(folder.name for folder in folders.values())]
    record = kept / f"{fingerprint(about, 'train.export.measure')}.json"
    if not record.exists():
        found = measure.measure_all(list(folders.values()), sweeps.samples)
        put(
            record,
            json.dumps([asdict(measurement) for measurement in found]).encode(),
            parents=True,
        )
    measurements = [Measurement(**entry) for entry in json.loads(record.read_text())]
    return {name: BundleCost.of(one) for name, one in zip(folders, measurements, strict=True)}


@dataclass
class SizeSearch:
    """A choice in progress, candidate by candidate in the order of cost. aside: the part that it
    must not use, or None.

    scores: of the candidates so far, as Trials.scores. unchanged: by family, its newest candidate
    and the number of consecutive candidates that changed nothing.
    """

    trials: Trials
    aside: int | None
    scores: dict[str, Array] = field(default_factory=dict)
    unchanged: dict[str, tuple[str, int]] = field(default_factory=dict)

    def enough(self, name: str) -> str:
        """The reason to skip the next candidate `name`, or "" if it could still change the choice.

        There are two reasons: even a faultless model would be within one standard error of the
        current choice; or LARGER_WITHOUT_GAIN consecutive candidates of its family changed nothing,
        and the last was not better than its predecessor.
        """
        if not self.scores:
            return ""
        chosen = self.scores[self.chosen]
        faultless = np.where(np.isfinite(chosen), 1.0, np.nan)
        if self.trials.difference(faultless, chosen).within:
            return "not tried: even a faultless one would be no more than a standard error better"
        if self.unchanged.get(_family(name), ("", 0))[1] >= LARGER_WITHOUT_GAIN:
            return f"not tried: {LARGER_WITHOUT_GAIN} larger ones of its family changed nothing"
        return ""

    def needs(self) -> list[Unseen]:
        """The trainings that a candidate takes."""
        return list(self.trials.seen_from(self.aside).values())

    def add(self, name: str) -> None:
        """Note that the candidate `name` has been tried."""
        before = self.chosen if self.scores else ""
        self.scores[name] = self.trials.scores(name, self.aside)
        last, times = self.unchanged.get(_family(name), ("", 0))
        better = last and not self.trials.difference(self.scores[name], self.scores[last]).within
        self.unchanged[_family(name)] = (
            name,
            (times + 1 if self.chosen == before and not better else 0),
        )

    @property
    def best(self) -> str:
        """The candidate with the highest mean; the cheapest of equal ones."""
        return max(self.scores, key=lambda name: self.trials.mean(self.scores[name]))

    @property
    def chosen(self) -> str:
        """The cheapest candidate within one standard error of the best."""
        return next(name for name in self.scores if self.behind(name).within)

    def behind(self, name: str, ahead: str = "") -> Difference:
        """The difference between another candidate, usually the best, and `name`."""
        return self.trials.difference(self.scores[ahead or self.best], self.scores[name])


def _family(name: str) -> str:
    return name.partition("-")[0]


@dataclass(frozen=True)
class Selection:
    """The result of a choice. costs: of all candidates, the cheapest first. why_not: by candidate,
    the reason why it was not tried. final: the choice with all data. inner: the choice without each
    part in turn."""

    trials: Trials
    costs: dict[str, BundleCost]
    why_not: dict[str, str]
    final: SizeSearch
    inner: list[SizeSearch]

    @property
    def nested(self) -> Array:
        """Scores [groups, N] of the models chosen without each part on that part, which estimate
        the accuracy of the choice."""
        scores = np.full_like(self.final.scores[self.final.chosen], np.nan)
        for p, search in enumerate(self.inner):
            part = self.trials.parts[p]
            right = self.trials.right(search.chosen, (p,))
            scores[self.trials.groups.index(part.group), part.out] = right[part.out]
        return scores

    def json(self, scene: Scene) -> Json:
        """The result for scripts."""
        trials, final = self.trials, self.final
        order = list(self.costs)
        return {
            "chosen": final.chosen,
            "best": final.best,
            "rungs": [self._candidate(name, scene) for name in order],
            "accuracy": trials.accuracy(final.scores[final.chosen]),
            "honest": self._nested_json(),
            **dict(self._neighbours()),
            "next": next(iter(order[order.index(final.chosen) + 1 :]), ""),
            "wanted": scene.accuracy,
            "parts": [{"group": p.group, "values": list(p.values)} for p in trials.parts],
            "conditions": [{"name": name, "accuracy": value} for name, value in self._conditions()],
            "confused": self._confused(),
        }

    def _nested_json(self) -> Json:
        """Accuracy of the nested choice, also by group, and how often each candidate was chosen."""
        trials, scores = self.trials, self.nested
        number = np.arange(len(trials.groups))[:, None]
        groups = {
            name: trials.accuracy(np.where(number == g, scores, np.nan))
            for g, name in enumerate(trials.groups)
        }
        chose = Counter(search.chosen for search in self.inner)
        return trials.accuracy(scores) | {"groups": groups, "chose": dict(chose.most_common())}

    def _neighbours(self) -> Iterator[tuple[str, Json | None]]:
        """The candidates tried just before and after the chosen one, with their difference from
        it."""
        tried = list(self.final.scores)
        chosen = self.final.chosen
        at = tried.index(chosen)
        smaller, larger = (
            tried[at - 1] if at else "",
            tried[at + 1] if at + 1 < len(tried) else "",
        )
        yield (
            "smaller",
            {"method": smaller} | self.final.behind(smaller, chosen).json() if smaller else None,
        )
        yield (
            "larger",
            {"method": larger} | self.final.behind(chosen, larger).json() if larger else None,
        )

    def _candidate(self, name: str, scene: Scene) -> Json:
        cost = self.costs[name]
        entry: Json = {
            "method": name,
            "ms": cost.ms,
            "kb": cost.kb,
            "mb": cost.mb,
            "why_not": self.why_not.get(name, ""),
        }
        if cost.refused:
            return entry | {
                "ms": None,
                "kb": None,
                "mb": None,
                "used": {},
                "accuracy": None,
                "behind": None,
            }
        scores = self.final.scores.get(name)
        return entry | {
            "used": {k: round(v, 3) for k, v in cost.used(scene.budget).items()},
            "accuracy": None if scores is None else self.trials.accuracy(scores),
            "behind": None if scores is None else self.final.behind(name).json(),
        }

    def _conditions(self) -> list[tuple[str, float]]:
        _, condition, sweep, probability = self.trials.tested(self.final.chosen)
        right = probability.argmax(1) == self.trials.sweeps.labels[sweep]
        return [
            (n, round(float(right[condition == c].mean()), 4))
            for c, n in enumerate(self.trials.conditions)
        ]

    def _confused(self) -> list[Json]:
        """Confused pairs of materials, the most frequent first: shares of the sweeps of a
        material."""
        _, _, sweep, probability = self.trials.tested(self.final.chosen)
        sweeps = self.trials.sweeps
        names, shares = sweeps.materials, row_shares(confusion(sweeps.labels[sweep], probability))
        wrong = [
            (shares[a, b], a, b)
            for a, b in np.argwhere((shares > 0) & ~np.eye(len(names), dtype=bool))
        ]
        return [
            {"is": names[a], "named": names[b], "share": round(float(share), 4)}
            for share, a, b in sorted(wrong, reverse=True)
        ]


def choose(
    sweeps: Dataset,
    scene: Scene,
    effort: Effort,
    where: Where,
    log: Log,
    later: Callable[[Trials], int] = lambda _: 0,
) -> Selection:
    """Search the candidates from the cheapest up. later: number of trainings that follow, for the
    progress.

    Raises NothingFits if no candidate can be used, and FormatError if the scene cannot be judged.
    """
    progress = Progress(0, log)
    trials = Trials(sweeps, scene, effort, where, progress)
    for p in (p for p in range(len(trials.parts)) if not trials.seen_from(p)):
        raise FormatError(
            f"{scene.path.name}: without {trials.parts[p].group} "
            f"{trials.parts[p].values[0]} nothing is left "
            "to choose by; a group that varies needs three values: one to train on, one to "
            "choose by, one "
            "to judge the choice by"
        )
    names = candidates(scene)
    progress.left(len(names) * (1 + trials.most) + later(trials))
    costs = bundle_costs(names, sweeps, scene, effort, where, progress)
    why_not = {name: cost.refused or _over(cost, scene) for name, cost in costs.items()}
    final, inner = (
        SizeSearch(trials, None),
        [SizeSearch(trials, p) for p in range(len(trials.parts))],
    )
    for at, name in enumerate(costs):
        progress.left(
            sum(not why_not[other] for other in [*costs][at:]) * trials.most + later(trials)
        )
        if why_not[name]:
            continue
        why_not[name] = final.enough(name)
        searching = [search for search in (final, *inner) if not search.enough(name)]
        try:
            trials.run(name, sorted({unseen for search in searching for unseen in search.needs()}))
        except Refused as e:
            why_not[name] = str(e)
            continue
        for search in searching:
            search.add(name)
    if not final.scores:
        raise NothingFits(_nearest(costs, why_not, scene))
    for p, search in enumerate(inner):
        trials.run(search.chosen, [(p,)])
    return Selection(trials, costs, {k: v for k, v in why_not.items() if v}, final, inner)


def _over(cost: BundleCost, scene: Scene) -> str:
    """Why a candidate does not fit the board, or ""."""
    limits = {k: getattr(scene.budget, k) for k in ("ms", "kb", "mb")}
    needs = {"ms": cost.ms * scene.budget.slower, "kb": cost.kb, "mb": cost.mb}
    over = [
        f"{needs[k]:.3g} {k} of {limits[k]:g}"
        for k, share in cost.used(scene.budget).items()
        if share > 1
    ]
    return f"over the budget: {', '.join(over)}" if over else ""


def _nearest(costs: dict[str, BundleCost], why_not: dict[str, str], scene: Scene) -> str:
    """Why no candidate could be used, with the candidate that exceeds the budget least."""
    over = {
        name: max(costs[name].used(scene.budget).values())
        for name, why in why_not.items()
        if why.startswith("over")
    }
    if not over:
        return "; ".join(f"{name} cannot be used here: {why}" for name, why in why_not.items())
    name = min(over, key=lambda name: over[name])
    return (
        f"no model fits the board; the nearest is {name}, {why_not[name]}: "
        "raise the budget, or record shorter sweeps"
    )
