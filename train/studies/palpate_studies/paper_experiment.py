"""The study `paper`: the paper's experiment on the simulated sets, with more methods.

evaluate caches folds, so an interrupted run goes on where it was.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from palpate.answer.objects import Evidence, softmax
from palpate.core.status import LEAST_PROBABILITY
from palpate.core.sweep_set import Array
from palpate_studies.study import StudyCase, StudyRun
from palpate_train.data.sets import Dataset
from palpate_train.evaluate.evaluate import Plan, Result, evaluate
from palpate_train.metrics import score
from palpate_train.models import methods
from palpate_train.models.methods import FULL_EFFORT, Effort, Log

Json = dict[str, Any]
CNN = "paper-cnn"
BASELINES = ("L-gauss", "L-knn", "L-svm", "H-knn", "H-svm")
FIGURES = {"lab": 4, "lopo": 5, "random": 6, "hard": 7}
"""Number of the figure by case."""
PRINTED: dict[str, dict[str, float]] = {
    "lab": dict(zip(BASELINES, (0.85, 0.82, 0.85, 0.90, 0.96), strict=True)),
    "lopo": dict(zip((*BASELINES, CNN), (0.78, 0.77, 0.79, 0.75, 0.86, 0.923), strict=True)),
    "random": dict(zip(BASELINES, (0.80, 0.80, 0.83, 0.85, 0.93), strict=True)),
    "hard": dict(zip((*BASELINES, CNN), (0.57, 0.58, 0.55, 0.50, 0.70, 0.917), strict=True)),
}
"""Accuracies that the paper prints in Figs. 4 to 7, and in Fig. 10 for the CNN, whose values are no
text, by case and method."""
CONFUSION = np.array(
    [
        [0.78, 0.10, 0.00, 0.00, 0.12, 0.00],
        [0.06, 0.90, 0.00, 0.02, 0.02, 0.00],
        [0.00, 0.00, 0.98, 0.00, 0.01, 0.01],
        [0.00, 0.01, 0.02, 0.97, 0.00, 0.00],
        [0.07, 0.01, 0.01, 0.00, 0.90, 0.00],
        [0.01, 0.00, 0.00, 0.00, 0.00, 0.99],
    ]
)
"""Fig. 11, the CNN on T-REAL with a position left out: rows are the truth, in the order of
skin.MATERIALS."""
NEIGHBOURS = ("fishel-bayes", "static-svm", "spectrogram-svm", "correlation-svm")
NETWORKS = ("tactnet2", "recurrent")
OWN = ("palpate-reattached", "palpate")
SURE = (0.9, 0.95, 0.99)
"""Posteriors at which no more sweeps are added."""
SEVERAL = 3
ATTACHMENTS = 36
"""Seeds of T-HARD for each seed of a case, 18 sweeps each."""
PLACES = 10_000
"""More than a seed has attachments."""


def load(case: StudyCase, seed: int) -> Dataset:
    """The sweeps of a case of one seed, which stands for {w} in the names of its sets; {a} and {b}
    are its first and last seed of T-HARD."""
    last = ATTACHMENTS * seed
    sweeps = case.load(w=seed, a=last - ATTACHMENTS + 1, b=last)
    assert sweeps is not None  # all are simulated
    return sweeps


@dataclass(frozen=True)
class Step:
    """Methods that are trained and tested in the same cases (`parts`) and with the same seeds."""

    methods: tuple[str, ...]
    parts: tuple[str, ...]
    seeds: tuple[int, ...]


HARD, EASY = ("lopo", "hard"), ("lab", "random")
BLIND = "/level-blind"
"""End of the name of a case in the level-blind world."""
HARD_BLIND = tuple(part + BLIND for part in HARD)


def in_both_worlds(laboratory: Mapping[str, StudyCase]) -> dict[str, StudyCase]:
    """The cases of the laboratory, and its HARD ones in the level-blind world too."""
    return {
        **laboratory,
        **{
            part + BLIND: replace(
                laboratory[part],
                sets=tuple(
                    re.sub(r"^sim:[^:]*", rf"\g<0>{BLIND}", name) for name in laboratory[part].sets
                ),
            )
            for part in HARD
        },
    }


FULL = in_both_worlds(
    {
        "lopo": StudyCase(("sim:T-REAL:{w}",), "leave:position"),
        "hard": StudyCase(("sim:T-REAL:{w}", "sim:T-HARD:{a}-{b}:3"), "split:set=0->1"),
        "lab": StudyCase(("sim:T-LAB:{w}",), "random:10"),
        "random": StudyCase(("sim:T-REAL:{w}",), "random:9"),
    }
)
FULL_STEPS = (
    Step(BASELINES, (*HARD, *EASY, *HARD_BLIND), (1, 2, 3, 4, 5)),
    Step(NEIGHBOURS, (*HARD, *HARD_BLIND), (1, 2, 3)),
    Step(OWN, ("hard", "hard" + BLIND), (1, 2, 3)),
    Step(OWN[:1], ("lopo",), (1, 2, 3)),
    Step(OWN[:1], ("lopo" + BLIND,), (1,)),
    Step(("minirocket", "st-hmp"), (*HARD, *HARD_BLIND), (1,)),
    Step(NETWORKS, (*HARD, *HARD_BLIND), (1,)),
    Step((CNN, "paper-cnn-centred"), ("hard", "hard" + BLIND), (1,)),
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a method in a case with one seed: labels [n] and logits [n, K] of the tested
    sweeps.

    place: int [n], the attachment of the skin, unique over seeds. about: its entry in the
    results.
    """

    part: str
    method: str
    seed: int
    labels: Array
    logits: Array
    place: Array
    about: dict[str, Any] = field(repr=False)

    @classmethod
    def of(cls, part: str, seed: int, result: Result) -> Outcome:
        """From a result of evaluate."""
        test, sweeps = result.test, result.sweeps
        place = sweeps.group("position")[test] + PLACES * seed
        about = result.json() | {"part": part}
        return cls(part, result.method, seed, sweeps.labels[test], result.logits, place, about)

    @cached_property
    def explorations(self) -> Array:
        """The explorations that `objects` draws of these sweeps."""
        return objects(self.labels, self.place, self.seed)

    @property
    def right(self) -> Array:
        """bool [n], whether the label is right."""
        return np.asarray(self.logits.argmax(1) == self.labels)


