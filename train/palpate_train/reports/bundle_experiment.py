"""The figures of the command `report`: a bundle's answers to labelled sweeps, and its cost.

All answers come from the box's classifier, so `unsure`, `unknown` and refused sweeps count as on
the box.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import uncertainty
from palpate_train.evaluate.robustness import breaks_first
from palpate_train.export import bundle_stress, measure
from palpate_train.metrics import bundle_score
from palpate_train.metrics.score import interval

Json = dict[str, Any]
Log = Callable[[str], None]


def run(folder: Path, sweeps: Dataset, log: Log, seed: int = 0) -> Json:
    """The figures. seed: of the corruptions. Raises FormatError if the set differs from the bundle
    in format or has none of its materials, and BundleError if the bundle does not load."""
    loaded = bundle.load(folder)
    classifier = Classifier(loaded, SystemClock())
    m = loaded.manifest
    found = bundle_score.score(classifier, sweeps)
    log(f"{len(sweeps)} sweeps answered")
    cost = measure.measure_all([folder], sweeps.samples)[0]
    known = sweeps.take(np.isin(np.array(sweeps.materials)[sweeps.labels], m.labels))
    return found.json() | {
        "format": str(m.format),
        "labels": list(m.labels),
        "displays": sweeps.displays | m.displays,
        "made": dict(m.made),
        "figures": dict(m.figures),
        "fitted_to_this": m.made.get("set") == sweeps.source,
        "tells_unknown": m.known is not None,
        "groups": {name: len(np.unique(values)) for name, values in sweeps.groups.items()},
        "named": named(known, found),
        "foreign_named": foreign_named(found),
        "materials": [material(name, found) for name in found.answered],
        "calibration": calibration(classifier, known),
        "cost": {
            "ms": cost.ms,
            "ms_p99": cost.ms_p99,
            "kb": cost.kb,
            "mib": cost.mb,
        },
        "corruptions": corruptions(classifier, EvaluationSweeps.of(known, seed=seed), log, seed),
    }


def named(known: Dataset, found: bundle_score.BundleScore) -> Json:
    """Counts of the sweeps whose material the bundle has: right, wrong and without a label; and the
    number of the latter that are called unknown."""
    answers = sum(found.answered.values(), Counter())
    right, unknown = int(found.right.sum()), answers[f"({Status.UNKNOWN})"]
    silent = sum(n for answer, n in answers.items() if answer.startswith("("))
    n = len(known)
    return {
        "n": n,
        "right": right,
        "wrong": n - right - silent,
        "not_named": silent,
        "unknown": _share(unknown, n),
    }


def foreign_named(found: bundle_score.BundleScore) -> list[float]:
    """The share of sweeps of other materials that get a label of the bundle, with its interval;
    empty if there are none."""
    answers = sum(found.foreign.values(), Counter())
    return _share(
        sum(n for answer, n in answers.items() if not answer.startswith("(")), answers.total()
    )


def material(name: str, found: bundle_score.BundleScore) -> Json:
    """Counts for one material: its sweeps; those with the right label, without a label and refused;
    and the number of answers with its label that are right."""
    given = found.answered[name]
    others = sum(
        answers[name] for of, answers in (found.answered | found.foreign).items() if of != name
    )
    unsure, unknown = (given[f"({status})"] for status in (Status.UNSURE, Status.UNKNOWN))
    refused = sum(n for answer, n in given.items() if answer.startswith("(")) - unsure - unknown
    return {
        "name": name,
        "sweeps": given.total(),
        "recall": _share(given[name], given.total()),
        "precision": _share(given[name], given[name] + others),
        "unsure": unsure,
        "unknown": unknown,
        "refused": refused,
        "taken_for": _commonest(given, name),
    }


def _commonest(given: Mapping[str, int], name: str) -> list[Any]:
    """The most frequent wrong label and its count; empty if there is none."""
    wrong = [[of, n] for of, n in given.items() if of != name and not of.startswith("(")]
    return max(wrong, key=lambda one: one[1], default=[])


def _share(right: int, n: int) -> list[float]:
    """A share with its 95 % interval; empty if there is nothing to count."""
    return [right / n, *interval(np.arange(n) < right)] if n else []


def calibration(classifier: Classifier, sweeps: Dataset) -> Json:
    """The share of right labels by the probability of the most probable label, over all answers
    with a label, including `unsure`."""
    said, right = [], []
    for i, verdict in bundle_score.verdicts(classifier, sweeps):
        if verdict.status.classified:
            said.append(verdict.probability)
            right.append(verdict.label == sweeps.materials[sweeps.labels[i]])
    confidence, hit = np.array(said), np.array(right, bool)
    return {
        "n": len(said),
        "error": uncertainty.error(confidence, hit),
        "bins": uncertainty.reliability(confidence, hit),
    }


def corruptions(classifier: Classifier, test: EvaluationSweeps, log: Log, seed: int) -> list[Json]:
    """Counts of right and wrong answers under each corruption, ordered by how soon it breaks the
    box.

    falls: the severity at which five points are lost; None if they never are.
    """
    given = bundle_stress.under_corruptions(
        classifier, test, (seed,), log, wanted=("correct", "wrong")
    )
    right, wrong = given["correct"], given["wrong"]
    first = breaks_first(right)
    others = sorted(right.keys() - set(first), key=lambda name: (right[name]["right"][-1], name))
    return [
        {"name": name, "wrong": wrong[name]["right"]}
        | {
            k: right[name][k]
            for k in ("title", "about", "unit", "severities", "right", "total", "falls")
        }
        for name in (*first, *others)
    ]
