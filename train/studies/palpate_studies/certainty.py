"""The study of certainty: how far the probabilities of a method can be trusted.

It covers calibration, unknown materials and early decisions, each on test sweeps that nothing was
fitted to.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate_train.answer.fit_early import decide
from palpate_train.data.sets import Dataset, digest
from palpate_train.evaluate import uncertainty
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.uncertainty import Trained
from palpate_train.evaluate.uncertainty_cases import Case, Log, Trainings, cases
from palpate_train.metrics.score import interval, provenance
from palpate_train.models import methods
from palpate_train.models.methods import Effort

Array = NDArray[Any]
Json = dict[str, Any]


def run(
    sweeps: Dataset,
    test: Dataset | None,
    protocol: str,
    method: str,
    where: Where,
    log: Log,
    effort: Effort = methods.FULL_EFFORT,
    seed: int = 1,
) -> dict[str, Any]:
    """All figures for the results. test: the set to test on; without it, `protocol` selects the
    held-out sweeps.

    Raises FormatError if the sets do not fit together, or if the method gives no such figures.
    """
    start = time.monotonic()
    plan = Trainings.of(sweeps, test, protocol, seed)
    whole_set = plan.sweeps
    trained = cases(plan.tasks(method, effort, seed), whole_set, where, log)
    log("figures")
    result = figures(trained, whole_set.materials)
    about = {
        "set": sweeps.source,
        "test": test.source if test else "",
        "protocol": "train and test" if test else protocol,
        "method": method,
        "effort": effort.share,
        "seed": seed,
        "folds": len(plan.folds),
        "trainings": len(trained),
        "sweeps": len(whole_set),
        "tested": int(sum(len(test) for _, test in plan.folds)),
        "digest": digest(whole_set),
        "materials": list(whole_set.materials),
        "format": str(whole_set.format),
        "took_s": round(time.monotonic() - start, 1),
    }
    return about | provenance() | result


def figures(trained: Sequence[Case], materials: Sequence[str]) -> Json:
    """All figures. With two materials there are none that need a material left out."""
    fitted = [(case, case.calibration()) for case in trained]
    full = [one for one in fitted if one[0].left_out < 0]
    result = {
        "calibration": calibration(full),
        "early": early(full),
    }
    without = [one for one in fitted if one[0].left_out >= 0]
    if without:
        result["unknown"] = uncertainty.unknown(without, materials)
    return result


def calibration(full: Sequence[Trained]) -> Json:
    """Expected calibration error and reliability before the temperature (LDA's own posteriors) and
    after."""
    labels, places = uncertainty.joined(full, "labels"), uncertainty.placements(full)
    result: Json = {
        "n": len(labels),
        "temperature": [round(done.temperature, 2) for _, done in full],
    }
    for name, undo in (("before", True), ("after", False)):
        logits = np.concatenate(
            [
                done.logits(case.new[:, -1]) * (done.temperature if undo else 1)
                for case, done in full
            ]
        )
        p = softmax(logits)
        confidence, right = p.max(1), p.argmax(1) == labels
        low, high = uncertainty.bootstrap(partial(_error_of, confidence, right), places)
        result[name] = {
            "error": round(uncertainty.error(confidence, right), 4),
            "low": low,
            "high": high,
            "bins": uncertainty.reliability(confidence, right),
        }
    result["accuracy"] = _accuracy(right, places)
    return result


def _error_of(confidence: Array, right: Array, some: Array) -> float:
    return uncertainty.error(confidence[some], right[some])


def early(full: Sequence[Trained]) -> Json:
    """Accuracy and mean share of the sweep for the rules found in training, for other rules, and
    for an answer after the first tenth."""
    labels, places = uncertainty.joined(full, "labels"), uncertainty.placements(full)
    p = np.concatenate([done.probabilities(case.new) for case, done in full])
    whole = p[:, -1].argmax(1) == labels
    steps = p.shape[1]
    by_rule = [
        decide(p_, done.rule.early) if done.rule.early else (p_[:, -1].argmax(1), np.ones(len(p_)))
        for (_, done), p_ in zip(full, _parted(p, full), strict=True)
    ]
    named, share = (np.concatenate(part) for part in zip(*by_rule, strict=True))
    lost = whole.astype(float) - (named == labels)
    low, high = uncertainty.bootstrap(partial(_mean_of, lost), places)
    rules = [
        {
            "least": r.early.least[0] if r.early else None,
            "agree": r.early.agree if r.early else None,
            "why": r.why,
            "n": r.n,
        }
        for r in (done.rule for _, done in full)
    ]
    return {
        "share": round(float(share.mean()), 4),
        "lost": round(float(lost.mean()), 4),
        "lost_low": low,
        "lost_high": high,
        "rule": _accuracy(named == labels, places),
        "whole": _accuracy(whole, places),
        "rules": rules,
        "always": [_accuracy(p[:, d].argmax(1) == labels, places) for d in range(steps)],
    }


def _parted(rows: Array, held: Sequence[Trained]) -> list[Array]:
    """`rows` of all cases, split by case."""
    return np.split(rows, np.cumsum([len(case.labels) for case, _ in held])[:-1])


def _accuracy(right: Array, clusters: Array) -> Json:
    low, high = interval(right, clusters)
    return {"accuracy": round(float(right.mean()), 4), "low": low, "high": high}


def _mean_of(values: Array, some: Array) -> float:
    return float(values[some].mean())
