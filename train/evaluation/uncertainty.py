"""Figures on uncertainty, computed from Cases: how far probabilities can be trusted.

They cover calibration, the sequential test, unknown materials, enrolment and early decisions, each
on test sweeps that nothing was fitted to. Intervals are 95 %, from a bootstrap over the placements
of the skin, since the errors of sweeps at one placement are correlated.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.bundle import Early
from appliance.core.errors import FormatError
from appliance.inference.classifier import LEAST_PROBABILITY, softmax
from appliance.inference.enrolment import extended
from train.calibration.early_exit import LEVELS, decide
from train.calibration.novelty import Embedding, auroc, embed
from train.data.sets import Dataset, digest, join
from train.data.splitters import Protocol
from train.evaluation.evaluate import Where
from train.evaluation.uncertainty_cases import Case, Log, cases, tasks
from train.metrics.score import interval, provenance
from train.models import methods
from train.models.methods import Effort
from train.models.recipe.calibrate import Calibration

Array = NDArray[Any]
Json = dict[str, Any]
BINS = 10
"""Bins of the reliability diagram and of the calibration error."""
WANTED = (0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
MOST_SWEEPS = 5
"""Number of sweeps of an object after which the answer is final."""
ENROLLED = (1, 2, 3, 5, 7, 10)
"""Numbers of sweeps from which a material is enrolled."""
LIMITS = (0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.7, 2.0)
"""Multiples of the novelty limit at which the shares of kept and of passed sweeps are reported."""
DRAWS, ORDERS = 500, 20
"""Draws of the bootstrap; random orders of the sweeps of one object, or of one enrolment."""
Trained = tuple[Case, Calibration]
"""One training and its calibration."""


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
    if test is not None:
        both = join([sweeps.require_materials(), test])
        protocol, whole_set = "split:set=0->1", both
    else:
        whole_set = sweeps
    folds = Protocol(protocol).folds(whole_set, seed)
    trained = cases(tasks(whole_set, folds, method, effort, seed), whole_set, where, log)
    log("figures")
    result = figures(trained, whole_set.materials, seed)
    about = {
        "set": sweeps.source,
        "test": test.source if test else "",
        "protocol": "train and test" if test else protocol,
        "method": method,
        "effort": effort.share,
        "seed": seed,
        "folds": len(folds),
        "trainings": len(trained),
        "sweeps": len(whole_set),
        "tested": int(sum(len(test) for _, test in folds)),
        "digest": digest(whole_set),
        "materials": list(whole_set.materials),
        "format": str(whole_set.format),
        "took_s": round(time.monotonic() - start, 1),
    }
    return about | provenance() | result


def figures(trained: Sequence[Case], materials: Sequence[str], seed: int) -> Json:
    """All figures. With two materials there are none that need a material left out."""
    fitted = [(case, case.calibration()) for case in trained]
    full = [one for one in fitted if one[0].left_out < 0]
    result = {
        "calibration": calibration(full),
        "sequence": sequence(full, seed),
        "early": early(full),
    }
    without = [one for one in fitted if one[0].left_out >= 0]
    if without:
        result["unknown"] = unknown(without, materials)
        result["enrolment"] = enrolment(full, without, materials, seed)
    return result


def calibration(full: Sequence[Trained]) -> Json:
    """Expected calibration error and reliability before the temperature (LDA's own posteriors) and
    after."""
    labels, places = _joined(full, "labels"), _places(full)
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
        low, high = _bootstrap(partial(_error_of, confidence, right), places)
        result[name] = {
            "error": round(error(confidence, right), 4),
            "low": low,
            "high": high,
            "bins": reliability(confidence, right),
        }
    result["accuracy"] = _accuracy(right, places)
    return result


def error(confidence: Array, right: Array) -> float:
    """Expected calibration error (Naeini et al. 2015): mean over sweeps of |accuracy - probability|
    of their bin."""
    bins = reliability(confidence, right)
    return float(
        sum(b["n"] * abs(b["right"] - b["said"]) for b in bins) / max(sum(b["n"] for b in bins), 1)
    )


def _error_of(confidence: Array, right: Array, some: Array) -> float:
    return error(confidence[some], right[some])


def reliability(confidence: Array, right: Array) -> list[Json]:
    """For each non-empty bin of the highest probability [n]: its mean (`said`), the share of right
    answers, and their number."""
    which = np.minimum((confidence * BINS).astype(int), BINS - 1)
    some = [(which == b) for b in range(BINS) if (which == b).any()]
    return [
        {
            "said": round(float(confidence[i].mean()), 4),
            "right": round(float(right[i].mean()), 4),
            "n": int(i.sum()),
        }
        for i in some
    ]


def sequence(full: Sequence[Trained], seed: int) -> Json:
    """Mean number of sweeps and accuracy for each of the WANTED probabilities.

    Sweeps of one object are fused until the probability is reached, at most MOST_SWEEPS. "same
    place": all sweeps are of one attachment, and their errors are correlated. "several places":
    they are drawn from all test sweeps.
    """
    log_p = np.log(
        np.maximum(
            softmax(np.concatenate([d.logits(c.new[:, -1]) for c, d in full])), LEAST_PROBABILITY
        )
    )
    labels, places = _joined(full, "labels"), _places(full)
    rng, result = np.random.default_rng(seed), {}
    for name, objects in (
        ("same place", labels + places * (labels.max() + 1)),
        ("several places", labels),
    ):
        members = [np.flatnonzero(objects == o) for o in np.unique(objects)]
        repeat = max(ORDERS, 400 // len(members))
        picks = [
            rng.permutation(m)[:MOST_SWEEPS]
            for m in members
            for _ in range(repeat)
            if len(m) >= MOST_SWEEPS
        ]
        if not picks:
            continue
        order = np.array(picks)
        fused = softmax(log_p[order].cumsum(axis=1))  # [objects, MOST_SWEEPS, K]
        truth = labels[order[:, 0]]
        clusters = places[order[:, 0]] if name == "same place" else truth
        result[name] = {
            "objects": len(order),
            "points": [_stopped(fused, truth, clusters, p) for p in (0.0, *WANTED)],
        }
    return result


def _stopped(fused: Array, truth: Array, clusters: Array, wanted: float) -> Json:
    """The result of a sequential test that stops at the probability `wanted` or after the last
    sweep."""
    enough = fused.max(2) >= wanted
    decided = enough.any(axis=1)
    enough[:, -1] = True
    stop = enough.argmax(axis=1)
    named = fused[np.arange(len(fused)), stop].argmax(1)
    right = named == truth
    return {
        "wanted": wanted,
        "sweeps": round(float(stop.mean() + 1), 3),
        "decided": round(float(decided.mean()), 4),
        "right_of_decided": round(float(right[decided].mean()), 4) if decided.any() else None,
        **_accuracy(right, clusters),
    }


def early(full: Sequence[Trained]) -> Json:
    """Accuracy and mean share of the sweep for the rules found in training, for other rules, and
    for an answer after the first tenth."""
    labels, places = _joined(full, "labels"), _places(full)
    p = np.concatenate([done.probabilities(case.new) for case, done in full])
    whole = p[:, -1].argmax(1) == labels
    steps = p.shape[1]
    by_rule = [
        decide(p_, done.rule.early) if done.rule.early else (p_[:, -1].argmax(1), np.ones(len(p_)))
        for (_, done), p_ in zip(full, _parted(p, full), strict=True)
    ]
    named, share = (np.concatenate(part) for part in zip(*by_rule, strict=True))
    lost = whole.astype(float) - (named == labels)
    low, high = _bootstrap(partial(_mean_of, lost), places)
    rules = [
        {
            "least": r.early.least[0] if r.early else None,
            "agree": r.early.agree if r.early else None,
            "why": r.why,
            "n": r.n,
        }
        for r in (done.rule for _, done in full)
    ]
    curves = {}
    for agree in (1, 2, 3):
        met = [decide(p, _same(level, agree, steps)) for level in LEVELS]
        curves[str(agree)] = [
            {
                "least": level,
                "share": round(float(s.mean()), 4),
                "accuracy": round(float(np.mean(k == labels)), 4),
            }
            for level, (k, s) in zip(LEVELS, met, strict=True)
        ]
    return {
        "n": len(labels),
        "share": round(float(share.mean()), 4),
        "lost": round(float(lost.mean()), 4),
        "lost_low": low,
        "lost_high": high,
        "rule": _accuracy(named == labels, places),
        "whole": _accuracy(whole, places),
        "rules": rules,
        "always": [_accuracy(p[:, d].argmax(1) == labels, places) for d in range(steps)],
        "curves": curves,
    }


def unknown(without: Sequence[Trained], materials: Sequence[str]) -> Json:
    """Detection of a material that was left out of training.

    Gives the AUROC of known test sweeps against those of the material, for several scores; the
    share of known sweeps below the limit found in training, and of unknown sweeps that pass as
    known; the same at multiples of the limit, and if a second sweep at the same placement must pass
    as well.
    """
    materials_of: dict[str, Json] = {}
    every: dict[str, list[float]] = {}
    passed: list[Array] = []
    for k in sorted({case.left_out for case, _ in without}):
        held = [one for one in without if one[0].left_out == k]
        known, places = np.concatenate([case.known() for case, _ in held]), _places(held)
        scores = {
            name: np.concatenate([score(case, done) for case, done in held])
            for name, score in SCORES.items()
        }
        ours = scores["distance"]
        low, high = _bootstrap(partial(_auroc_of, ours, known), places)
        at = np.quantile(ours[known], 0.95)
        materials_of[materials[k]] = {
            "auroc": round(auroc(ours[known], ours[~known]), 4),
            "low": low,
            "high": high,
            "kept": round(float(np.mean(ours[known] <= 1)), 4),
            "false_known": round(float(np.mean(ours[~known] <= 1)), 4),
            "false_known_at_95": round(float(np.mean(ours[~known] <= at)), 4),
            "known": int(known.sum()),
            "unknown": int((~known).sum()),
        }
        labels = _joined(held, "labels")
        passed.append(
            np.array(
                [
                    [_passed(ours, known, places, labels, factor, n) for n in (1, 2)]
                    for factor in LIMITS
                ]
            )
        )
        for name, row in scores.items():
            every.setdefault(name, []).append(auroc(row[known], row[~known]))
    mean = {
        name: round(float(np.mean([row[name] for row in materials_of.values()])), 4)
        for name in ("auroc", "kept", "false_known", "false_known_at_95")
    }
    means = {name: round(float(np.mean(values)), 4) for name, values in every.items()}
    limits = [
        {
            "factor": factor,
            "kept": one[0],
            "false_known": one[1],
            "kept_twice": two[0],
            "false_known_twice": two[1],
        }
        for factor, (one, two) in zip(
            LIMITS, np.mean(passed, axis=0).round(4).tolist(), strict=True
        )
    ]
    return {"materials": materials_of, "mean": mean, "scores": means, "limits": limits}


def _passed(
    scores: Array, known: Array, places: Array, labels: Array, factor: float, n: int
) -> tuple[float, float]:
    """Shares of known and of unknown sweeps that pass `factor` times the limit together with the
    next n - 1 sweeps of their material at their placement. The last sweeps of a placement have too
    few successors and are left out."""
    order = np.lexsort((labels, places))
    here, fits = np.stack([places, labels])[:, order], (scores <= factor)[order]
    size = len(order) - n + 1
    whole = (here[:, :size] == here[:, n - 1 :]).all(axis=0)
    all_fit = np.logical_and.reduce([fits[i : i + size] for i in range(n)])[whole]
    is_known = known[order][:size][whole]
    return float(all_fit[is_known].mean()), float(all_fit[~is_known].mean())


def _auroc_of(scores: Array, known: Array, some: Array) -> float:
    return auroc(scores[some][known[some]], scores[some][~known[some]])


def _mean_of(values: Array, some: Array) -> float:
    return float(values[some].mean())


def _of_trunk(case: Case, done: Calibration) -> Array:
    """Squared distance in the trained features alone; 0 for all sweeps if there are none."""
    if not (size := case.seen.shape[2] - case.fixed):
        return np.zeros(len(case.new))
    return embed(case.seen[:, -1, :size], case.seen_labels, size).novelty(case.new[:, -1, :size])


SCORES: dict[str, Callable[[Case, Calibration], Array]] = {
    "distance": lambda case, done: done.embedding.novelty(case.new[:, -1]) / done.limit,
    "distance, trained features only": _of_trunk,
    "distance, where trained materials differ": lambda case, done: embed(
        case.seen[:, -1], case.seen_labels
    ).novelty(case.new[:, -1]),
    "highest probability": lambda case, done: -softmax(done.logits(case.new[:, -1])).max(1),
}
"""Each score is larger for a sweep that is less like the training sweeps. The limits of folds
differ, so the first score is in units of the limit."""


def enrolment(
    full: Sequence[Trained], without: Sequence[Trained], materials: Sequence[str], seed: int
) -> Json:
    """Enrolment of a material that was left out of training, from some sweeps of one placement.

    Gives the balanced accuracy of all classes at the same placement and at others, as a share of
    that of the model trained on all materials; and the accuracy lost by the old classes.
    """
    whole = {case.fold: (case, done) for case, done in full}
    rows: dict[tuple[str, int], list[tuple[float, ...]]] = {}
    for case, done in without:
        rng = np.random.default_rng([seed, case.fold, case.left_out])
        for n, where, row in _enrolled(case, done, *whole[case.fold], rng):
            rows.setdefault((where, n), []).append((case.left_out, *row))
    points: list[Json] = []
    for (where, n), row_list in sorted(rows.items()):
        values = np.array(row_list)
        share, by_material = values[:, 1] / values[:, 2], values[:, 0].astype(int)
        low, high = _bootstrap(partial(_mean_of, share), by_material)
        points.append(
            {
                "where": where,
                "sweeps": n,
                "share": round(float(share.mean()), 4),
                "low": low,
                "high": high,
                "accuracy": round(float(values[:, 1].mean()), 4),
                "trained": round(float(values[:, 2].mean()), 4),
                "new": round(float(values[:, 3].mean()), 4),
                "old_lost": round(float(values[:, 4].mean()), 4),
                "draws": len(values),
                "by_material": {
                    materials[k]: round(float(share[by_material == k].mean()), 4)
                    for k in np.unique(by_material)
                },
            }
        )
    return {"points": points}


def _enrolled(
    case: Case, done: Calibration, whole: Case, trained: Calibration, rng: np.random.Generator
) -> Iterator[tuple[int, str, tuple[float, float, float, float]]]:
    """For each random draw: (sweeps, where, (accuracy, accuracy of the model trained on all
    materials, recall of the new material, loss of the old ones))."""
    z, k = done.embedding(case.new[:, -1]), case.left_out
    as_trained = trained.logits(whole.new[:, -1]).argmax(1)
    names = np.append(
        np.delete(np.arange(case.labels.max() + 1), k), k
    )  # the box puts the new label last
    before = names[done.logits(case.new[:, -1]).argmax(1)]
    mine, places = np.flatnonzero(case.labels == k), np.unique(case.places)
    for n in ENROLLED:
        for _ in range(max(ORDERS // len(places), 2) if n <= len(mine) else 0):
            for place in places:
                there = mine[case.places[mine] == place]
                if len(there) < n:
                    continue
                drawn = rng.permutation(there)[:n]
                named = names[enrolled_logits(done.embedding, z, z[drawn]).argmax(1)]
                for where, chosen in (
                    ("same place", case.places == place),
                    ("other places", case.places != place),
                ):
                    test = np.setdiff1d(np.flatnonzero(chosen), drawn)
                    if (case.labels[test] == k).any() and (case.labels[test] != k).any():
                        label, old = case.labels[test], test[case.labels[test] != k]
                        yield (
                            n,
                            where,
                            (
                                _balanced(named[test], label),
                                _balanced(as_trained[test], label),
                                float(np.mean(named[test][label == k] == k)),
                                float(
                                    np.mean(before[old] == case.labels[old])
                                    - np.mean(named[old] == case.labels[old])
                                ),
                            ),
                        )


def enrolled_logits(embedding: Embedding, z: Array, sweeps: Array) -> Array:
    """Logits [n, K + 1], before temperature scaling, of embeddings z [n, r]; the last label is
    enrolled from `sweeps` [m, r] as on the box."""
    enrolled = extended(embedding.classes(), sweeps)
    logits: Array = z @ enrolled.means.T + enrolled.bias
    return logits


def _balanced(named: Array, labels: Array) -> float:
    return float(np.mean([np.mean(named[labels == k] == k) for k in np.unique(labels)]))


def _joined(held: Sequence[Trained], name: str) -> Array:
    return np.concatenate([getattr(case, name) for case, _ in held])


def _places(held: Sequence[Trained]) -> Array:
    """The placement of the skin in each test sweep, numbered from 0."""
    places: Array = np.unique(_joined(held, "places"), return_inverse=True)[1]
    return places


def _parted(rows: Array, held: Sequence[Trained]) -> list[Array]:
    """`rows` of all cases, split by case."""
    return np.split(rows, np.cumsum([len(case.labels) for case, _ in held])[:-1])


def _same(level: float, agree: int, steps: int) -> Early:
    return Early((level,) * (steps - 1), agree)


def _accuracy(right: Array, clusters: Array) -> Json:
    low, high = interval(right, clusters)
    return {"accuracy": round(float(right.mean()), 4), "low": low, "high": high}


def _bootstrap(figure: Callable[[Array], float], clusters: Array) -> tuple[float, float]:
    """The 95 % interval of `figure`, a function of sweep numbers, from a bootstrap of clusters
    [n]."""
    members = [np.flatnonzero(clusters == c) for c in np.unique(clusters)]
    rng, drawn = np.random.default_rng(0), []
    for _ in range(DRAWS):
        with suppress(FormatError):  # a draw that lacks a kind of sweep has no figure
            drawn.append(
                figure(
                    np.concatenate(
                        [members[c] for c in rng.integers(len(members), size=len(members))]
                    )
                )
            )
    low, high = np.quantile(drawn, (0.025, 0.975)) if drawn else (0.0, 1.0)
    return round(float(low), 4), round(float(high), 4)