def results(how: StudyRun) -> Json:
    """Train and test the whole plan; the results. Raises FormatError as evaluate does."""
    return summary(list(_outcomes(FULL, FULL_STEPS, how)), FULL, how.effort) | score.provenance()


def _outcomes(
    cases: Mapping[str, StudyCase], steps: Sequence[Step], how: StudyRun
) -> Iterator[Outcome]:
    """Run step by step. After each fold `log` gets the progress."""
    todo = [(step, part, seed) for step in steps for part in step.parts for seed in step.seeds]
    for i, (step, part, seed) in enumerate(todo, 1):
        plan = Plan(step.methods, (cases[part].protocol,), (seed,), effort=how.effort)
        log = partial(_log, how.log, f"{i}/{len(todo)} {part}, seed {seed}")
        for result in evaluate(load(cases[part], seed), plan, how.where, log):
            yield Outcome.of(part, seed, result)


def _log(log: Log, where: str, line: str) -> None:
    log(f"{where}: {line}")


def summary(
    outcomes: Sequence[Outcome], cases: Mapping[str, StudyCase], effort: Effort = FULL_EFFORT
) -> dict[str, Any]:
    """All figures of the page, as plain numbers."""
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault((outcome.part, outcome.method), []).append(outcome)
    lopo = {method: those for (part, method), those in groups.items() if part == "lopo"}
    return {
        "parts": {
            name: {"sets": case.sets, "only": case.only, "protocol": case.protocol}
            for name, case in cases.items()
        },
        "table": [_row(*key, those) for key, those in groups.items()],
        "confusion": {
            m: np.sum([o.about["confusion"] for o in those], 0).tolist()
            for m, those in lopo.items()
        },
        "several": {m: several(those) for m, those in lopo.items()},
        "explored": {m: explored(those) for m, those in lopo.items()},
        "methods": {
            name: method.about
            for name, method in methods.every(effort).items()
            if name in {m for _, m in groups}
        },
        "results": [outcome.about for outcome in outcomes],
    }


