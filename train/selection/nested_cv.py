"""The room of what is left out. In: a scene's sweeps, and what varies there. Out: what a method gets right on each sweep.

The values of every group that varies are drawn into a few parts. A method is trained without one part, or without two,
and tested on them. One training without the parts p and q serves twice: seen from p, which stays unseen until the end,
it is the inner fold that tests on q, and the other way round.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from appliance.core.errors import FormatError
from appliance.inference.classifier import softmax
from train.data.sets import Dataset, digest
from train.data.splitters import Protocol
from train.data.transforms import WHOLE, Change
from train.evaluation import corruptions, parallel
from train.evaluation.corruptions import EvaluationSweeps
from train.evaluation.evaluate import Where, folds
from train.evaluation.fold import Fold, FoldTask
from train.metrics.score import interval
from train.models import methods
from train.selection.scene import Scene

Array = NDArray[Any]
FOLDS = {0: 5, 1: 5, 2: 4}
"""Parts of each group by the number of groups; THREE for more. Five make fifteen trainings of a method, two times four
thirty-six."""
THREE = 3
Unseen = tuple[int, ...]
"""Numbers of the one or two parts that a training does without."""


class Refused(FormatError):
    """A method cannot work with these sweeps."""


@dataclass(frozen=True)
class HeldOutPart:
    """Some values of one group. out: bool [N], its sweeps."""

    group: str
    values: tuple[int, ...]
    out: Array = field(repr=False)


def parts(sweeps: Dataset, varies: Sequence[str], folds: int = 0) -> list[HeldOutPart]:
    """The parts of all groups `varies`; of recordings, materials spread evenly, where nothing varies.

    Raises FormatError where a group has a single value, cuts recordings, or takes a material along when left out.
    """
    most = folds or FOLDS.get(len(varies), THREE)
    if not varies:
        recordings = sweeps.group("recording")
        drawn = Protocol(f"random:{most}").folds(sweeps, 1)
        return [_part(sweeps, "recording", np.unique(recordings[test])) for _, test in drawn]
    found = []
    for name in varies:
        values = np.unique(sweeps.group(name))
        if len(values) < 2:
            raise FormatError(f"{sweeps.source}: group {name!r} has one value, {values[0]}; take it out of varies")
        mixed = np.random.default_rng(0).permutation(values)
        found += [_part(sweeps, name, some) for some in np.array_split(mixed, min(most, len(values)))]
    return found


def _part(sweeps: Dataset, name: str, values: Array) -> HeldOutPart:
    told = ", ".join(map(str, sorted(values.tolist())[:5]))
    out = np.isin(sweeps.group(name), values)
    recording = sweeps.group("recording")
    if set(recording[out]) & set(recording[~out]):
        raise FormatError(f"{sweeps.source}: group {name!r} cuts recordings in two; take it out of varies")
    for label in np.setdiff1d(sweeps.labels[out], sweeps.labels[~out]):
        raise FormatError(f"{sweeps.source}: without {name} {told} there is no {sweeps.materials[label]!r} to train on; "
                          f"record it elsewhere too, or take {name!r} out of varies")  # fmt: skip
    return HeldOutPart(name, tuple(sorted(values.tolist())), out)


@dataclass(frozen=True)
class Difference:
    """How far one method is behind another: the mean share of sweeps, its standard error, its 95 % interval."""

    mean: float
    se: float
    low: float
    high: float

    @property
    def within(self) -> bool:
        """Not more than one standard error."""
        return self.mean <= self.se + 1e-12

    def json(self) -> dict[str, float]:
        """As scripts read it."""
        return {k: round(v, 4) for k, v in vars(self).items()}


class Trials:
    """Trains and tests on a scene's sweeps, each training once. sweeps: as they are; asked: with those under stress.

    conditions: names of what the test sweeps are under, of which each counts the same; the first is nothing.
    """

    def __init__(
        self, sweeps: Dataset, scene: Scene, effort: methods.Effort, where: Where, log: Callable[[str], None]
    ) -> None:
        self.sweeps, self._effort, self._where, self._log = sweeps, effort, where, log
        self.seeds = range(1, scene.seeds + 1)
        self.parts = parts(sweeps, scene.varies, scene.folds)
        self.groups = list(dict.fromkeys(part.group for part in self.parts))
        self.clusters = np.stack([sweeps.group(name) for name in self.groups])
        found = corruptions.find(list(scene.stress))
        self.conditions = ["as recorded", *(f"{s.name} {scene.stress[s.name]:g} {s.unit}" for s in found)]
        under = [s.apply(EvaluationSweeps(sweeps), scene.stress[s.name], 1) for s in found]
        many = len(self.conditions)
        self.asked = replace(
            sweeps, samples=np.concatenate([sweeps.samples, *under]), labels=np.tile(sweeps.labels, many),
            groups={k: np.tile(v, many) for k, v in sweeps.groups.items()},
        )  # fmt: skip
        self._done: dict[Any, Fold] = {}

    def pairs(self) -> list[Unseen]:
        """All two parts without which two materials are left to train on."""
        every = combinations(range(len(self.parts)), 2)
        return [u for u in every if len(np.unique(self.sweeps.labels[self._left(u)])) > 1]

    def run(self, method: str, what: Sequence[Unseen], changes: Sequence[Change] = ()) -> None:
        """Train `method` without each of `what`; changes: of the sweeps, one for each of `what`. Raises Refused."""
        changes = changes or [WHOLE] * len(what)
        left = [(method, c, s, u) for u, c in zip(what, changes, strict=True) for s in self.seeds
                if (method, c, s, u) not in self._done]  # fmt: skip
        (known,) = methods.find([method], self._effort)
        progress = parallel.Progress(len(left), self._log)
        for change in dict.fromkeys(name[1] for name in left):
            changed = change.of(self.asked)
            tasks = {
                name: FoldTask(method, self._effort, name[2], *self._split(name[3]))
                for name in left
                if name[1] == change
            }
            for name, fold in folds(tasks, changed, digest(changed), known.input, self._where):
                self._done[name] = fold
                progress(f"{method}{'' if change == WHOLE else f', {change}'}")
        for name in ((method, c, s, u) for u, c in zip(what, changes, strict=True) for s in self.seeds):
            if self._done[name].refused:
                raise Refused(self._done[name].refused)

    def _left(self, unseen: Unseen) -> Array:
        return ~np.any([self.parts[p].out for p in unseen], axis=0)

    def _split(self, unseen: Unseen) -> tuple[Array, Array]:
        """Numbers of sweeps of `asked`: sound ones to train on, all conditions to test on."""
        left = self._left(unseen)
        return np.flatnonzero(left), np.flatnonzero(np.tile(~left, len(self.conditions)))

    def folds(self, method: str, unseen: Unseen, change: Change = WHOLE) -> Iterator[tuple[int, Array, Array]]:
        """What `run` found, for each seed and condition: the condition's number, sweeps [n], logits [n, K]."""
        for seed in self.seeds:
            fold = self._done[method, change, seed, unseen]
            condition, sweep = np.divmod(fold.test, len(self.sweeps))
            for c in range(len(self.conditions)):
                mine = condition == c
                yield c, sweep[mine], fold.logits[mine]

    def right(self, method: str, unseen: Unseen, change: Change = WHOLE) -> Array:
        """Share [N] of the seeds and conditions in which each sweep was named rightly; not a number where not tested."""
        total = np.zeros(len(self.sweeps))
        for _, sweep, logits in self.folds(method, unseen, change):
            total[sweep] += logits.argmax(1) == self.sweeps.labels[sweep]
        total[self._left(unseen)] = np.nan
        return total / (len(self.seeds) * len(self.conditions))

    def scores(self, method: str, aside: int | None = None, changes: Sequence[Change] = ()) -> Array:
        """`right` of every sweep when its own part is left out, [groups, N].

        aside: a part that no training and no test saw; not a number there. changes: of the sweeps, one for each part.
        """
        rows = np.full((len(self.groups), len(self.sweeps)), np.nan)
        keys = self.seen_from(aside)
        for (p, unseen), change in zip(keys.items(), changes or [WHOLE] * len(keys), strict=True):
            inside = self.parts[p].out if aside is None else self.parts[p].out & ~self.parts[aside].out
            rows[self.groups.index(self.parts[p].group), inside] = self.right(method, unseen, change)[inside]
        return rows

    def seen_from(self, aside: int | None) -> dict[int, Unseen]:
        """By part that is tested on, what the training does without: it alone, or it and the part `aside`."""
        if aside is None:
            return {p: (p,) for p in range(len(self.parts))}
        pairs = [u for u in self.pairs() if aside in u]
        return {u[u[0] == aside]: u for u in pairs}

    def difference(self, better: Array, worse: Array) -> Difference:
        """Of two methods' `scores`, sweep by sweep: what both find hard does not count.

        The standard error is that of the mean over values of the group, which fail together, or that over sweeps where
        it is larger: a few values may agree by chance. Of several groups it is the mean of theirs, as if they failed
        together too.
        """
        means, errors, freedom = [], [], []
        for lost, cluster in zip(better - worse, self.clusters, strict=True):
            there = np.isfinite(lost)
            if there.any():
                mean, error, n = _error(lost[there], cluster[there])
                means, errors, freedom = [*means, mean], [*errors, error], [*freedom, n - 1]
        mean, se = float(np.mean(means)), float(np.mean(errors))
        wide = float(student.ppf(0.975, max(min(freedom), 1))) * se
        return Difference(mean, se, mean - wide, mean + wide)

    def mean(self, scores: Array) -> float:
        """Mean over groups of the share that is right."""
        return float(np.mean([np.nanmean(row) for row in scores if np.isfinite(row).any()]))

    def accuracy(self, scores: Array) -> dict[str, float]:
        """`mean`, and the mean of the groups' 95 % intervals."""
        ends = [interval(row[there], cluster[there]) for row, cluster in zip(scores, self.clusters, strict=True)
                if (there := np.isfinite(row)).any()]  # fmt: skip
        low, high = np.mean(ends, axis=0)
        return {"mean": round(self.mean(scores), 4), "low": round(float(low), 4), "high": round(float(high), 4)}

    def tested(self, method: str) -> tuple[Array, Array, Array, Array]:
        """All tests with one part left out: group, condition and sweep [n], probabilities [n, K]."""
        held: list[tuple[Array, ...]] = []
        for p, part in enumerate(self.parts):
            for c, sweep, logits in self.folds(method, (p,)):
                group = np.full(len(sweep), self.groups.index(part.group))
                held.append((group, np.full(len(sweep), c), sweep, softmax(logits)))
        group, condition, sweep, probability = (np.concatenate(column) for column in zip(*held, strict=True))
        return group, condition, sweep, probability


def _error(lost: Array, cluster: Array) -> tuple[float, float, int]:
    """Mean of `lost` [n], its standard error, and how many clusters there are."""
    member = np.unique(cluster, return_inverse=True)[1]
    mean, n = float(lost.mean()), int(member.max()) + 1
    alone = float(lost.std(ddof=1)) / np.sqrt(len(lost)) if len(lost) > 1 else 0.0
    together = np.bincount(member, lost - mean)
    grouped = np.sqrt(n / (n - 1) * np.sum(together**2)) / len(lost) if n > 1 else 0.0
    return mean, max(alone, float(grouped)), n
