"""Uncertainty of answers: calibration error, and detection of materials that were not trained.

All figures are of test sweeps that nothing was fitted to. They are computed from Cases, which are
kept in a cache: one training, on all materials or all but one, with the features of every sweep.
Intervals are 95 %, from a bootstrap over the placements of the skin, since the errors of sweeps at
one placement are correlated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.answer.calibrate import (
    Calibration,
    CalibrationInputs,
    fit_calibration,
    fit_novelty,
)
from palpate_train.answer.embedding import Embedding, auroc
from palpate_train.answer.fit_contact import AugmentedCopies
from palpate_train.answer.heads import HeadPlan
from palpate_train.answer.stranger_limits import StrangerLimits
from palpate_train.data.sets import Dataset, digest, join
from palpate_train.evaluate import parallel
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.fold import fingerprint, keep, kept
from palpate_train.models import methods
from palpate_train.models.methods import Effort
from palpate_train.models.recipe.fitted import Fit, calibration_inputs
from palpate_train.onnx_tools.graph_builder import run as run_graph

Array = NDArray[Any]
Json = dict[str, Any]
SEED = 1
BINS = 10
"""Bins of the reliability diagram and of the calibration error."""
DRAWS = 500
"""Draws of the bootstrap."""
Log = Callable[[str], None]
NONE_LEFT_OUT = -1
"""The value of left_out if no material is left out."""


@dataclass(frozen=True, eq=False)
class CaseTask:
    """One training. train, test: numbers of sweeps. left_out: a material, or NONE_LEFT_OUT."""

    method: str
    effort: Effort
    seed: int
    train: Array
    test: Array
    left_out: int = NONE_LEFT_OUT


@dataclass(frozen=True, eq=False)
class Case:
    """The result of one training. left_out: the material without training sweeps. fixed: number of
    features that were not trained; they are the last ones.

    seen: features [N, 10, F] of prefixes of the training sweeps. seen_labels [N]: their materials,
    numbered from 0 without left_out. seen_groups [G, N]: values of the conditions, the hardest
    first. held: bool [N], the sweeps that trained stages did not see; staged: whether there are
    such stages. copied: features [M, F] of augmented copies, with copied_labels, copied_source and
    copied_held [M]; see AugmentedCopies. faulty: bool [N] of the seen sweeps; see
    CalibrationInputs. new, labels,
    places: features of the test sweeps, the set's labels, and the placements of the skin. plan:
    HeadPlan.json as text. logits: float32 [n, K] of the test sweeps by the training itself.
    """

    left_out: int
    fixed: int
    seen: Array
    seen_labels: Array
    seen_groups: Array
    held: Array
    staged: bool
    copied: Array
    copied_labels: Array
    copied_source: Array
    copied_held: Array
    new: Array
    labels: Array
    places: Array
    faulty: Array
    plan: str = ""
    logits: Array = field(default_factory=lambda: np.empty((0, 0), np.float32))

    def known(self) -> Array:
        """bool [n], the test sweeps of materials that were trained."""
        known: Array = self.labels != self.left_out
        return known

    def calibration(self) -> Calibration:
        """The calibration that is fitted on the trunk of this training."""
        return fit_calibration(self.inputs())

    def novelty(self) -> tuple[Embedding, StrangerLimits]:
        """The embedding and the limits of this calibration, without its heads."""
        embedding, _, limits = fit_novelty(self.inputs())
        return embedding, limits

    def inputs(self) -> CalibrationInputs:
        """The inputs of its calibration."""
        copies = AugmentedCopies(
            self.copied, self.copied_labels, self.copied_source, self.copied_held
        )
        plan = HeadPlan.read(json.loads(self.plan)) if self.plan else None
        return CalibrationInputs(
            self.seen,
            self.seen_labels,
            {str(number): values for number, values in enumerate(self.seen_groups)},
            self.held,
            bool(self.staged),
            self.fixed,
            copies,
            self.faulty,
            plan,
        )

    def without(self, material: int) -> Case:
        """The same trunk with heads, embedding and limits that have not seen a material, from a
        training on all. `learn` without the material would choose other features, too."""
        seen, copied = self.seen_labels != material, self.copied_labels != material
        return replace(
            self,
            left_out=material,
            seen=self.seen[seen],
            seen_labels=_closed(self.seen_labels[seen], material),
            seen_groups=self.seen_groups[:, seen],
            held=self.held[seen],
            faulty=self.faulty[seen],
            copied=self.copied[copied],
            copied_labels=_closed(self.copied_labels[copied], material),
            copied_source=(np.cumsum(seen) - 1)[self.copied_source[copied]],
            copied_held=self.copied_held[copied],
        )

    def numbered(self) -> Array:
        """The test sweeps' labels [n], numbered like `seen_labels`. Labels of the material left
        out have no meaning."""
        if self.left_out == NONE_LEFT_OUT:
            return self.labels
        return _closed(self.labels, self.left_out)


FIELDS = tuple(Case.__dataclass_fields__)


def _closed(labels: Array, material: int) -> Array:
    """Labels without the number of a material."""
    return labels - (labels > material)


def learn(task: CaseTask, sweeps: Dataset) -> Case:
    """Train, and compute the features of every sweep with the trained trunk.

    Raises FormatError if the method is not one of ours, or cannot work with this set.
    """
    (method,) = methods.find([task.method], task.effort)
    if not methods.module_of(task.method).startswith("palpate_train.models.recipe."):
        raise FormatError(
            f"method {task.method!r} gives no features of the tenths of a sweep; "
            "use palpate or one of its sizes"
        )
    kept = task.train[sweeps.labels[task.train] != task.left_out]
    part = sweeps.take(kept)
    if task.left_out != NONE_LEFT_OUT:
        others = tuple(m for k, m in enumerate(part.materials) if k != task.left_out)
        part = replace(part, labels=_closed(part.labels, task.left_out), materials=others)
    trained = method.train(part, part.samples, task.seed)
    made: Fit = trained.fit  # type: ignore[attr-defined]
    given = calibration_inputs(made, early=True, displaced=True)
    copies = given.copied
    places = sweeps.groups.get("position", sweeps.group("recording"))
    return Case(
        task.left_out,
        given.fixed,
        given.prefixes,
        given.labels,
        np.stack(list(given.conditions.values())),
        given.held,
        given.staged,
        copies.features,
        copies.labels,
        copies.source,
        copies.held,
        run_graph(made.trunk(prefixes=True), sweeps.samples[task.test]),
        sweeps.labels[task.test],
        places[task.test],
        given.faulty,
        json.dumps(given.plan.json()) if given.plan else "",
        trained.logits(sweeps.samples[task.test]),
    )


def train_and_test(train: Dataset, test: Dataset) -> tuple[Dataset, Array, Array]:
    """Both sets as one, and the numbers of the sweeps of each. Raises FormatError if they do not
    fit together."""
    both = join([train.require_materials(), test])
    numbers = np.arange(len(both))
    return both, numbers[: len(train)], numbers[len(train) :]


def cases(wanted: Sequence[CaseTask], sweeps: Dataset, where: Where, log: Log) -> list[Case]:
    """The Case of each task in order, from the cache or from a new training. log: receives the
    progress."""
    data, done = digest(sweeps), {}
    keys = [
        fingerprint(
            [data, t.method, t.effort.share, t.seed, t.train.tolist(), t.test.tolist(), t.left_out],
            methods.module_of(t.method),
            "palpate_train.models.recipe.fitted",
        )
        for t in wanted
    ]
    for i, key in enumerate(keys):
        if where.cache and (
            found := kept(where.cache / f"{key}.case.npz", Case.__dataclass_fields__)
        ):
            done[i] = Case(**found)
    left = [(i, task) for i, task in enumerate(wanted) if i not in done]
    if left and where.kept:
        raise FormatError(
            f"{len(left)} of {len(wanted)} trainings are not kept; run without --kept first"
        )
    progress = parallel.Progress(len(left), log)
    for (i, task), case in parallel.results(_learn, left, (sweeps,), where.jobs, where.scheduler):
        done[i] = case
        if where.cache:
            keep(where.cache / f"{keys[i]}.case.npz", vars(case))
        out = "" if task.left_out < 0 else f" without {sweeps.materials[task.left_out]}"
        progress(f"{task.method}{out}")
    return [done[i] for i in range(len(wanted))]


def _learn(numbered: tuple[int, CaseTask], sweeps: Dataset) -> Case:
    return learn(numbered[1], sweeps)


def trained(
    train: Dataset,
    test: Dataset,
    method: str,
    where: Where,
    log: Log,
    effort: Effort = methods.FULL_EFFORT,
) -> Case:
    """One training on all of `train`, with the sweeps of `test`. Raises FormatError if the sets do
    not fit together, or if the method has no features to judge novelty by."""
    both, seen, new = train_and_test(train, test)
    return cases([CaseTask(method, effort, SEED, seen, new)], both, where, log)[0]


def left_out(whole: Case, materials: Sequence[str]) -> Json:
    """`unknown` of the test sweeps if each material in turn is left out of heads, embedding and
    limits of a training on all. One training suffices: its features are chosen with all
    materials."""
    return unknown(map(whole.without, range(len(materials))), materials)


def error(confidence: Array, right: Array) -> float:
    """Expected calibration error (Naeini et al. 2015): mean over sweeps of |accuracy - probability|
    of their bin."""
    bins = reliability(confidence, right)
    return float(
        sum(b["n"] * abs(b["right"] - b["said"]) for b in bins) / max(sum(b["n"] for b in bins), 1)
    )


def reliability(confidence: Array, right: Array) -> list[Json]:
    """For each non-empty bin of the highest probability [n]: its mean (`said`), the share of right
    answers, and their number."""
    which = np.minimum((confidence * BINS).astype(int), BINS - 1)
    some = [(which == b) for b in range(BINS) if (which == b).any()]
    return [
        {
            "said": round(float(confidence[i].mean()), 4),
            "right": round(float(right[i].mean()), 4),
            "n": int(i.sum()),
        }
        for i in some
    ]


def unknown(without: Iterable[Case], materials: Sequence[str]) -> Json:
    """Detection of a material that was left out of training, by material and as their mean.

    Gives the AUROC of known test sweeps against sweeps of the material, the share of known sweeps
    below the limit found in training, and of unknown sweeps that pass as known.
    """
    found: dict[str, Json] = {}
    for case in without:
        embedding, limits = case.novelty()
        scores = embedding.novelty(case.new[:, -1]) / limits.balanced
        found[materials[case.left_out]] = _detection(scores, case.known(), case.places)
    mean = {
        name: round(float(np.mean([row[name] for row in found.values()])), 4)
        for name in ("auroc", "kept", "false_known", "false_known_at_95")
    }
    return {"materials": found, "mean": mean}


def _detection(scores: Array, known: Array, places: Array) -> Json:
    """Figures of one material by its `scores` in units of the limit [n]. known: bool [n]."""
    low, high = bootstrap(partial(_auroc_of, scores, known), places)
    at = np.quantile(scores[known], 0.95)
    return {
        "auroc": round(auroc(scores[known], scores[~known]), 4),
        "low": low,
        "high": high,
        "kept": round(float(np.mean(scores[known] <= 1)), 4),
        "false_known": round(float(np.mean(scores[~known] <= 1)), 4),
        "false_known_at_95": round(float(np.mean(scores[~known] <= at)), 4),
        "known": int(known.sum()),
        "unknown": int((~known).sum()),
    }


def _auroc_of(scores: Array, known: Array, some: Array) -> float:
    return auroc(scores[some][known[some]], scores[some][~known[some]])


def bootstrap(figure: Callable[[Array], float], clusters: Array) -> tuple[float, float]:
    """The 95 % interval of `figure`, a function of sweep numbers, from a bootstrap of clusters
    [n]."""
    members = [np.flatnonzero(clusters == c) for c in np.unique(clusters)]
    rng, drawn = np.random.default_rng(0), []
    for _ in range(DRAWS):
        with suppress(FormatError):  # a draw that lacks a kind of sweep has no figure
            drawn.append(
                figure(
                    np.concatenate(
                        [members[c] for c in rng.integers(len(members), size=len(members))]
                    )
                )
            )
    low, high = np.quantile(drawn, (0.025, 0.975)) if drawn else (0.0, 1.0)
    return round(float(low), 4), round(float(high), 4)
