"""The study `chart`: accuracy and costs of every method as a bundle, for speed against accuracy.

Accuracy comes from evaluate and robustness, whose finished folds are cached: an interrupted run
goes on where it was. The costs of all bundles are measured in one run.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from appliance.core.errors import BundleError, FormatError
from train.data import sets
from train.data.sets import Dataset
from train.evaluation import evaluate, parallel, robustness
from train.evaluation.evaluate import Plan, Where
from train.evaluation.evaluation_sweeps import EvaluationSweeps
from train.evaluation.fold import fingerprint
from train.export import measure
from train.metrics import score
from train.models import methods
from train.models.methods import Effort, Method
from train.models.recipe.architectures import ARCHITECTURES
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
TRAINING = StudyCase(("sim:T-REAL:1",))
OURS = ("default", "filter-bank", "compact", *(f"compact-{size}" for size in ARCHITECTURES))
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
        "hard": StudyCase(("sim:T-REAL:1", "sim:T-HARD:1-20"), "split:set=0->1"),
        "lopo": StudyCase(("sim:T-REAL:1",), "leave:position"),
        "force": StudyCase((FABRICS,), "leave:force", SEVEN, real=True, means_removed=True),
        "speed": StudyCase((FABRICS,), "leave:speed", SEVEN, real=True, means_removed=True),
        TRAIN: TRAINING,
        STRESS: StudyCase(("sim:T-REAL:2:2",)),
    },
    (*OURS, *PEERS),
    ("fishel-bayes", "static-svm", "spectrogram-svm", "correlation-svm", "st-hmp", "recurrent"),
)
NEAR = ("position<=2",)
QUICK = Study(
    "chart",
    {
        "hard": StudyCase(("sim:T-REAL:1001:3", "sim:T-HARD:1001-1002:2"), "split:set=0->1", NEAR),
        "lopo": StudyCase(("sim:T-REAL:1001:3",), "leave:position", NEAR),
        TRAIN: StudyCase(("sim:T-REAL:1001:3",), only=NEAR),
        STRESS: StudyCase(("sim:T-LAB:1002:1",)),
    },
    ("compact-1k", "compact", "L-gauss", "H-svm", "minirocket"),
)
QUICK_EFFORT, QUICK_ROUNDS = Effort(share=0.02), 5


@dataclass
class Chart:
    """One run of the study. touch: the share of a sweep that methods need with early answers."""

    study: Study
    run: StudyRun
    touch: dict[str, float] = field(default_factory=dict)

    def dots(self) -> list[Json]:
        """An entry for each bundle: the results of the study."""
        accuracy = self.accuracy()
        with tempfile.TemporaryDirectory() as work:
            made = list(
                self.packed({method for method, _ in accuracy}, self.run.where.cache or Path(work))
            )
            self.run.log(f"{len(made)} models take turns")
            train = self._train()
            rounds = QUICK_ROUNDS if self.run.quick else measure.ROUNDS
            costs = precisions.measured(made, train.samples, rounds)
        known: Json = {"seeds": list(self.run.seeds), "set": train.source} | score.provenance()
        if self.run.quick:
            known["quick"] = True
        return [
            self._dot(one, cost, accuracy.get((one.method, one.form), {})) | known
            for one, cost in zip(made, costs, strict=True)
        ]

    def _dot(self, one: Packed, costs: Json, accuracy: Json) -> Json:
        """Costs and accuracy of one bundle. Touch time is the mean part of the window that the
        method itself needs with early answers."""
        share = self.touch.get(one.method, 1.0) if not one.form else 1.0
        return costs | {
            "touch_s": round(one.window_s * share, 3),
            "family": family(one.method),
            "accuracy": accuracy,
        }

    def accuracy(self) -> Accuracy:
        """Accuracies of all methods and their forms, by case."""
        known = methods.every(self.run.effort)
        named = [name for name in self.study.methods if name in known]
        self.run.left_out |= {
            name: "no such method here" for name in self.study.methods if name not in known
        }
        found: Accuracy = {}
        for names, where in (
            (named, self.run.where),
            (self.study.joining, replace(self.run.where, kept=True)),
        ):
            if not names:
                continue
            for name, case in self.study.cases.items():
                if case.protocol:
                    self._evaluated(found, name, case, names, where)
            self._stressed(found, [name for name in names if (name, "") in found], where)
        return found

    def _evaluated(
        self, found: Accuracy, key: str, case: StudyCase, names: Sequence[str], where: Where
    ) -> None:
        """Add the accuracies of methods and their forms in one case."""
        sweeps = case.load(self.run.data)
        if sweeps is None:
            self.run.left_out[key] = NO_DATA
            return
        by_form: dict[tuple[str, str], list[Json]] = {}
        run = self.run
        plan = Plan(names, (case.protocol,), run.seeds, case.means_removed, run.effort)
        for result in evaluate.evaluate(sweeps, plan, where, run.log):
            if result.refused:
                run.left_out[f"{result.method}, {key}"] = result.refused
                continue
            figures = result.json()
            for form, one in {"": figures, **figures.get("forms", {})}.items():
                by_form.setdefault((result.method, form), []).append(one | {"seed": result.seed})
        for named, results in by_form.items():
            found.setdefault(named, {})[key] = joined(results)

    def _stressed(self, found: Accuracy, names: Sequence[str], where: Where) -> None:
        """Add accuracies under corruption of the methods themselves; robustness does not test their
        other forms."""
        (trial,) = self.study.cases[STRESS].sets
        result = robustness.run(
            names,
            self._train(),
            EvaluationSweeps.simulated(trial),
            where,
            seeds=self.run.seeds,
            effort=self.run.effort,
            log=self.run.log,
        )
        for name, entry in result["methods"].items():
            if entry["curves"]:
                found[name, ""] |= under_stress(entry)

    def packed(self, names: set[str], cache: Path) -> Iterator[Packed]:
        """Yield the bundles of those `names` that can be packed."""
        train, run = self._train(), self.run
        order = [name for name in (*self.study.methods, *self.study.joining) if name in names]
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

    def _train(self) -> Dataset:
        train = self.study.cases[TRAIN].load()
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