def _row(part: str, method: str, those: list[Outcome]) -> dict[str, Any]:
    """One line of the table. attachments: their number, and the accuracy of the worst and the
    best."""
    right, place = (
        np.concatenate([getattr(o, name) for o in those]) for name in ("right", "place")
    )
    each = [float(right[place == p].mean()) for p in np.unique(place)]
    return {
        "part": part,
        "method": method,
        "seeds": [o.seed for o in those],
        "right": int(right.sum()),
        "total": len(right),
        "share": estimate(right, place),
        "printed": PRINTED[part.removesuffix(BLIND)].get(method),
        "attachments": [len(each), round(min(each), 4), round(max(each), 4)],
        "ran": those[0].about["ran"],
        **{k: _median([o.about[k] for o in those]) for k in ("fit_s", "ms_p50")},
    }


def _median(values: Sequence[float | None]) -> float | None:
    """The median; None if a value was not measured."""
    measured = [value for value in values if value is not None]
    return round(float(np.median(measured)), 4) if len(measured) == len(values) else None


def estimate(right: Array, place: Array) -> list[float]:
    """Share of `right` [n] and its 95 % interval over attachments `place` [n] (score.interval)."""
    return [round(float(right.mean()), 4), *score.interval(right, place)]


def objects(labels: Array, place: Array, seed: int) -> Array:
    """Explorations of one object each, indices of sweeps [n, S] (paper, sec. V.D: sweeps of one
    material from the test set).

    Every sweep comes first once. Others of its material and attachment follow in random order, as
    many as the smallest group has.
    """
    rng = np.random.default_rng(seed)
    alike = np.unique(np.stack([labels, place]), axis=1, return_inverse=True)[1].ravel()
    least, rows = np.bincount(alike).min(), []
    for i in range(len(labels)):
        others = np.flatnonzero(alike == alike[i])
        rows.append([i, *rng.permutation(others[others != i])[: least - 1]])
    return np.array(rows)


def several(those: Sequence[Outcome]) -> dict[str, list[list[float]]]:
    """Accuracy after one, two and three sweeps of an object, by "vote" and by "product", the rules
    of the box."""
    estimates: dict[str, list[list[float]]] = {}
    for rule in ("vote", "product"):
        for n in range(1, SEVERAL + 1):
            right = np.concatenate([_fused(o, n, rule) for o in those])
            estimates.setdefault(rule, []).append(
                estimate(right, np.concatenate([o.place for o in those]))
            )
    return estimates


def _fused(outcome: Outcome, n: int, rule: str) -> Array:
    """bool [n], whether the first `n` sweeps of each exploration give the right material."""
    scores = softmax(outcome.logits)
    drawn = outcome.explorations[:, :n]
    named = []
    for row in drawn:
        evidence = Evidence.of(scores[row[0]], rule)
        for i in row[1:]:
            evidence = Evidence.of(scores[i], rule, evidence)
        named.append(evidence.probabilities.argmax())
    return np.asarray(np.array(named) == outcome.labels)


def explored(those: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Sweeps added until the posterior reaches SURE (Xu et al. 2013): estimate and mean number of
    sweeps."""
    from palpate_studies.peers import prior_work  # only here: scikit-learn

    points = []
    for sure in SURE:
        right, used = [], []
        for o in those:
            log_p = np.log(np.maximum(softmax(o.logits), LEAST_PROBABILITY))
            ends = [prior_work.explore(log_p[row], sure) for row in o.explorations]
            labels, counts = np.array(ends).T
            right.append(labels == o.labels)
            used.append(counts)
        share = estimate(np.concatenate(right), np.concatenate([o.place for o in those]))
        points.append(
            {"sure": sure, "share": share, "sweeps": round(float(np.concatenate(used).mean()), 3)}
        )
    return points
