"""The command `chart`: speed against accuracy. In: what to compare. Out: chart.json, a picture and
a page.

Accuracy comes from evaluate and stress, whose finished work is kept; the costs of all dots are
measured in one run. An interrupted command goes on where it was.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from appliance.core.errors import BundleError, FormatError
from appliance.core.storage import put
from train.data import sets
from train.data.sets import Dataset
from train.evaluation import evaluate, parallel, robustness
from train.evaluation.corruptions import EvaluationSweeps
from train.evaluation.evaluate import Plan, Where
from train.evaluation.fold import fingerprint
from train.export import measure, precisions
from train.export.precisions import Packed
from train.metrics import score
from train.models import methods
from train.models.methods import FULL_EFFORT, Effort, Method
from train.models.recipe.architectures import ARCHITECTURES
from train.reports import html, provenance
from train.studies import chart_page, scatter
from train.studies.method_names import family

Json = dict[str, Any]
Log = Callable[[str], None]
Accuracy = dict[tuple[str, str], dict[str, Json]]
"""By method and form, then by protocol: mean, low, high, n, seeds."""
FABRICS = "fabricslide/fabricslide.npz"
BOX_ON_HARD = "alignment/place.json"
"""Beside the chart's folder: what the box answers to T-HARD's sweeps."""
SEVEN = ("direction=0", "force<=180")


@dataclass(frozen=True)
class ChartPart:
    """An axis of accuracy. sets: are joined; real: they are files in the folder of real sweeps.
    only: of each set."""

    sets: tuple[str, ...]
    protocol: str
    only: tuple[str, ...] = ()
    real: bool = False

    def load(self, data: Path | None) -> Dataset | None:
        """Its sweeps; None where they are real and no folder is given."""
        if self.real and data is None:
            return None
        named = [str(data / name) if self.real and data else name for name in self.sets]
        return sets.join([sets.load(name).select(self.only) for name in named])


@dataclass(frozen=True)
class Chart:
    """What is compared. train, trial: of the stress; the bundles are trained on `train` too.

    named: methods of the chart; others: those that join where an earlier run has left results.
    rounds: of timing.
    """

    parts: dict[str, ChartPart]
    train: str
    trial: str
    named: tuple[str, ...]
    others: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    rounds: int = measure.ROUNDS


COMPACT = ("default", "filter-bank", "compact", *(f"compact-{size}" for size in ARCHITECTURES))
FULL = Chart(
    {
        "hard": ChartPart(("sim:T-REAL:1", "sim:T-HARD:1-20"), "split:set=0->1"),
        "lopo": ChartPart(("sim:T-REAL:1",), "leave:position"),
        "force": ChartPart((FABRICS,), "leave:force", SEVEN, True),
        "speed": ChartPart((FABRICS,), "leave:speed", SEVEN, True),
    },
    "sim:T-REAL:1",
    "sim:T-REAL:2:2",
    (
        *COMPACT,
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
    ),
    ("fishel-bayes", "static-svm", "spectrogram-svm", "correlation-svm", "st-hmp", "recurrent"),
)
QUICK = Chart(
    {
        "hard": ChartPart(
            ("sim:T-REAL:1001:3", "sim:T-HARD:1001-1002:2"), "split:set=0->1", ("position<=2",)
        ),
        "lopo": ChartPart(("sim:T-REAL:1001:3",), "leave:position", ("position<=2",)),
    },
    "sim:T-REAL:1001:3",
    "sim:T-LAB:1002:1",
    ("compact-1k", "compact", "L-gauss", "H-svm", "minirocket"),
    only=("position<=2",),
    rounds=5,
)
QUICK_EFFORT = Effort(share=0.02)


@dataclass
class Charting:
    """One run of the command. left_out: what is missing, and why."""

    chart: Chart
    where: Where
    log: Log
    data: Path | None = None
    effort: Effort = FULL_EFFORT
    seeds: Sequence[int] = (1,)
    touch: Json = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    def dots(self) -> list[Json]:
        """All of them, as chart.json lists them."""
        accuracy = self.accuracy()
        with tempfile.TemporaryDirectory() as work:
            made = list(
                self.packed({method for method, _ in accuracy}, self.where.cache or Path(work))
            )
            self.log(f"{len(made)} models take turns")
            train = sets.load(self.chart.train).select(self.chart.only)
            costs = precisions.measured(made, train.samples, self.chart.rounds)
        known = {"seeds": list(self.seeds), "set": train.source} | score.provenance()
        return [
            self._dot(one, cost, accuracy.get((one.method, one.form), {})) | known
            for one, cost in zip(made, costs, strict=True)
        ]

    def _dot(self, one: Packed, costs: Json, accuracy: Json) -> Json:
        """Costs and accuracy of one; touch time is the mean part of the window that early exit
        needs, of the method itself."""
        share = self.touch.get(one.method, 1.0) if not one.form else 1.0
        return costs | {
            "touch_s": round(one.window_s * share, 3),
            "family": family(one.method),
            "accuracy": accuracy,
        }

    def accuracy(self) -> Accuracy:
        """Of all methods and their forms, by protocol."""
        known = methods.every(self.effort)
        named = [name for name in self.chart.named if name in known]
        self.left_out |= {
            name: "no such method here" for name in self.chart.named if name not in known
        }
        found: Accuracy = {}
        for names, where in (
            (named, self.where),
            (self.chart.others, replace(self.where, kept=True)),
        ):
            if not names:
                continue
            for protocol, part in self.chart.parts.items():
                self._evaluated(found, protocol, part, names, where)
            self._stressed(found, [name for name in names if (name, "") in found], where)
        return found

    def _evaluated(
        self, found: Accuracy, protocol: str, part: ChartPart, names: Sequence[str], where: Where
    ) -> None:
        """Add what methods and their forms reach under one protocol."""
        sweeps = part.load(self.data)
        if sweeps is None:
            self.left_out[protocol] = "real sweeps; name their folder with --data or PALPATE_DATA"
            return
        by_form: dict[tuple[str, str], list[Json]] = {}
        plan = Plan(names, (part.protocol,), self.seeds, part.real, self.effort)
        for result in evaluate.evaluate(sweeps, plan, where, self.log):
            if result.refused:
                self.left_out[f"{result.method}, {protocol}"] = result.refused
                continue
            figures = result.json()
            for form, one in {"": figures, **figures.get("forms", {})}.items():
                by_form.setdefault((result.method, form), []).append(one | {"seed": result.seed})
        for named, results in by_form.items():
            found.setdefault(named, {})[protocol] = joined(results)

    def _stressed(self, found: Accuracy, names: Sequence[str], where: Where) -> None:
        """Add accuracies under stress of the methods themselves; robustness does not test their
        other forms."""
        train, trial = (
            sets.load(self.chart.train).select(self.chart.only),
            EvaluationSweeps.simulated(self.chart.trial),
        )
        result = robustness.run(
            names, train, trial, where, seeds=self.seeds, effort=self.effort, log=self.log
        )
        for name, entry in result["methods"].items():
            if entry["curves"]:
                found[name, ""] |= under_stress(entry)

    def packed(self, names: set[str], cache: Path) -> Iterator[Packed]:
        """The bundles of those `names` of the chart that can be packed."""
        train = sets.load(self.chart.train).select(self.chart.only)
        order = [name for name in (*self.chart.named, *self.chart.others) if name in names]
        progress = parallel.Progress(len(order), self.log)
        for method in methods.find(order, self.effort):
            folder = kept_folder(method, train, self.seeds[0], cache)
            if self.where.kept and not folder.exists():
                self.left_out[method.name] = "not packed yet"
                continue
            try:
                yield from precisions.packed(method, train, self.seeds[0], folder)
            except (FormatError, BundleError) as e:
                self.left_out[method.name] = str(e)
            progress(f"{method.name} packed")


def kept_folder(method: Method, train: Dataset, seed: int, cache: Path) -> Path:
    """Where the bundles of a method that was trained on these sweeps are kept."""
    about = [sets.digest(train), method.name, method.effort, seed]
    modules = methods.module_of(method.name), "train.export.precisions", "train.export.pack"
    return cache / "dots" / fingerprint(about, *modules)


def joined(results: Sequence[Json]) -> Json:
    """Results of several seeds of one protocol as one: means of accuracies and of the ends of
    intervals."""
    shares = [(r["window"]["right"] / r["window"]["total"], *r["interval"]) for r in results]
    seeds = sorted(r["seed"] for r in results)
    return _entry(np.mean(shares, axis=0), results[0]["window"]["total"], seeds)


def under_stress(entry: Json) -> dict[str, Json]:
    """Accuracies under stress from an entry of robustness.merge: "stress", the worst one's mean
    over severities, and robustness.TARGETS."""
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
        for key, shares in robustness.at_targets(curves).items()
    }


def _entry(shares: Iterable[float], n: int, seeds: Sequence[int]) -> Json:
    """shares: accuracy, lower and upper end of its interval."""
    ends = zip(("mean", "low", "high"), shares, strict=True)
    return {name: round(float(share), 4) for name, share in ends} | {"n": n, "seeds": list(seeds)}


def touch_shares(paths: Sequence[Path]) -> dict[str, float]:
    """Mean share of the sweep that each method needs with early exit, from files of `palpate-train
    certainty`.

    Raises FormatError where a file has another content.
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


