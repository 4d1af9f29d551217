"""Trainings for the figures on uncertainty, kept in a cache as Cases.

A Case is one training, on all materials or all but one, with the features of every sweep. All
figures are computed from Cases without another training. Sweeps to which a rule, a limit or a
temperature is fitted are never test sweeps.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.storage import put
from palpate_train.answer.calibrate import (
    Calibration,
    CalibrationInputs,
    fit_calibration,
    fit_novelty,
)
from palpate_train.answer.embedding import Embedding
from palpate_train.answer.fit_contact import AugmentedCopies
from palpate_train.answer.heads import HeadPlan
from palpate_train.answer.stranger_limits import StrangerLimits
from palpate_train.data.sets import Dataset, digest, join
from palpate_train.evaluate import parallel
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.fold import fingerprint
from palpate_train.models import methods
from palpate_train.models.methods import Effort
from palpate_train.models.recipe.fitted import Fit, calibration_inputs
from palpate_train.onnx_tools.graph_builder import run as run_graph

Array = NDArray[Any]
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
        if where.cache and (case := _load(where.cache / f"{key}.case.npz")):
            done[i] = case
    left = [(i, task) for i, task in enumerate(wanted) if i not in done]
    if left and where.kept:
        raise FormatError(
            f"{len(left)} of {len(wanted)} trainings are not kept; run without --kept first"
        )
    progress = parallel.Progress(len(left), log)
    for (i, task), case in parallel.results(_learn, left, (sweeps,), where.jobs, where.scheduler):
        done[i] = case
        if where.cache:
            _save(case, where.cache / f"{keys[i]}.case.npz")
        out = "" if task.left_out < 0 else f" without {sweeps.materials[task.left_out]}"
        progress(f"{task.method}{out}")
    return [done[i] for i in range(len(wanted))]


def _learn(numbered: tuple[int, CaseTask], sweeps: Dataset) -> Case:
    return learn(numbered[1], sweeps)


def _save(case: Case, path: Path) -> None:
    packed = io.BytesIO()
    arrays: dict[str, Any] = {k: np.asarray(getattr(case, k)) for k in Case.__dataclass_fields__}
    np.savez(packed, **arrays)
    put(path, packed.getvalue(), parents=True)


def _load(path: Path) -> Case | None:
    try:
        with np.load(path, allow_pickle=False) as z:
            arrays = {k: z[k] for k in Case.__dataclass_fields__}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return Case(**{k: v.item() if v.ndim == 0 else v for k, v in arrays.items()})
