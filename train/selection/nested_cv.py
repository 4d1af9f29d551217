"""Nested cross-validation of methods on the sweeps of a scene, over the groups that vary there.

The values of every group that varies are distributed over a few parts. A method is trained without
one part or without two parts, and tested on them. A training without the parts p and q serves two
inner folds: p is held out and q tests, or q is held out and p tests.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from appliance.core.errors import FormatError
from appliance.inference.classifier import softmax
from train.data.progress import Progress
from train.data.sets import Dataset, digest
from train.data.splitters import Protocol
from train.data.transforms import WHOLE, Change
from train.evaluation import corruptions
from train.evaluation.evaluate import Where, folds
from train.evaluation.evaluation_sweeps import EvaluationSweeps
from train.evaluation.fold import Fold, FoldTask
from train.metrics.score import interval
from train.models import methods
from train.selection.scene import Scene

Array = NDArray[Any]
FOLDS = {0: 5, 1: 5, 2: 4}
"""Parts of each group, by the number of groups; MANY_GROUPS for more groups. Five parts take
fifteen trainings of a method, two groups of four parts take thirty-six."""
MANY_GROUPS = 3
Unseen = tuple[int, ...]
"""Numbers of the one or two parts that a training leaves out."""


class Refused(FormatError):
    """A method cannot work with these sweeps."""


@dataclass(frozen=True)
class HeldOutPart:
    """Some values of one group. out: bool [N], the sweeps with these values."""

    group: str
    values: tuple[int, ...]
    out: Array = field(repr=False)


def parts(sweeps: Dataset, varies: Sequence[str], folds: int = 0) -> list[HeldOutPart]:
    """The parts of all groups `varies`. If nothing varies, parts of the recordings, with the
    materials spread evenly.

    Raises FormatError if a group has a single value, if it divides recordings, or if a material has
    no training sweeps without one of the parts.
    """
    most = folds or FOLDS.get(len(varies), MANY_GROUPS)
    if not varies:
        recordings = sweeps.group("recording")
        drawn = Protocol(f"random:{most}").folds(sweeps, 1)
        return [_part(sweeps, "recording", np.unique(recordings[test])) for _, test in drawn]
    found: list[HeldOutPart] = []
    for name in varies:
        values = np.unique(sweeps.group(name))
        if len(values) < 2:
            raise FormatError(
                f"{sweeps.source}: group {name!r} has one value, {values[0]}; take it out of varies"
            )
        shuffled = np.random.default_rng(0).permutation(values)
        found += [
            _part(sweeps, name, some) for some in np.array_split(shuffled, min(most, len(values)))
        ]
    return found


def _part(sweeps: Dataset, name: str, values: Array) -> HeldOutPart:
    first = ", ".join(map(str, sorted(values.tolist())[:5]))
    out = np.isin(sweeps.group(name), values)
    recording = sweeps.group("recording")
    if set(recording[out]) & set(recording[~out]):
        raise FormatError(
            f"{sweeps.source}: group {name!r} cuts recordings in two; take it out of varies"
        )
    for label in np.setdiff1d(sweeps.labels[out], sweeps.labels[~out]):
        raise FormatError(
            f"{sweeps.source}: without {name} {first} there is no "
            f"{sweeps.materials[label]!r} to train on; "
            f"record it elsewhere too, or take {name!r} out of varies"
        )
    return HeldOutPart(name, tuple(sorted(values.tolist())), out)


@dataclass(frozen=True)
class Difference:
    """The difference between two methods: mean share of sweeps, standard error and 95 %
    interval."""

    mean: float
    se: float
    low: float
    high: float

    @property
    def within(self) -> bool:
        """Whether the difference is at most one standard error."""
        return self.mean <= self.se + 1e-12

    def json(self) -> dict[str, float]:
        """The figures for scripts, rounded."""
        return {k: round(v, 4) for k, v in vars(self).items()}


class Trials:
    """Trains and tests on a scene's sweeps; each training runs once. sweeps: as recorded; asked:
    together with the corrupted ones.

    conditions: names of the corruptions of the test sweeps, with equal weights; the first is none.
    progress: counts the trainings.
    """

    def __init__(
        self,
        sweeps: Dataset,
        scene: Scene,
        effort: methods.Effort,
        where: Where,
        progress: Progress,
    ) -> None:
        self.sweeps, self._effort, self._where, self.progress = sweeps, effort, where, progress
        self.seeds = range(1, scene.seeds + 1)
        self.parts = parts(sweeps, scene.varies, scene.folds)
        self.groups = list(dict.fromkeys(part.group for part in self.parts))
        self.clusters = np.stack([sweeps.group(name) for name in self.groups])
        found = corruptions.find(list(scene.stress))
        self.conditions = [
            "as recorded",
            *(f"{s.name} {scene.stress[s.name]:g} {s.unit}" for s in found),
        ]
        corrupted = [s.apply(EvaluationSweeps(sweeps), scene.stress[s.name], 1) for s in found]
        count = len(self.conditions)
        self.asked = replace(
            sweeps,
            samples=np.concatenate([sweeps.samples, *corrupted]),
            labels=np.tile(sweeps.labels, count),
            groups={k: np.tile(v, count) for k, v in sweeps.groups.items()},
        )
        self._done: dict[Any, Fold] = {}

    @property
    def most(self) -> int:
        """The largest number of trainings for one method: without each part, and without each two
        parts."""
        return len(self.seeds) * (len(self.parts) + len(self.pairs()))

    def pairs(self) -> list[Unseen]:
        """All pairs of parts without which two materials are left to train on."""
        every = combinations(range(len(self.parts)), 2)
        return [u for u in every if len(np.unique(self.sweeps.labels[self._kept(u)])) > 1]

    def run(self, method: str, what: Sequence[Unseen], changes: Sequence[Change] = ()) -> None:
        """Train `method` without each of `what`. changes: of the sweeps, one for each of `what`.
        Raises Refused if the method cannot work with them."""
        changes = changes or [WHOLE] * len(what)
        left = [
            (method, c, s, u)
            for u, c in zip(what, changes, strict=True)
            for s in self.seeds
            if (method, c, s, u) not in self._done
        ]
        (known,) = methods.find([method], self._effort)
        for change in dict.fromkeys(name[1] for name in left):
            changed = change.of(self.asked)
            tasks = {
                name: FoldTask(method, self._effort, name[2], *self._split(name[3]))
                for name in left
                if name[1] == change
            }
            for name, fold in folds(tasks, changed, digest(changed), known.input, self._where):
                self._done[name] = fold
                self.progress(f"{method}{'' if change == WHOLE else f', {change}'}")
        for name in (
            (method, c, s, u) for u, c in zip(what, changes, strict=True) for s in self.seeds
        ):
            if self._done[name].refused:
                raise Refused(self._done[name].refused)

    def _kept(self, unseen: Unseen) -> Array:
        """bool [N], the sweeps outside the parts `unseen`."""
        kept: Array = ~np.any([self.parts[p].out for p in unseen], axis=0)
        return kept

    def _split(self, unseen: Unseen) -> tuple[Array, Array]:
        """Numbers of sweeps in `asked`: as recorded for training, in all conditions for the
        test."""
        kept = self._kept(unseen)
        return np.flatnonzero(kept), np.flatnonzero(np.tile(~kept, len(self.conditions)))

    def folds(
        self, method: str, unseen: Unseen, change: Change = WHOLE
    ) -> Iterator[tuple[int, Array, Array]]:
        """The results of `run` for each seed and condition: (number of the condition, sweeps [n],
        logits [n, K])."""
        for seed in self.seeds:
            fold = self._done[method, change, seed, unseen]
            condition, sweep = np.divmod(fold.test, len(self.sweeps))
            for c in range(len(self.conditions)):
                tested = condition == c
                yield c, sweep[tested], fold.logits[tested]

    def right(self, method: str, unseen: Unseen, change: Change = WHOLE) -> Array:
        """Share [N] of the seeds and conditions in which each sweep got the right label; NaN if it
        was not tested."""
        total = np.zeros(len(self.sweeps))
        for _, sweep, logits in self.folds(method, unseen, change):
            total[sweep] += logits.argmax(1) == self.sweeps.labels[sweep]
        total[self._kept(unseen)] = np.nan
        share: Array = total / (len(self.seeds) * len(self.conditions))
        return share

    def scores(
        self, method: str, aside: int | None = None, changes: Sequence[Change] = ()
    ) -> Array:
        """`right` of every sweep by the training without its own part, [groups, N].

        aside: a part that is used neither for training nor for tests; NaN there. changes: of the
        sweeps, one for each part.
        """
        rows = np.full((len(self.groups), len(self.sweeps)), np.nan)
        keys = self.seen_from(aside)
        for (p, unseen), change in zip(keys.items(), changes or [WHOLE] * len(keys), strict=True):
            tested = (
                self.parts[p].out if aside is None else self.parts[p].out & ~self.parts[aside].out
            )
            rows[self.groups.index(self.parts[p].group), tested] = self.right(
                method, unseen, change
            )[tested]
        return rows

    def seen_from(self, aside: int | None) -> dict[int, Unseen]:
        """By tested part, the parts left out of its training: that part alone, or also the part
        `aside`."""
        if aside is None:
            return {p: (p,) for p in range(len(self.parts))}
        pairs = [u for u in self.pairs() if aside in u]
        return {u[u[0] == aside]: u for u in pairs}

    def difference(self, better: Array, worse: Array) -> Difference:
        """The difference of two methods' `scores`, paired by sweep, which removes the effect of
        hard sweeps.

        The standard error is that of the mean over the values of the group, since the sweeps of a
        value are correlated. It is that over sweeps if this is larger, since a few values may agree
        by chance. With several groups it is the mean of theirs, as if they were correlated too.
        """
        means: list[float] = []
        errors: list[float] = []
        freedom: list[int] = []
        for lost, cluster in zip(better - worse, self.clusters, strict=True):
            there = np.isfinite(lost)
            if there.any():
                mean, error, n = _error(lost[there], cluster[there])
                means.append(mean)
                errors.append(error)
                freedom.append(n - 1)
        mean, se = float(np.mean(means)), float(np.mean(errors))
        half_width = float(student.ppf(0.975, max(min(freedom), 1))) * se
        return Difference(mean, se, mean - half_width, mean + half_width)

    def mean(self, scores: Array) -> float:
        """Mean over groups of the share of right answers."""
        return float(np.mean([np.nanmean(row) for row in scores if np.isfinite(row).any()]))

    def accuracy(self, scores: Array) -> dict[str, float]:
        """`mean`, and the mean of the groups' 95 % intervals."""
        ends = [
            interval(row[there], cluster[there])
            for row, cluster in zip(scores, self.clusters, strict=True)
            if (there := np.isfinite(row)).any()
        ]
        low, high = np.mean(ends, axis=0)
        return {
            "mean": round(self.mean(scores), 4),
            "low": round(float(low), 4),
            "high": round(float(high), 4),
        }

    def tested(self, method: str) -> tuple[Array, Array, Array, Array]:
        """All tests with one part left out: group, condition and sweep [n], probabilities [n,
        K]."""
        rows: list[tuple[Array, ...]] = []
        for p, part in enumerate(self.parts):
            for c, sweep, logits in self.folds(method, (p,)):
                group = np.full(len(sweep), self.groups.index(part.group))
                rows.append((group, np.full(len(sweep), c), sweep, softmax(logits)))
        group, condition, sweep, probability = (
            np.concatenate(column) for column in zip(*rows, strict=True)
        )
        return group, condition, sweep, probability


def _error(lost: Array, cluster: Array) -> tuple[float, float, int]:
    """Mean of `lost` [n], its standard error, and the number of clusters."""
    member = np.unique(cluster, return_inverse=True)[1]
    mean, n = float(lost.mean()), int(member.max()) + 1
    by_sweep = float(lost.std(ddof=1)) / np.sqrt(len(lost)) if len(lost) > 1 else 0.0
    sums = np.bincount(member, lost - mean)
    by_cluster = np.sqrt(n / (n - 1) * np.sum(sums**2)) / len(lost) if n > 1 else 0.0
    return mean, max(by_sweep, float(by_cluster)), n
