"""Evaluation of methods on a sweep set: one Result for each method, protocol and seed.

Every fold is one task. parallel.py runs the tasks, and a cache keeps the results, so that an
interrupted run continues.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data.sets import Dataset, digest
from palpate_train.data.splitters import Protocol, draw
from palpate_train.evaluate import parallel
from palpate_train.evaluate.fold import AsTheBox, Fold, FoldTask, key, run
from palpate_train.metrics.score import (
    REFUSED,
    UNKNOWN,
    confusion,
    fuse,
    interval,
    outcomes,
    provenance,
    score_entry,
)
from palpate_train.models import methods as known_methods
from palpate_train.models.methods import FULL_EFFORT, Effort
from palpate_train.onnx_tools import parity

Array = NDArray[Any]
PACKED = "palpate_train.models.recipe.palpate"
"""The module of the methods whose models export packs."""
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "palpate"


@dataclass(frozen=True)
class Result:
    """The result of a method under a protocol with one seed. folds: in the order of the splitter.
    origin: the set's digest and score.provenance."""

    method: str
    protocol: str
    means_removed: bool
    seed: int
    sweeps: Dataset = field(repr=False)
    folds: list[Fold] = field(repr=False)
    origin: dict[str, str] = field(default_factory=dict)

    @property
    def refused(self) -> str:
        """Why the method cannot work with this set, or ""; after a refusal all other results are
        missing."""
        return next((fold.refused for fold in self.folds if fold.refused), "")

    @property
    def test(self) -> Array:
        """Numbers [n] of the tested sweeps."""
        return np.concatenate([fold.test for fold in self.folds])

    @property
    def logits(self) -> Array:
        """Logits float32 [n, K] of the tested sweeps."""
        return np.concatenate([fold.logits for fold in self.folds])

    def json(self) -> dict[str, Any]:
        """The result for scripts; every count has its 95 % interval."""
        logits, sweeps = self.logits, self.sweeps
        result: dict[str, Any] = {
            "method": self.method,
            "protocol": self.protocol,
            "means_removed": self.means_removed,
            "seed": self.seed,
        } | self._counts(logits)
        if forms := self.folds[0].forms:
            result["forms"] = {name: self._form(name) for name in forms}
        times = {
            "fit_s": round(float(np.median([f.fit_s for f in self.folds])), 3),
            "ms_p50": round(float(np.median([f.ms for f in self.folds])), 4),
        }
        ran = sorted({f.ran for f in self.folds} - {""})
        return (
            result
            | {"box": self._box()}
            | times
            | {
                "folds": len(self.folds),
                "agreement": min(f.agreement for f in self.folds),
                "ran": ", ".join(ran),
                "materials": list(sweeps.materials),
                "confusion": confusion(sweeps.labels[self.test], logits).tolist(),
                "set": sweeps.source,
                "format": sweeps.format.json(),
            }
            | self.origin
        )

    def _counts(self, logits: Array) -> dict[str, Any]:
        """Right answers by window, and by recording if the set has recordings."""
        labels, recording = self.sweeps.labels[self.test], self.sweeps.group("recording")[self.test]
        clusters = self._clusters(self.test)
        right = logits.argmax(1) == labels
        counts: dict[str, Any] = {
            "window": score_entry(right),
            "interval": interval(right, clusters),
        }
        if "recording" in self.sweeps.groups:
            whole, first = fuse(logits, recording)
            right = whole.argmax(1) == labels[first]
            counts["recording"] = score_entry(right)
            counts["recording_interval"] = interval(
                right, None if clusters is None else clusters[first]
            )
        return counts

    def _box(self) -> dict[str, Any] | None:
        """Counts of the box's answers; None if there are none. Folds that export refuses are left
        out and named."""
        packed = [fold for fold in self.folds if len(fold.box)]
        refused = [fold.not_packed for fold in self.folds if fold.not_packed]
        if not packed and not refused:
            return None
        box: dict[str, Any] = {"not_packed": refused}
        if packed:
            test, labels, sure = (
                np.concatenate([getattr(fold, name) for fold in packed])
                for name in ("test", "box", "sure")
            )
            became = outcomes(labels, sure, self.sweeps.labels[test])
            right = became.pop("right")
            box |= score_entry(right) | {name: int(of.sum()) for name, of in became.items()}
            box["interval"] = interval(right, self._clusters(test))
        return box

    def _clusters(self, test: Array) -> Array | None:
        """The groups of the sweeps `test` for intervals; None if each sweep is its own."""
        clusters = Protocol(self.protocol).clusters(self.sweeps)
        return None if clusters is None else clusters[test]

    def each_fold(self) -> list[dict[str, Any]]:
        """Each fold for scripts: the values that it leaves out, and every sweep's answers."""
        return [
            {
                "left_out": Protocol(self.protocol).left_out(self.sweeps, fold.test),
                "tested": len(fold.test),
                "not_packed": fold.not_packed,
                "answers": [self._answer(fold, i) for i in range(len(fold.test))],
            }
            for fold in self.folds
        ]

    def _answer(self, fold: Fold, i: int) -> dict[str, Any]:
        materials, sweep = self.sweeps.materials, int(fold.test[i])
        answer = {
            "sweep": sweep,
            "material": materials[self.sweeps.labels[sweep]],
            "label": materials[fold.logits[i].argmax()],
        }
        if not len(fold.box):
            return answer
        label = int(fold.box[i])
        if label < 0:
            return answer | {"box": {UNKNOWN: "unknown", REFUSED: "refused"}[label]}
        named = {"box_label": materials[label]}
        return answer | {"box": "ok" if fold.sure[i] else "unsure"} | named

    def _form(self, name: str) -> dict[str, Any]:
        """The same models in another precision.

        Counts, the distance between the answers (parity.AnswerDifference), and the accuracy that
        int8 loses against float (parity.AccuracyLoss), whichever of the two `name` is.
        """
        logits = np.concatenate([fold.forms[name] for fold in self.folds])
        precise, int8 = (logits, self.logits) if name == "float" else (self.logits, logits)
        labels = self.sweeps.labels[self.test]
        right = precise.argmax(1) == labels, int8.argmax(1) == labels
        lost = parity.loss(*right, self._clusters(self.test))
        figures = asdict(parity.compare(precise, int8)) | asdict(lost)
        return self._counts(logits) | {key: round(value, 4) for key, value in figures.items()}


