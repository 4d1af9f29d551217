"""The study `development`: all methods on all development sets.

One set is never enough to tune on: a recipe that overfits one set shows it on the others. evaluate
caches folds, so an interrupted command goes on where it was. T-HARD, the skin attached anew, is not
among the sets, because the simulator cannot be trusted with it (decision 2).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from palpate_studies import differences
from palpate_studies.fabrics_experiment import FABRICS, FOUR, SEVEN
from palpate_studies.study import NO_DATA, StudyCase, StudyRun
from palpate_train.data.sets import Dataset, digest
from palpate_train.evaluate import evaluate
from palpate_train.evaluate.evaluate import Plan
from palpate_train.metrics import score
from palpate_train.models import methods
from palpate_train.models.methods import PACKAGED, SHIPPED
from palpate_train.models.recipe.sizes import SIZES

Json = dict[str, Any]
LINE = (*(f"{SHIPPED}-{name}" for name in SIZES), SHIPPED)
"""The sizes of our family, from the smallest to everything."""
OURS = (SHIPPED, PACKAGED, *LINE[:-1])
"""Our methods. The first of them with results is compared with the peers."""
PEERS = (
    "minirocket",
    "minirocket-augmented",
    "multirocket-hydra",
    "quant",
    "ds-cnn",
    "lite",
    "edge-spectral",
    "H-svm",
    "paper-cnn-centred",
)


def _fabrics(protocol: str, only: tuple[str, ...]) -> StudyCase:
    return StudyCase((FABRICS,), protocol, only, True, True)


def _published(name: str) -> StudyCase:
    return StudyCase((f"aeon:{name}",), "split:split=0->1", means_removed=True)


TUBES = "simulated tubes, a position out"
CASES = {
    "7 fabrics, a force out": _fabrics("leave:force", SEVEN),
    "7 fabrics, a speed out": _fabrics("leave:speed", SEVEN),
    "7 fabrics, a repetition out": _fabrics("leave:rep", SEVEN),
    "4 fabrics, a force out": _fabrics("leave:force", FOUR),
    "4 fabrics, a speed out": _fabrics("leave:speed", FOUR),
    "4 fabrics, a direction out": _fabrics("leave:direction", FOUR),
    "ACSF1, published split": _published("ACSF1"),
    "OSULeaf, published split": _published("OSULeaf"),
    "BasicMotions, published split": _published("BasicMotions"),
    "ArrowHead, published split": _published("ArrowHead"),
    "GunPoint, published split": _published("GunPoint"),
    TUBES: StudyCase(("sim:T-REAL/level-blind:1",), "leave:position"),
}
"""In the order of the page."""


def usual_methods() -> tuple[str, ...]:
    """Our methods and the peers that exist here."""
    known = methods.every()
    return tuple(name for name in (*OURS, *PEERS) if name in known)


def results(run: StudyRun, names: Sequence[str], tested: Mapping[str, StudyCase] = CASES) -> Json:
    """The results of the methods `names`: `cases` with their sets, and entries by case and
    method.

    Raises FormatError for an unknown method.
    """
    methods.find(names)
    cases: list[Json] = []
    found: list[Json] = []
    for number, (name, case) in enumerate(tested.items(), 1):
        sweeps = case.load(run.data)
        if sweeps is None:
            run.left_out[name] = NO_DATA
            continue
        cases.append(_about(name, case, sweeps))
        plan = Plan(names, (case.protocol,), run.seeds, case.means_removed, run.effort)
        progress = f"{number}/{len(tested)} {name}"
        found += _evaluated(name, sweeps, plan, run, progress)
    known = {"methods": list(names), "seeds": list(run.seeds), "effort": run.effort.share}
    return {
        "methods": list(names),
        "runs": [known | score.provenance()],
        "cases": cases,
        "results": found,
        "left_out": run.left_out,
    }


def joined(held: Json, new: Json) -> Json:
    """The results `held` with those of `new`, which replace results of the same case and method. A
    run is named while a result of one of its methods is left."""
    found, replaced = (
        {(one["case"], one["method"]): one for one in made["results"]} for made in (held, new)
    )
    left = {method for case, method in found if (case, method) not in replaced}
    runs = [run | {"methods": [m for m in run["methods"] if m in left]} for run in held["runs"]]
    cases = {one["case"]: one for one in (*held["cases"], *new["cases"])}
    return held | {
        "methods": list(dict.fromkeys([*held["methods"], *new["methods"]])),
        "runs": [*new["runs"], *(run for run in runs if run["methods"])],
        "cases": list(cases.values()),
        "results": list((found | replaced).values()),
        "left_out": held["left_out"] | new["left_out"],
    }


def _evaluated(
    name: str, sweeps: Dataset, plan: Plan, run: StudyRun, progress: str
) -> Iterator[Json]:
    """Yield one entry for each method that accepts the set, over all seeds that were found."""
    by_method: dict[str, list[Json]] = {}

    def log(line: str) -> None:
        run.log(f"{progress}: {line}")

    for result in evaluate.evaluate(sweeps, plan, run.where, log):
        if result.refused:
            run.left_out[f"{result.method}, {name}"] = result.refused
        else:
            by_method.setdefault(result.method, []).append(result.json() | {"seed": result.seed})
    for method, several in by_method.items():
        yield {"case": name, "method": method} | _entry(several)


def _about(name: str, case: StudyCase, sweeps: Dataset) -> Json:
    """The sweeps and the protocol of a case."""
    return {
        "case": name,
        "set": sweeps.source,
        "only": list(case.only),
        "protocol": case.protocol,
        "means_removed": case.means_removed,
        "simulated": case.simulated,
        "sweeps": len(sweeps),
        "materials": len(sweeps.materials),
        "format": str(sweeps.format),
        "digest": digest(sweeps),
    }


def _entry(results: Sequence[Json]) -> Json:
    """Accuracy with its interval over the results of all seeds, for each precision, and the time to
    train a fold."""
    forms = {
        name: _mean([result["forms"][name] for result in results])
        for name in results[0].get("forms", {})
    }
    return _mean(results) | {
        "n": results[0]["window"]["total"],
        "seeds": sorted(result["seed"] for result in results),
        "fit_s": max(float(result["fit_s"]) for result in results),
        "forms": forms,
    }


def _mean(results: Sequence[Json]) -> Json:
    """Results of several seeds of one protocol as one: means of accuracies and of the ends of
    intervals."""
    shares = [(r["window"]["right"] / r["window"]["total"], *r["interval"]) for r in results]
    return differences.entry([round(float(share), 4) for share in np.mean(shares, axis=0)])
