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

from palpate.answer.objects import softmax
from palpate.core.sweep_set import Array
from palpate_train.answer.calibrate import Calibration
from palpate_train.answer.fit_early import decide
from palpate_train.data.sets import Dataset, digest
from palpate_train.evaluate import uncertainty
from palpate_train.evaluate.evaluate import Where
from palpate_train.evaluate.uncertainty import (
    NONE_LEFT_OUT,
    Case,
    CaseTask,
    Log,
    cases,
    train_and_test,
)
from palpate_train.metrics.score import interval, provenance
from palpate_train.models import methods
from palpate_train.models.methods import Effort

Json = dict[str, Any]


def run(
    train: Dataset,
    test: Dataset,
    method: str,
    where: Where,
    log: Log,
    effort: Effort = methods.FULL_EFFORT,
    seed: int = 1,
) -> dict[str, Any]:
    """All figures for the results, of trainings on all materials, and on all but each if at least
    two remain.

    Raises FormatError if the sets do not fit together, or if the method gives no such figures.
    """
    start = time.monotonic()
    both, seen, new = train_and_test(train, test)
    out = range(len(both.materials)) if len(both.materials) > 2 else ()
    wanted = [CaseTask(method, effort, seed, seen, new, left) for left in (NONE_LEFT_OUT, *out)]
    trained = cases(wanted, both, where, log)
    log("figures")
    result = figures(trained, both.materials)
    about = {
        "set": train.source,
        "test": test.source,
        "method": method,
        "effort": effort.share,
        "seed": seed,
        "trainings": len(trained),
        "sweeps": len(both),
        "tested": len(test),
        "digest": digest(both),
        "materials": list(both.materials),
        "format": str(both.format),
        "took_s": round(time.monotonic() - start, 1),
    }
    return about | provenance() | result


def figures(trained: Sequence[Case], materials: Sequence[str]) -> Json:
    """All figures. trained: first on all materials, then without each; with two materials none is
    left out."""
    whole, *without = trained
    full = whole, whole.calibration()
    result = {"calibration": calibration(*full), "early": early(*full)}
    if without:
        result["unknown"] = uncertainty.unknown(without, materials)
    return result


def calibration(case: Case, done: Calibration) -> Json:
    """Expected calibration error and reliability before the temperature (LDA's own posteriors) and
    after."""
    result: Json = {"n": len(case.labels), "temperature": [round(done.temperature, 2)]}
    for name, undo in (("before", done.temperature), ("after", 1)):
        p = softmax(done.logits(case.new[:, -1]) * undo)
        confidence, right = p.max(1), p.argmax(1) == case.labels
        low, high = uncertainty.bootstrap(partial(_error_of, confidence, right), case.places)
        result[name] = {
            "error": round(uncertainty.error(confidence, right), 4),
            "low": low,
            "high": high,
            "bins": uncertainty.reliability(confidence, right),
        }
    result["accuracy"] = _accuracy(right, case.places)
    return result


def _error_of(confidence: Array, right: Array, some: Array) -> float:
    return uncertainty.error(confidence[some], right[some])


def early(case: Case, done: Calibration) -> Json:
    """Accuracy and mean share of the sweep for the rule found in training, and for an answer after
    each tenth."""
    labels, places, found = case.labels, case.places, done.rule
    p = done.probabilities(case.new)
    whole = p[:, -1].argmax(1) == labels
    named, share = decide(p, found.early) if found.early else (p[:, -1].argmax(1), np.ones(len(p)))
    lost = whole.astype(float) - (named == labels)
    low, high = uncertainty.bootstrap(lambda some: float(lost[some].mean()), places)
    rule = {
        "least": found.early.least[0] if found.early else None,
        "agree": found.early.agree if found.early else None,
        "why": found.why,
        "n": found.n,
    }
    return {
        "share": round(float(share.mean()), 4),
        "lost": round(float(lost.mean()), 4),
        "lost_low": low,
        "lost_high": high,
        "rule": _accuracy(named == labels, places),
        "whole": _accuracy(whole, places),
        "rules": [rule],
        "always": [_accuracy(p[:, d].argmax(1) == labels, places) for d in range(p.shape[1])],
    }


def _accuracy(right: Array, clusters: Array) -> Json:
    low, high = interval(right, clusters)
    return {"accuracy": round(float(right.mean()), 4), "low": low, "high": high}
