"""The room where certainty is judged. In: Cases of certainty.py. Out: figures, as results.json holds them.

Calibration, the sequential test, unknown materials, enrolment and early decisions, each on test sweeps that nothing was
fitted on. Intervals are 95 %, bootstrapped over the places where the skin sat, whose sweeps fail together.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.bundle import Early
from appliance.core.errors import FormatError
from appliance.inference.classifier import LEAST_PROBABILITY, softmax
from appliance.inference.enrolment import joined
from train.calibration.early_exit import LEVELS, decide
from train.calibration.novelty import Embedding, auroc, embed
from train.calibration.posthoc import Posthoc
from train.data.sets import Dataset, digest, join
from train.data.splitters import Protocol
from train.evaluation.evaluate import Where
from train.evaluation.uncertainty_cases import Case, Log, cases, tasks
from train.metrics.score import interval, provenance
from train.models import methods
from train.models.methods import Effort

Array = NDArray[Any]
Json = dict[str, Any]
BINS = 10
"""Of the reliability picture and of the calibration error."""
SURE = (0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
MOST_SWEEPS = 5
"""After so many sweeps of an object the answer is final."""
ENROLLED = (1, 2, 3, 5, 7, 10)
DRAWS, ORDERS = 500, 20
"""Of the bootstrap; of the order in which sweeps of one object, or for one enrolment, come."""


def run(
    sweeps: Dataset, test: Dataset | None, protocol: str, method: str, where: Where, log: Log,
    effort: Effort = methods.FULL_EFFORT, seed: int = 1,
) -> dict[str, Any]:  # fmt: skip
    """All figures, as results.json holds them. test: tested on this set; else `protocol` says what is left out.

    Raises FormatError where the sets do not fit, or the method cannot do it.
    """
    start = time.monotonic()
    if test is not None:
        both = join([sweeps.require_materials(), test])
        protocol, whole_set = "split:set=0->1", both
    else:
        whole_set = sweeps
    folds = Protocol(protocol).folds(whole_set, seed)
    held = cases(tasks(whole_set, folds, method, effort, seed), whole_set, where, log)
    log("figures")
    told = figures(held, whole_set.materials, seed)
    about = {
        "set": sweeps.source, "test": test.source if test else "", "protocol": "train and test" if test else protocol,
        "method": method, "effort": effort.share, "seed": seed, "folds": len(folds), "trainings": len(held),
        "sweeps": len(whole_set), "tested": int(sum(len(test) for _, test in folds)), "digest": digest(whole_set),
        "materials": list(whole_set.materials), "format": str(whole_set.format),
        "took_s": round(time.monotonic() - start, 1),
    }  # fmt: skip
    return about | provenance() | told


def figures(trained: Sequence[Case], materials: Sequence[str], seed: int) -> Json:
    """All of it; what needs a material left out is missing where there are but two."""
    done = [(case, case.posthoc()) for case in trained]
    full = [one for one in done if one[0].left_out < 0]
    told = {"calibration": calibration(full), "sequence": sequence(full, seed), "early": early(full)}
    partial = [one for one in done if one[0].left_out >= 0]
    if partial:
        told["unknown"] = unknown(partial, materials)
        told["enrolment"] = enrolment(full, partial, materials, seed)
    return told


def calibration(full: Sequence[tuple[Case, Posthoc]]) -> Json:
    """Expected calibration error and reliability before (LDA's own posteriors) and after the temperature."""
    labels, places = _joined(full, "labels"), _places(full)
    told: Json = {"n": len(labels), "temperature": [round(done.temperature, 2) for _, done in full]}
    for name, heat in (("before", True), ("after", False)):
        logits = np.concatenate(
            [done.logits(case.new[:, -1]) * (done.temperature if heat else 1) for case, done in full]
        )
        p = softmax(logits)
        sure, right = p.max(1), p.argmax(1) == labels
        low, high = _spread(lambda i, s=sure, r=right: error(s[i], r[i]), places)
        told[name] = {"error": round(error(sure, right), 4), "low": low, "high": high, "bins": reliability(sure, right)}
    told["accuracy"] = _accuracy(right, places)
    return told


def error(sure: Array, right: Array) -> float:
    """Expected calibration error (Naeini et al. 2015): mean over sweeps of |accuracy - probability| of their bin."""
    held = reliability(sure, right)
    return float(sum(b["n"] * abs(b["right"] - b["said"]) for b in held) / max(sum(b["n"] for b in held), 1))


def reliability(sure: Array, right: Array) -> list[Json]:
    """Of each bin of the highest probability [n] that is not empty: what was said, what was right, of how many."""
    which = np.minimum((sure * BINS).astype(int), BINS - 1)
    some = [(which == b) for b in range(BINS) if (which == b).any()]
    return [{"said": round(float(sure[i].mean()), 4), "right": round(float(right[i].mean()), 4), "n": int(i.sum())}
            for i in some]  # fmt: skip


def sequence(full: Sequence[tuple[Case, Posthoc]], seed: int) -> Json:
    """Mean sweeps against accuracy for wanted probabilities, sweeps of one object fused until then or to MOST_SWEEPS.

    "same place": all sweeps of one attachment, whose errors go together; "several places": from anywhere in the test.
    """
    log_p = np.log(np.maximum(softmax(np.concatenate([d.logits(c.new[:, -1]) for c, d in full])), LEAST_PROBABILITY))
    labels, places = _joined(full, "labels"), _places(full)
    rng, told = np.random.default_rng(seed), {}
    for name, objects in (("same place", labels + places * (labels.max() + 1)), ("several places", labels)):
        members = [np.flatnonzero(objects == o) for o in np.unique(objects)]
        repeat = max(ORDERS, 400 // len(members))
        picks = [rng.permutation(m)[:MOST_SWEEPS] for m in members for _ in range(repeat) if len(m) >= MOST_SWEEPS]
        if not picks:
            continue
        order = np.array(picks)
        fused = softmax(log_p[order].cumsum(axis=1))  # [objects, MOST_SWEEPS, K]
        truth = labels[order[:, 0]]
        clusters = places[order[:, 0]] if name == "same place" else truth
        told[name] = {"objects": len(order), "points": [_stopped(fused, truth, clusters, p) for p in (0.0, *SURE)]}
    return told


def _stopped(fused: Array, truth: Array, clusters: Array, wanted: float) -> Json:
    """What the sequential test gives where it stops at the probability `wanted`, or after the last sweep."""
    enough = fused.max(2) >= wanted
    sure = enough.any(axis=1)
    enough[:, -1] = True
    stop = enough.argmax(axis=1)
    named = fused[np.arange(len(fused)), stop].argmax(1)
    right = named == truth
    return {"wanted": wanted, "sweeps": round(float(stop.mean() + 1), 3), "decided": round(float(sure.mean()), 4),
            "right_of_decided": round(float(right[sure].mean()), 4) if sure.any() else None,
            **_accuracy(right, clusters)}  # fmt: skip


def early(full: Sequence[tuple[Case, Posthoc]]) -> Json:
    """Accuracy against the mean share of the sweep: by the rules as found in training, by others, always at a tenth."""
    labels, places = _joined(full, "labels"), _places(full)
    p = np.concatenate([done.probabilities(case.new) for case, done in full])
    whole = p[:, -1].argmax(1) == labels
    steps = p.shape[1]
    by_rule = [decide(p_, done.rule.early) if done.rule.early else (p_[:, -1].argmax(1), np.ones(len(p_)))
               for (_, done), p_ in zip(full, _parted(p, full), strict=True)]  # fmt: skip
    named, share = (np.concatenate(part) for part in zip(*by_rule, strict=True))
    lost = whole.astype(float) - (named == labels)
    low, high = _spread(lambda i: float(lost[i].mean()), places)
    rules = [{"least": r.early.least[0] if r.early else None, "agree": r.early.agree if r.early else None, "why": r.why,
              "n": r.n} for r in (done.rule for _, done in full)]  # fmt: skip
    curves = {}
    for agree in (1, 2, 3):
        met = [decide(p, _same(level, agree, steps)) for level in LEVELS]
        curves[str(agree)] = [{"least": level, "share": round(float(s.mean()), 4),
                               "accuracy": round(float(np.mean(k == labels)), 4)}
                              for level, (k, s) in zip(LEVELS, met, strict=True)]  # fmt: skip
    return {
        "n": len(labels), "share": round(float(share.mean()), 4), "lost": round(float(lost.mean()), 4), "lost_low": low,
        "lost_high": high, "rule": _accuracy(named == labels, places), "whole": _accuracy(whole, places), "rules": rules,
        "always": [_accuracy(p[:, d].argmax(1) == labels, places) for d in range(steps)], "curves": curves,
    }  # fmt: skip


def unknown(partial: Sequence[tuple[Case, Posthoc]], materials: Sequence[str]) -> Json:
    """Leave one material out: AUROC of known test sweeps against those of the material, by several scores; what the
    limit found in training keeps, and what of the unknown it lets through as known."""
    told: Json = {"materials": {}}
    every: dict[str, list[float]] = {}
    for k in sorted({case.left_out for case, _ in partial}):
        held = [one for one in partial if one[0].left_out == k]
        known, places = np.concatenate([case.known() for case, _ in held]), _places(held)
        rows = {name: np.concatenate([score(case, done) for case, done in held]) for name, score in SCORES.items()}
        ours = rows["distance"]
        low, high = _spread(lambda i, s=ours, m=known: auroc(s[i][m[i]], s[i][~m[i]]), places)
        at = np.quantile(ours[known], 0.95)
        told["materials"][materials[k]] = {
            "auroc": round(auroc(ours[known], ours[~known]), 4), "low": low, "high": high,
            "kept": round(float(np.mean(ours[known] <= 1)), 4), "false_known": round(float(np.mean(ours[~known] <= 1)), 4),
            "false_known_at_95": round(float(np.mean(ours[~known] <= at)), 4),
            "known": int(known.sum()), "unknown": int((~known).sum()),
        }  # fmt: skip
        for name, row in rows.items():
            every.setdefault(name, []).append(auroc(row[known], row[~known]))
    rows = list(told["materials"].values())
    told["mean"] = {name: round(float(np.mean([row[name] for row in rows])), 4)
                    for name in ("auroc", "kept", "false_known", "false_known_at_95")}  # fmt: skip
    told["scores"] = {name: round(float(np.mean(values)), 4) for name, values in every.items()}
    return told


def _of_trunk(case: Case, done: Posthoc) -> Array:
    """Squared distance in the trained features alone: all of them; the same for all where there are none."""
    if not (size := case.seen.shape[2] - case.fixed):
        return np.zeros(len(case.new))
    return embed(case.seen[:, -1, :size], case.seen_labels, size).strangeness(case.new[:, -1, :size])


SCORES: dict[str, Callable[[Case, Posthoc], Array]] = {
    "distance": lambda case, done: done.embedding.strangeness(case.new[:, -1]) / done.limit,
    "distance, trained features only": _of_trunk,
    "distance, where trained materials differ": lambda case, done: embed(
        case.seen[:, -1], case.seen_labels).strangeness(case.new[:, -1]),
    "highest probability": lambda case, done: -softmax(done.logits(case.new[:, -1])).max(1),
}  # fmt: skip
"""Each grows with how little a sweep is like what was trained. Limits of several folds differ: the first is in units of
the limit."""


def enrolment(
    full: Sequence[tuple[Case, Posthoc]], partial: Sequence[tuple[Case, Posthoc]], materials: Sequence[str], seed: int
) -> Json:
    """Leave a material out and enrol it from some sweeps of one place: accuracy of all classes (mean of each one's)
    there and elsewhere, as a share of what the model gets that was trained on all; what the old classes lose."""
    whole = {case.fold: (case, done) for case, done in full}
    rows: dict[tuple[str, int], list[tuple[float, ...]]] = {}
    for case, done in partial:
        rng = np.random.default_rng([seed, case.fold, case.left_out])
        for n, where, row in _enrolled(case, done, *whole[case.fold], rng):
            rows.setdefault((where, n), []).append((case.left_out, *row))
    told: Json = {"points": []}
    for (where, n), held in sorted(rows.items()):
        values = np.array(held)
        of, by_material = values[:, 1] / values[:, 2], values[:, 0].astype(int)
        low, high = _spread(lambda i, of=of: float(of[i].mean()), by_material)
        told["points"].append({
            "where": where, "sweeps": n, "share": round(float(of.mean()), 4), "low": low, "high": high,
            "accuracy": round(float(values[:, 1].mean()), 4), "trained": round(float(values[:, 2].mean()), 4),
            "new": round(float(values[:, 3].mean()), 4), "old_lost": round(float(values[:, 4].mean()), 4),
            "draws": len(values),
            "by_material": {materials[k]: round(float(of[by_material == k].mean()), 4) for k in np.unique(by_material)},
        })  # fmt: skip
    return told


def _enrolled(
    case: Case, done: Posthoc, whole: Case, trained: Posthoc, rng: np.random.Generator
) -> Iterator[tuple[int, str, tuple[float, float, float, float]]]:
    """(sweeps, where, (accuracy, that of the whole model, recall of the new one, what the old lose)) of random draws."""
    z, k = done.embedding(case.new[:, -1]), case.left_out
    as_trained = trained.logits(whole.new[:, -1]).argmax(1)
    names = np.append(np.delete(np.arange(case.labels.max() + 1), k), k)  # the box puts the new label last
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
                for where, chosen in (("same place", case.places == place), ("other places", case.places != place)):
                    test = np.setdiff1d(np.flatnonzero(chosen), drawn)
                    if (case.labels[test] == k).any() and (case.labels[test] != k).any():
                        label, old = case.labels[test], test[case.labels[test] != k]
                        yield n, where, (
                            _balanced(named[test], label), _balanced(as_trained[test], label),
                            float(np.mean(named[test][label == k] == k)),
                            float(np.mean(before[old] == case.labels[old]) - np.mean(named[old] == case.labels[old])),
                        )  # fmt: skip


def enrolled_logits(embedding: Embedding, z: Array, sweeps: Array) -> Array:
    """Logits [n, K + 1], not cooled, of embeddings z [n, r] with a label more, enrolled from `sweeps` [m, r] as the box
    does it."""
    enrolled = joined(embedding.classes(), sweeps)
    logits: Array = z @ enrolled.means.T + enrolled.bias
    return logits


def _balanced(named: Array, labels: Array) -> float:
    return float(np.mean([np.mean(named[labels == k] == k) for k in np.unique(labels)]))


def _joined(held: Sequence[tuple[Case, Posthoc]], name: str) -> Array:
    return np.concatenate([getattr(case, name) for case, _ in held])


def _places(held: Sequence[tuple[Case, Posthoc]]) -> Array:
    """Where the skin sat, from 0 on."""
    places: Array = np.unique(_joined(held, "places"), return_inverse=True)[1]
    return places


def _parted(rows: Array, held: Sequence[tuple[Case, Posthoc]]) -> list[Array]:
    """`rows` of all cases, case by case."""
    return np.split(rows, np.cumsum([len(case.labels) for case, _ in held])[:-1])


def _same(level: float, agree: int, steps: int) -> Early:
    return Early((level,) * (steps - 1), agree)


def _accuracy(right: Array, clusters: Array) -> Json:
    low, high = interval(right, clusters)
    return {"accuracy": round(float(right.mean()), 4), "low": low, "high": high}


def _spread(figure: Callable[[Array], float], clusters: Array) -> tuple[float, float]:
    """The 95 % interval of `figure` (of sweep numbers) where whole clusters [n] are drawn with replacement."""
    members = [np.flatnonzero(clusters == c) for c in np.unique(clusters)]
    rng, drawn = np.random.default_rng(0), []
    for _ in range(DRAWS):
        with suppress(FormatError):  # a draw without a sweep of one kind has no figure
            drawn.append(figure(np.concatenate([members[c] for c in rng.integers(len(members), size=len(members))])))
    low, high = np.quantile(drawn, (0.025, 0.975)) if drawn else (0.0, 1.0)
    return round(float(low), 4), round(float(high), 4)