HEADER = (
    f"{'method':<20} {'protocol':<22} means  {'windows':<30} {'recordings':<30} "
    f"{'fit s':>7} {'ms':>7}  as the box answers"
)


def line(result: dict[str, Any]) -> str:
    """The result of Result.json() as a line under HEADER."""
    means = "out" if result["means_removed"] else "in"
    counts = [_count(result["window"], result["interval"])]
    counts.append(
        _count(result["recording"], result["recording_interval"]) if "recording" in result else ""
    )
    times = f"{result['fit_s']:>7.2f} {result['ms_p50']:>7.3f}"
    names = f"{result['method']:<20} {result['protocol']:<22} {means:<6}"
    return f"{names} {counts[0]:<30} {counts[1]:<30} {times}  {_as_the_box(result['box'])}".rstrip()


def _as_the_box(box: dict[str, Any] | None) -> str:
    """The counts of Result.json()["box"] as text; "" if there are none."""
    if box is None:
        return ""
    parts, why = [], box["not_packed"]
    if "right" in box:
        others = [f"{box[name]} {name}" for name in ("wrong", "unsure", "unknown", "refused")]
        parts.append(", ".join([_count(box, box["interval"]), *others]))
    if why:
        parts.append(f"export refuses {len(why)} fold{'s' * (len(why) > 1)}: {why[0]}")
    return "; ".join(parts)


def _count(count: dict[str, Any], ends: Sequence[float]) -> str:
    right, total = count["right"], count["total"]
    return f"{right}/{total} {right / total:.3f} [{ends[0]:.3f}, {ends[1]:.3f}]"


