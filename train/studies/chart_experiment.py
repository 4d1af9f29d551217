"""The study `chart`: accuracy and costs of every method as a bundle, for speed against accuracy.

Accuracy comes from evaluate and robustness, whose finished folds are cached: an interrupted run
goes on where it was. The costs of all bundles are measured in one run.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from appliance.core.errors import BundleError, FormatError
from train.data import sets
from train.data.sets import Dataset
from train.evaluation import evaluate, parallel, robustness
from train.evaluation.evaluate import Plan
from train.evaluation.evaluation_sweeps import EvaluationSweeps
from train.evaluation.fold import fingerprint
from train.export import measure
from train.metrics import score
from train.models import methods
from train.models.methods import Effort, Method
from train.models.recipe.sizes import SIZES
from train.studies import precisions, stress_targets
from train.studies.method_names import family
from train.studies.precisions import Packed
from train.studies.study import NO_DATA, Study, StudyCase, StudyRun

Json = dict[str, Any]
Accuracy = dict[tuple[str, str], dict[str, Json]]
"""By method and form, then by case: mean, low, high, n, seeds."""
FABRICS = "fabricslide/fabricslide.npz"
SEVEN = ("direction=0", "force<=180")
TRAIN, STRESS = "train", "stress"
"""Cases without a protocol: the sweeps that bundles and stressed methods are trained on, and those
that are corrupted."""
TRAINING = StudyCase(("sim:T-REAL/level-blind:1",))
OURS = ("palpate", *(f"palpate-{size}" for size in SIZES))
PEERS = (
    "L-gauss",
    "L-knn",
    "L-svm",
    "H-knn",
    "H-svm",
    "minirocket",
    "minirocket-augmented",
    "multirocket-hydra",
    "quant",
    "ds-cnn",
    "lite",
    "edge-spectral",
    "tactnet2",
    "paper-cnn-centred",
)
STUDY = Study(
    "chart",
    {
        "hard": StudyCase(
            ("sim:T-REAL/level-blind:1", "sim:T-HARD/level-blind:1-20"), "split:set=0->1"
        ),
        "lopo": StudyCase(("sim:T-REAL/level-blind:1",), "leave:position"),
        "force": StudyCase((FABRICS,), "leave:force", SEVEN, real=True, means_removed=True),
        "speed": StudyCase((FABRICS,), "leave:speed", SEVEN, real=True, means_removed=True),
        TRAIN: TRAINING,
        STRESS: StudyCase(("sim:T-REAL/level-blind:2:2",)),
    },
    (*OURS, *PEERS),
    ("fishel-bayes", "static-svm", "spectrogram-svm", "correlation-svm", "st-hmp", "recurrent"),
)
NEAR = ("position<=2",)
QUICK = Study(
    "chart",
    {
        "hard": StudyCase(
            ("sim:T-REAL/level-blind:1001:3", "sim:T-HARD/level-blind:1001-1002:2"),
            "split:set=0->1",
            NEAR,
        ),
        "lopo": StudyCase(("sim:T-REAL/level-blind:1001:3",), "leave:position", NEAR),
        TRAIN: StudyCase(("sim:T-REAL/level-blind:1001:3",), only=NEAR),
        STRESS: StudyCase(("sim:T-LAB/level-blind:1002:1",)),
    },
    ("palpate-bands", "palpate-pairs", "L-gauss", "H-svm", "minirocket"),
)
QUICK_EFFORT, QUICK_ROUNDS = Effort(share=0.02), 5


def results(study: Study, run: StudyRun, touch: Mapping[str, float] | None = None) -> list[Json]:
    """The results of the study: an entry for each bundle. touch: by method the share of a sweep
    that it needs with early answers."""
    accuracy, train = accuracies(study, run), _train(study)
    with tempfile.TemporaryDirectory() as work:
        names = {method for method, _ in accuracy}
        made = list(packed(study, run, names, run.where.cache or Path(work)))
        run.log(f"{len(made)} models take turns")
        rounds = QUICK_ROUNDS if run.quick else measure.ROUNDS
        costs = precisions.measured(made, train.samples, rounds)
    known: Json = {"seeds": list(run.seeds), "set": train.source} | score.provenance()
    if run.quick:
        known["quick"] = True
    return [
        _dot(one, cost, accuracy.get((one.method, one.form), {}), touch or {}) | known
        for one, cost in zip(made, costs, strict=True)
    ]


def _dot(one: Packed, costs: Json, accuracy: Json, touch: Mapping[str, float]) -> Json:
    """Costs and accuracy of one bundle. Touch time is the mean part of the window that the method
    itself needs with early answers."""
    share = touch.get(one.method, 1.0) if not one.form else 1.0
    return costs | {
        "touch_s": round(one.window_s * share, 3),
        "family": family(one.method),
        "accuracy": accuracy,
    }


def accuracies(study: Study, run: StudyRun) -> Accuracy:
    """Accuracies of all methods and their forms, by case."""
    known = methods.every(run.effort)
    named = [name for name in study.methods if name in known]
    run.left_out |= {name: "no such method here" for name in study.methods if name not in known}
    found: Accuracy = {}
    for names, where in ((named, run.where), (study.joining, replace(run.where, kept=True))):
        if not names:
            continue
        part = replace(run, where=where)  # left_out is the same dictionary
        for name, case in study.cases.items():
            if case.protocol:
                _evaluate(found, name, case, names, part)
        _stress(found, study, [name for name in names if (name, "") in found], part)
    return found


def _evaluate(
    found: Accuracy, key: str, case: StudyCase, names: Sequence[str], run: StudyRun
) -> None:
    """Add the accuracies of methods and their forms in one case."""
    sweeps = case.load(run.data)
    if sweeps is None:
        run.left_out[key] = NO_DATA
        return
    by_form: dict[tuple[str, str], list[Json]] = {}
    plan = Plan(names, (case.protocol,), run.seeds, case.means_removed, run.effort)
    for result in evaluate.evaluate(sweeps, plan, run.where, run.log):
        if result.refused:
            run.left_out[f"{result.method}, {key}"] = result.refused
            continue
        figures = result.json()
        for form, one in {"": figures, **figures.get("forms", {})}.items():
            by_form.setdefault((result.method, form), []).append(one | {"seed": result.seed})
    for named, several in by_form.items():
        found.setdefault(named, {})[key] = joined(several)


def _stress(found: Accuracy, study: Study, names: Sequence[str], run: StudyRun) -> None:
    """Add accuracies under corruption of the methods themselves; robustness does not test their
    other forms."""
    (trial,) = study.cases[STRESS].sets
    result = robustness.run(
        names,
        _train(study),
        EvaluationSweeps.simulated(trial),
        run.where,
        seeds=run.seeds,
        effort=run.effort,
        log=run.log,
    )
    for name, entry in result["methods"].items():
        if entry["curves"]:
            found[name, ""] |= under_stress(entry)


def packed(study: Study, run: StudyRun, names: set[str], cache: Path) -> Iterator[Packed]:
    """Yield the bundles of those `names` that can be packed."""
    train = _train(study)
    order = [name for name in (*study.methods, *study.joining) if name in names]
    progress = parallel.Progress(len(order), run.log)
    for method in methods.find(order, run.effort):
        folder = kept_folder(method, train, run.seeds[0], cache)
        if run.where.kept and not folder.exists():
            run.left_out[method.name] = "not packed yet"
            continue
        try:
            yield from precisions.packed(method, train, run.seeds[0], folder)
        except (FormatError, BundleError) as e:
            run.left_out[method.name] = str(e)
        progress(f"{method.name} packed")


def _train(study: Study) -> Dataset:
    train = study.cases[TRAIN].load()
    assert train is not None  # it is simulated
    return train


def kept_folder(method: Method, train: Dataset, seed: int, cache: Path) -> Path:
    """The folder in the cache for the bundles of a method that was trained on these sweeps."""
    about = [sets.digest(train), method.name, method.effort, seed]
    modules = methods.module_of(method.name), "train.studies.precisions", "train.export.pack"
    return cache / "dots" / fingerprint(about, *modules)


def joined(results: Sequence[Json]) -> Json:
    """Results of several seeds of one protocol as one: means of accuracies and of the ends of
    intervals."""
    shares = [(r["window"]["right"] / r["window"]["total"], *r["interval"]) for r in results]
    seeds = sorted(r["seed"] for r in results)
    return _entry(np.mean(shares, axis=0), results[0]["window"]["total"], seeds)


def under_stress(entry: Json) -> dict[str, Json]:
    """Accuracies under corruption from an entry of robustness.merge: "stress", the mean over
    severities of the worst corruption, and stress_targets.TARGETS."""
    curves, seeds = entry["curves"], entry["seeds"]
    n = next(iter(curves.values()))["total"] // len(seeds)
    mean = {
        name: [float(np.mean(c[k][1:])) for k in ("accuracy", "low", "high")]
        for name, c in curves.items()
    }
    worst = min(mean, key=lambda name: (mean[name][0], name))
    entries = {"stress": _entry(mean[worst], n, seeds) | {"name": worst}}
    return entries | {
        f"stress:{key}": _entry(shares, n, seeds)
        for key, shares in stress_targets.at_targets(curves).items()
    }


def _entry(shares: Iterable[float], n: int, seeds: Sequence[int]) -> Json:
    """shares: accuracy, lower and upper end of its interval."""
    ends = zip(("mean", "low", "high"), shares, strict=True)
    return {name: round(float(share), 4) for name, share in ends} | {"n": n, "seeds": list(seeds)}


def touch_shares(paths: Sequence[Path]) -> dict[str, float]:
    """The mean share of a sweep that each method needs with early answers, from results of `python
    -m train.studies certainty`.

    Raises FormatError if a file has another content.
    """
    shares = {}
    for path in paths:
        try:
            figures = json.loads(path.read_bytes())
            shares[figures["method"]] = float(figures["early"]["share"])
        except (ValueError, KeyError, TypeError) as e:
            raise FormatError(
                f"{path.name}: not what python -m train.studies certainty wrote: {e!r}"
            ) from e
    return shares
