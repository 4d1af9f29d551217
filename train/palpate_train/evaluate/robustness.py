"""Robustness: accuracy of each method under each corruption.

One task is one method and one seed: `evaluate_method` trains it and tests it under every
corruption. `merge` joins the results of many tasks. The results of tasks and the joined result hold
only numbers and text, for JSON.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle.bundle import Bundle
from palpate.core.config import SweepConfig
from palpate.core.errors import FormatError
from palpate.core.storage import put
from palpate.core.types import Edge, EdgeKind, Frames, SweepFormat, Verdict
from palpate.inference.classifier import Classifier
from palpate.sim.rig import VirtualClock
from palpate.sweeps.sweep_window import SweepCutter
from palpate_train.data.sets import Dataset, digest
from palpate_train.evaluate import parallel
from palpate_train.evaluate.corruption_pairs import pairs
from palpate_train.evaluate.corruptions import Corruption, applicable
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.evaluation_sweeps import EvaluationSweeps
from palpate_train.evaluate.fold import fingerprint
from palpate_train.metrics.score import interval
from palpate_train.models import methods
from palpate_train.models.methods import FULL_EFFORT, Effort, Method, Model, model_inputs

Array = NDArray[Any]
Json = dict[str, Any]
POINTS = 0.05
"""Loss of accuracy at which a method counts as failed, against its own accuracy on clean sweeps."""


def evaluate_method(
    method: Method,
    train: Dataset,
    test: EvaluationSweeps,
    corruptions: Sequence[Corruption] | None,
    seed: int,
) -> Json:
    """A task: train `method` and test it under `corruptions`; None for all that apply to the test
    sweeps.

    If the method cannot work with this set, the reason is in `refused`. Raises FormatError if train
    and test differ in format or materials, which is a mistake of the caller.
    """
    if (train.format, train.materials) != (test.sweeps.format, test.sweeps.materials):
        raise FormatError(
            f"{test.sweeps.source} ({test.sweeps.format}, {len(test.sweeps.materials)} "
            "materials) is "
            f"not of the kind of {train.source} ({train.format}, {len(train.materials)} "
            "materials); "
            "test on what the methods are trained for"
        )
    try:
        model = method.train(train, model_inputs(method.input, train), seed)
    except FormatError as e:
        return {"method": method.name, "seed": seed, "set": test.sweeps.source, "refused": str(e)}
    return evaluate_model(method, model, test, corruptions, seed)


def evaluate_model(
    method: Method,
    model: Model,
    test: EvaluationSweeps,
    corruptions: Sequence[Corruption] | None,
    seed: int,
) -> Json:
    """The result of `evaluate_method` for a trained model. The sweeps depend only on test,
    corruption, severity and seed."""
    single, paired = CorruptionCounts(test), CorruptionCounts(test)
    clean = _right(method, model, test.sweeps, test.sweeps.samples)
    every = (applicable(test), pairs()) if corruptions is None else (corruptions, ())
    for trials, those in zip((single, paired), every, strict=True):
        for corruption in those:
            answers = [
                _right(method, model, test.sweeps, corruption.apply(test, severity, seed))
                for severity in corruption.severities[1:]
            ]
            trials.add(corruption, [clean, *answers])
    return single.task(method.name, seed) | {
        "pairs": paired.curves,
        "ran": getattr(model, "ran", ""),
        "trouble": uninformative_answers(method, model, test),
    }


class CorruptionCounts:
    """Counts right answers to `test` under one corruption after another; `merge` takes the
    result."""

    def __init__(self, test: EvaluationSweeps) -> None:
        self.test, self.curves = test, dict[str, Json]()

    def add(self, corruption: Corruption, answers: Sequence[tuple[Array, int]]) -> None:
        """answers: for each severity, bool [N] of the right answers, and the number of answers that
        were not finite."""
        position = self.test.sweeps.groups.get("position")
        low, high = zip(*(interval(right, position) for right, _ in answers), strict=True)
        self.curves[corruption.name] = {
            "title": corruption.title,
            "unit": corruption.unit,
            "about": corruption.about,
            "severities": [float(s) for s in corruption.severities],
            "right": [int(right.sum()) for right, _ in answers],
            "low": list(low),
            "high": list(high),
            "broken": [broken for _, broken in answers],
        }

    def task(self, name: str, seed: int) -> Json:
        """All counts as a task of the method `name`."""
        sweeps = self.test.sweeps
        return {
            "method": name,
            "seed": seed,
            "set": sweeps.source,
            "refused": "",
            "total": len(sweeps),
            "ran": "",
            "curves": self.curves,
            "pairs": {},
            "trouble": {},
        }


def run(
    names: Sequence[str],
    train: Dataset,
    test: EvaluationSweeps,
    where: Where,
    *,
    seeds: Sequence[int] = (1,),
    effort: Effort = FULL_EFFORT,
    log: Callable[[str], None] = lambda line: None,
) -> Json:
    """All methods and seeds under all corruptions that apply, merged. Kept tasks do not run again.

    Every method runs with the first seed before any method gets the second, so that the results of
    an interrupted run can be compared. Raises FormatError as `evaluate_method` does, and for an
    unknown method.
    """
    about = [digest(train), digest(test.sweeps), test.scene is not None]
    tasks = {
        (method.name, seed): fingerprint(
            [*about, method.name, method.effort, seed],
            methods.module_of(method.name),
            "palpate_train.evaluate.robustness",
        )
        for seed in seeds
        for method in methods.find(names, effort)
    }
    paths = {task: where.cache / f"{key}.json" for task, key in tasks.items() if where.cache}
    done = {task: json.loads(path.read_text()) for task, path in paths.items() if path.exists()}
    left = [task for task in tasks if task not in done and not where.kept]
    progress = parallel.Progress(len(left), log)
    for task, result in parallel.results(
        _run_task, left, (train, test, effort), where.jobs, where.scheduler
    ):
        done[task] = result
        if where.cache:
            put(paths[task], json.dumps(result).encode(), parents=True)
        progress(f"{task[0]} under corruptions, seed {task[1]}")
    result = merge(done.values())
    result["methods"] = {
        name: result["methods"][name] for name in names if name in result["methods"]
    }
    return result


def _run_task(
    task: tuple[str, int], train: Dataset, test: EvaluationSweeps, effort: Effort
) -> Json:
    (method,) = methods.find([task[0]], effort)
    return evaluate_method(method, train, test, None, task[1])


def merge(tasks: Iterable[Json]) -> Json:
    """Join tasks in any order: {"sets": [...], "methods": {name: entry}}.

    An entry holds seeds, refused ("" or the reason), ran, clean (accuracy), curves, pairs and
    trouble; pairs are curves of two corruptions at once. A curve holds title, unit, about,
    severities, right and total (sums), accuracy, low and high, broken (number of answers that were
    not finite; they count as wrong), falls and lost. low and high are the means of the tasks' 95 %
    intervals, extended to the spread of the tasks: seeds share their sweeps, and the interval of
    their sum would be too narrow.
    """
    tasks = sorted(tasks, key=lambda t: (t["set"], t["seed"]))
    names = sorted({t["method"] for t in tasks})
    entries = {name: _entry([t for t in tasks if t["method"] == name]) for name in names}
    return {"sets": sorted({t["set"] for t in tasks}), "methods": entries}


def falls(curve: Json, points: float = POINTS) -> float | None:
    """The severity at which accuracy is `points` below that of clean sweeps, interpolated between
    two severities; None if it never is."""
    severity: list[float] = curve["severities"]
    accuracy: list[float] = curve["accuracy"]
    limit = accuracy[0] - points + 1e-9  # .9 - .05 is less than .85
    for i in range(1, len(accuracy)):
        if accuracy[i] <= limit:
            part = (accuracy[i - 1] - limit) / (accuracy[i - 1] - accuracy[i])
            return round(severity[i - 1] + part * (severity[i] - severity[i - 1]), 6)
    return None


def breaks_first(curves: Mapping[str, Any]) -> list[str]:
    """The corruptions that cost five points, ordered by the share of their range that this
    takes."""
    reach = {
        name: curve["falls"] / curve["severities"][-1]
        for name, curve in curves.items()
        if curve["falls"] is not None
    }
    return sorted(reach, key=lambda name: (reach[name], -curves[name]["lost"], name))


def uninformative_answers(method: Method, model: Model, test: EvaluationSweeps) -> dict[str, str]:
    """The answers of a method on the desktop to sweeps without information, by kind of sweep.

    Each is "finite", "refused: why", "not finite" or "crashed: why". The sweeps pass through the
    same stages as all others: a checked set, the method's input, the model.
    """
    found = {}
    for name, taxels in _uninformative(test.sweeps.format, test.load).items():
        try:
            sweep = Dataset(
                taxels[None], np.zeros(1, int), test.sweeps.materials, test.sweeps.rate_hz, {}, name
            )
            if sweep.format != test.sweeps.format:
                raise FormatError(f"{sweep.format} instead of {test.sweeps.format}")
            logits = model.logits(model_inputs(method.input, sweep))
            found[name] = "finite" if np.isfinite(logits).all() else "not finite"
        except FormatError as e:
            found[name] = f"refused: {e}"
        except Exception as e:  # the table shows any error of a method's libraries
            found[name] = f"crashed: {type(e).__name__}: {e}"
    return found


def box_answers(bundle: Bundle) -> dict[str, str]:
    """The answers of the box to the same sweeps: the status of each verdict, or "not finite" if one
    of its numbers is not."""
    limits = bundle.manifest.thresholds
    found = {}
    for name, taxels in _uninformative(bundle.format, limits.full_scale).items():
        verdict = answer(bundle, taxels)
        finite = np.isfinite([verdict.probability, verdict.margin, *verdict.scores]).all()
        found[name] = verdict.status.value + ("" if finite else ": not finite")
    return found


def answer(bundle: Bundle, taxels: Array) -> Verdict:
    """The box's verdict on frames [n, R, C] that arrive from the START to the STOP edge of one
    sweep."""
    format, n, clock = bundle.format, np.arange(len(taxels)), VirtualClock()
    first_ns = clock.now_ns()
    cutter = SweepCutter(format, SweepConfig())
    t_ns = first_ns + np.rint(n * format.period_ns).astype(np.int64)
    end_ns = first_ns + round(len(taxels) * format.period_ns) + 1
    clock.sleep_until(end_ns + 10 * SweepConfig().late_ms * 1_000_000)
    cutter.put(Frames(t_ns, n, taxels), end_ns)
    cutter.trigger([Edge(EdgeKind.START, first_ns), Edge(EdgeKind.STOP, end_ns)], True, end_ns)
    (sweep,) = cutter.finished(clock.now_ns())
    return Classifier(bundle, clock)(sweep)


def _right(method: Method, model: Model, sweeps: Dataset, samples: Array) -> tuple[Array, int]:
    """bool [N], the `samples` that get the right label, and the number of answers that are not
    finite. Those count as wrong."""
    logits = np.asarray(model.logits(model_inputs(method.input, replace(sweeps, samples=samples))))
    finite = np.isfinite(logits).all(axis=1)
    return finite & (logits.argmax(axis=1) == sweeps.labels), int(np.sum(~finite))


def _entry(tasks: list[Json]) -> Json:
    """The entry of one method from all its tasks."""
    done = [t for t in tasks if not t["refused"]]
    refused = next((t["refused"] for t in tasks if t["refused"]), "")
    entry: Json = {
        "seeds": sorted({t["seed"] for t in done}),
        "refused": refused,
        "clean": None,
        "curves": {},
        "pairs": {},
        "ran": next((t["ran"] for t in done), ""),
        "trouble": {},
    }
    totals = np.array([t["total"] for t in done])
    for kind in ("curves", "pairs"):
        for name in done[0][kind] if done else ():
            entry[kind][name] = _curve([t[kind][name] for t in done], totals)
            entry["clean"] = entry[kind][name]["accuracy"][0]
    for t in done:  # the worst of several answers counts
        for name, status in t["trouble"].items():
            entry["trouble"][name] = max(entry["trouble"].get(name, status), status, key=_badness)
    return entry


def _badness(status: str) -> int:
    return ("finite", "refused", "not finite", "crashed").index(status.split(":")[0])


def _curve(parts: list[Json], totals: Array) -> Json:
    """The joined curve of one method and corruption. totals [tasks]: sweeps of each task."""
    right = np.array([part["right"] for part in parts])  # [tasks, severities]
    shares = right / totals[:, None]
    accuracy = right.sum(axis=0) / totals.sum()
    low = np.minimum(np.mean([part["low"] for part in parts], axis=0), shares.min(axis=0))
    high = np.maximum(np.mean([part["high"] for part in parts], axis=0), shares.max(axis=0))
    curve = {k: parts[0][k] for k in ("title", "unit", "about", "severities")} | {
        "right": right.sum(axis=0).tolist(),
        "total": int(totals.sum()),
        "accuracy": accuracy.round(6).tolist(),
        "low": low.round(4).tolist(),
        "high": high.round(4).tolist(),
        "broken": np.sum([part["broken"] for part in parts], axis=0).tolist(),
        "lost": round(float(np.mean(accuracy[0] - accuracy[1:])), 4),
    }
    return curve | {"falls": falls(curve)}


def _uninformative(format: SweepFormat, top: float) -> dict[str, Array]:
    """Windows [T, R, C] or [T, R, C, A] without information, one of them with a single frame. top:
    the highest count, for a type without a limit."""
    level = np.full((format.window, *format.shape), top / 2).astype(format.numpy_type)
    whole = format.numpy_type.kind != "f"
    found = {
        "silent": 0 * level,
        "constant": level,
        "one-frame": level[:1],
        "saturated": np.full_like(level, np.iinfo(format.numpy_type).max if whole else top),
    }
    for name, value in () if whole else (("nan", np.nan), ("inf", np.inf)):
        found[name] = level.copy()
        found[name][::2] *= 1.125  # not constant
        found[name][len(level) // 2].flat[0] = value
    return found