@dataclass(frozen=True)
class Plan:
    """The runs of an evaluation: every method under every protocol with every seed; and the effort.

    each: training sweeps of each material, which the seed draws from a fold; 0 for all.
    as_the_box: see FoldTask.
    """

    methods: Sequence[str]
    protocols: Sequence[str]
    seeds: Sequence[int] = (1,)
    means_removed: bool = False
    effort: Effort = FULL_EFFORT
    each: int = 0
    as_the_box: AsTheBox | None = None

    def folds(self, sweeps: Dataset, protocol: str, seed: int) -> list[tuple[Array, Array]]:
        """Pairs (training, test) of sweep numbers. Raises FormatError if the protocol does not fit
        the set."""
        pairs = Protocol(protocol).folds(sweeps, seed)
        if not self.each:
            return pairs
        return [(draw(train, sweeps.labels, self.each, seed), test) for train, test in pairs]


@dataclass(frozen=True)
class Where:
    """Where folds run (see parallel.results) and in which folder they are kept; cache None keeps
    none. kept: train nothing and use only kept folds."""

    jobs: int = -1
    scheduler: str = ""
    cache: Path | None = CACHE
    kept: bool = False


def evaluate(
    sweeps: Dataset, plan: Plan, where: Where, log: Callable[[str], None] = lambda line: None
) -> Iterator[Result]:
    """The results in the order in which they are complete. A refused method gives one result for
    each protocol and seed, at once.

    Raises FormatError if a method or protocol is unknown, or if a protocol does not fit the set.
    """
    known = known_methods.find(plan.methods, plan.effort)
    sweeps = sweeps.without_means() if plan.means_removed else sweeps
    origin = {"digest": digest(sweeps)} | provenance()
    splits = {(p, s): plan.folds(sweeps, p, s) for p in plan.protocols for s in plan.seeds}
    packed = [method.name for method in known if known_methods.module_of(method.name) == PACKED]
    progress = parallel.Progress(len(known) * sum(map(len, splits.values())), log)
    for kind in dict.fromkeys(method.input for method in known):
        same = [method.name for method in known if method.input == kind]
        tasks = {
            (name, *split, i): FoldTask(
                name, plan.effort, split[1], *fold, plan.as_the_box if name in packed else None
            )
            for name in same
            for split, parts in splits.items()
            for i, fold in enumerate(parts)
        }
        done: dict[Any, Fold] = {}
        for (name, protocol, seed, i), fold in folds(tasks, sweeps, origin["digest"], kind, where):
            parts = [(name, protocol, seed, k) for k in range(len(splits[protocol, seed]))]
            told = any(done[part].refused for part in parts if part in done)
            done[name, protocol, seed, i] = fold
            progress(f"{name}, {protocol}, seed {seed}, fold {i + 1}")
            whole = [fold] if fold.refused else [done[part] for part in parts if part in done]
            if not told and (fold.refused or len(whole) == len(parts)):
                yield Result(name, protocol, plan.means_removed, seed, sweeps, whole, origin)


def folds(
    tasks: dict[Any, FoldTask], sweeps: Dataset, data: str, kind: str, where: Where
) -> Iterator[tuple[Any, Fold]]:
    """The Fold of every task: those in the cache first, then the others as they finish.

    data: digest of `sweeps`. kind: the input of the tasks' methods; if it cannot be
    computed, all tasks are refused.
    """
    paths = {
        name: where.cache / f"{key(task, data)}.npz" for name, task in tasks.items() if where.cache
    }
    kept = {name: fold for name, path in paths.items() if (fold := Fold.load(path))}
    yield from kept.items()
    left = {name: task for name, task in tasks.items() if name not in kept and not where.kept}
    for name, fold in _trained(list(left.items()), sweeps, kind, where):
        if where.cache:
            fold.save(paths[name])
        yield name, fold


def _trained(
    tasks: Sequence[tuple[Any, FoldTask]], sweeps: Dataset, kind: str, where: Where
) -> Iterator[tuple[Any, Fold]]:
    """The Fold of each named task as it finishes; all are refused if the input `kind` cannot be
    computed."""
    try:
        shared = (sweeps, known_methods.model_inputs(kind, sweeps)) if tasks else ()
    except FormatError as e:
        yield from ((name, Fold.refusal(task, str(e))) for name, task in tasks)
        return
    for (name, _), fold in parallel.results(_run, tasks, shared, where.jobs, where.scheduler):
        yield name, fold


def _run(named: tuple[Any, FoldTask], sweeps: Dataset, inputs: Array) -> Fold:
    return run(named[1], sweeps, inputs)
