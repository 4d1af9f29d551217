"""The study of corruptions: one task is one method and one seed, trained and then tested under
every corruption, one at a time and in pairs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.storage import put
from palpate_train.data.corruptions import Change, Corruption, applicable, find
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset, digest
from palpate_train.evaluate import parallel
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.fold import fingerprint
from palpate_train.evaluate.robustness import CorruptionCounts, merge
from palpate_train.models import methods
from palpate_train.models.methods import FULL_EFFORT, Effort, Method, Model, model_inputs

Array = NDArray[Any]
Json = dict[str, Any]
PAIRED = {"gain-down": 0.2, "hum": 0.5, "noise": 0.3, "dead": 1, "lost": 0.05}
"""Faults that occur together, each at one severity, in the order in which a signal meets them."""


def pairs() -> tuple[Corruption, ...]:
    """Each two of PAIRED at once, for any sweeps. Severity 1 means both, 0 none."""
    each = zip(find(list(PAIRED)), PAIRED.values(), strict=True)
    return tuple(_pair(*first, *second) for first, second in combinations(each, 2))


def _pair(one: Corruption, much: float, other: Corruption, more: float) -> Corruption:
    both = partial(_both, one.change, much, other.change, more)
    name, title = f"{one.name}+{other.name}", f"{one.title} and {other.title}"
    return Corruption(name, title, "", (0, 1), f"{one.about}; {other.about}", both)


def _both(
    one: Change,
    much: float,
    other: Change,
    more: float,
    x: Array,
    severity: float,
    rng: Generator,
    test: EvaluationSweeps,
) -> Array:
    return other(one(x, much * severity, rng, test), more * severity, rng, test)


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
            "palpate_studies.stress",
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
    return evaluate_method(method, train, test, task[1])


def evaluate_method(method: Method, train: Dataset, test: EvaluationSweeps, seed: int) -> Json:
    """A task: train `method` and test it under the corruptions that apply to the test sweeps.

    If the method cannot work with this set, the reason is in `refused`. Raises FormatError if train
    and test differ in format or materials, which is a mistake of the caller.
    """
    sweeps = test.sweeps
    if (train.format, train.materials) != (sweeps.format, sweeps.materials):
        raise FormatError(
            f"{sweeps.source} ({sweeps.format}, {len(sweeps.materials)} materials) is not of the "
            f"kind of {train.source} ({train.format}, {len(train.materials)} materials); test on "
            "what the methods are trained for"
        )
    try:
        model = method.train(train, model_inputs(method.input, train), seed)
    except FormatError as e:
        return {"method": method.name, "seed": seed, "set": sweeps.source, "refused": str(e)}
    single, paired = CorruptionCounts(test), CorruptionCounts(test)
    clean = _right(method, model, sweeps, sweeps.samples)
    for trials, corruptions in ((single, applicable(test)), (paired, pairs())):
        for corruption in corruptions:
            answers = [
                _right(method, model, sweeps, corruption.apply(test, severity, seed))
                for severity in corruption.severities[1:]
            ]
            trials.add(corruption, [clean, *answers])
    return single.task(method.name, seed, paired.curves)


def _right(method: Method, model: Model, sweeps: Dataset, samples: Array) -> Array:
    """bool [N], the `samples` that get the right label. An answer that is not finite is wrong."""
    logits = np.asarray(model.logits(model_inputs(method.input, replace(sweeps, samples=samples))))
    right: Array = np.isfinite(logits).all(axis=1) & (logits.argmax(axis=1) == sweeps.labels)
    return right