def box_on_hard(file: Path) -> Json | None:
    """What the packaged bundle answers to T-HARD's sweeps, as `python -m train.studies alignment` wrote it;
    None where it did not."""
    try:
        point: Json = json.loads(file.read_bytes())["T-HARD"]
    except (OSError, ValueError, KeyError):
        return None
    return point if {"accuracy", "wrong_share", "network"} <= point.keys() else None


def read(out: Path) -> list[Json]:
    """The dots that `write` put into the folder `out`. Raises FormatError where they are not
    there."""
    try:
        dots: list[Json] = json.loads((out / "chart.json").read_bytes())
    except (OSError, ValueError) as e:
        raise FormatError(
            f"{out}/chart.json is not a chart: {e}; run the command without --draw"
        ) from e
    return dots


def write(
    out: Path, found: Sequence[Json], quick: bool = False, left_out: dict[str, str] | None = None
) -> Path:
    """chart.json, chart.svg and index.html in the folder `out`; the page's path."""
    lines = ",\n".join(json.dumps(dot, allow_nan=False) for dot in found)
    put(out / "chart.json", f"[\n{lines}\n]\n".encode(), parents=True)
    picture = scatter.chart(found)
    page = chart_page.html(
        found, picture, quick, left_out or {}, box_on_hard(out.parent / BOX_ON_HARD)
    )
    return html.publish(out, {"index": page}, {"chart": picture}, provenance.of(list(found)))
