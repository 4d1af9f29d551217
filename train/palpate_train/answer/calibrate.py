"""The calibration of a fit: everything that is fitted to the features of a finished trunk.

It consists of the head that gives the label and its temperature, a head for each early answer
and the rule for these, the embedding and the limit of known materials, and the rule for displaced
contacts. Temperatures, limits and rules are fitted to held-out sweeps, by heads that did not see
the condition under which these were taken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.answer.contact import DisplacementRule
from palpate.answer.early import Early
from palpate.answer.objects import softmax
from palpate.answer.unknown import Classes, shaped_distances
from palpate.core.status import LEAST_PROBABILITY, UNSURE
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.answer import fit_contact, fit_early
from palpate_train.answer.embedding import (
    NOTHING,
    Embedding,
    JudgingPart,
    cross_fitted,
    embed,
    in_two_views,
    parts,
    shapes_without,
)
from palpate_train.answer.fit_contact import AugmentedCopies, DisplacementFit
from palpate_train.answer.fit_early import EarlyRule, Heads
from palpate_train.answer.heads import HeadData, HeadPart, HeadPlan, condition_values
from palpate_train.answer.stranger_limits import (
    LeftOut,
    StrangerLimits,
    answered,
    limits,
    nearest_other,
)
from palpate_train.metrics.score import UNKNOWN, Answers, fuse
from palpate_train.metrics.temperature import sufficient_temperature

Array = NDArray[Any]
Json = dict[str, Any]
Shapes = tuple[Array, Callable[[int], Array]]
"""Shapes [K, r, r] of an embedding's materials, and a function that gives those [K - 1, r, r]
without a material."""
View = Callable[[Array, Embedding, Array], Shapes]
"""The sweeps that an embedding was fitted to (bool [N]), the embedding, the labels [K] of its means
-> its shapes."""
Part = TypeVar("Part", Embedding, Heads, "HeldOut")
NUMBERS = ("temperature", "class_mean_temperature")
"""Attributes of a Calibration that are numbers."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Answers to the held-out sweeps, by heads and embedding that were fitted without the sweep's
    value of one condition.

    numbers: of the sweeps [n]. probabilities: [n, K], of the network. known: bool [n], whether the
    distance is within the limit.
    """

    numbers: Array
    probabilities: Array
    known: Array

    def answers(self, recordings: Array) -> Answers:
        """The answers of the box. recordings: int [n], the recording of each sweep; its known
        sweeps are fused."""
        labels = self.probabilities.argmax(1)
        known = np.flatnonzero(self.known)
        fused = np.full(len(labels), UNKNOWN)
        if len(known):
            logs = np.log(np.maximum(self.probabilities, LEAST_PROBABILITY))
            scores, first = fuse(logs[known], recordings[known])
            decided = np.where(softmax(scores).max(1) >= UNSURE, scores.argmax(1), UNKNOWN)
            by_recording = dict(zip(recordings[known][first], decided, strict=True))
            fused = np.array([by_recording.get(number, UNKNOWN) for number in recordings])
        ok = self.probabilities.max(1) >= UNSURE
        return Answers(np.where(self.known, labels, UNKNOWN), ok, fused, labels)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The calibration of a trunk.

    weight [F, K], bias [K]: the head that gives the label, divided by `temperature`.
    class_mean_temperature: of logits that the box computes from class means. steps: heads of the
    early answers, with their temperatures. limits: of known materials. displacement: for displaced
    contacts; None without copies. held: for each condition, the hardest first.
    """

    embedding: Embedding
    weight: Array
    bias: Array
    temperature: float
    class_mean_temperature: float
    steps: Heads
    rule: EarlyRule
    limits: StrangerLimits
    displacement: DisplacementFit | None
    held: Mapping[str, HeldOut]

    def logits(self, features: Array) -> Array:
        """Features [..., F] of whole sweeps -> logits [..., K] whose softmax is calibrated."""
        logits: Array = np.asarray(features, np.float64) @ self.weight + self.bias
        return logits

    def probabilities(self, prefixes: Array) -> Array:
        """Features [n, D + 1, F] of prefixes of the window -> probabilities [n, D + 1, K] after
        each of them."""
        steps = self.steps.logits(self.embedding(prefixes))
        return softmax(np.concatenate([steps, self.logits(prefixes[:, -1])[:, None]], axis=1))

    def classes(self) -> Classes:
        """The means and shapes of the materials, and of displaced contacts, as a bundle holds
        them."""
        classes = self.embedding.classes()
        return self.displacement.classes(classes) if self.displacement else classes

    def arrays(self) -> dict[str, Array]:
        """The arrays that the file of a fit keeps."""
        parts: Json = {"embedding": self.embedding, "steps": self.steps}
        parts |= {f"held {name}": held for name, held in self.held.items()}
        parts |= {"displaced": self.displacement.embedding} if self.displacement else {}
        arrays = {
            f"{of}.{k.name}": getattr(v, k.name) for of, v in parts.items() for k in fields(v)
        }
        return arrays | {"weight": self.weight, "bias": self.bias}

    def figures(self) -> Json:
        """The rules and temperatures that the file of a fit keeps, for JSON."""
        return {name: getattr(self, name) for name in NUMBERS} | {
            "rule": asdict(self.rule),
            "limits": asdict(self.limits),
            "conditions": list(self.held),
            "displacement": asdict(self.displacement.rule) if self.displacement else None,
        }

    @classmethod
    def of(cls, arrays: Mapping[str, Array], figures: Json) -> Calibration:
        """The calibration that gave `arrays` and `figures`. Raises KeyError or TypeError if they
        are not of a calibration."""

        def part(kind: type[Part], name: str) -> Part:
            return kind(**{k.name: arrays[f"{name}.{k.name}"] for k in fields(kind)})

        early, displaced = figures["rule"]["early"], figures["displacement"]
        early = early and Early(tuple(early["least"]), early["agree"])
        return cls(
            part(Embedding, "embedding"),
            arrays["weight"],
            arrays["bias"],
            steps=part(Heads, "steps"),
            rule=EarlyRule(**figures["rule"] | {"early": early}),
            limits=StrangerLimits(**figures["limits"]),
            displacement=displaced
            and DisplacementFit(part(Embedding, "displaced"), DisplacementRule(**displaced)),
            held={name: part(HeldOut, f"held {name}") for name in figures["conditions"]},
            **{name: figures[name] for name in NUMBERS},
        )


@dataclass(frozen=True, eq=False)
class CalibrationInputs:
    """Features that a calibration is fitted to.

    prefixes: [N, D + 1, F], features of the first tenth of the window, the first two tenths, and so
    on to the whole window. labels: [N], 0 to K - 1. conditions: int [N] by name, the hardest first;
    a sweep is judged without its value of each; see `_deciding` for temperatures and rules.
    held: bool [N], the sweeps of some values of the hardest, which trained stages did not see.
    staged: whether there are such stages; if not, all sweeps judge. fixed: number of features, the
    last ones, that were not trained (see `embed`). If there are any, most of a distance lies
    in them; then all sweeps decide the limit, because more positions make it depend less on chance.
    copied: augmented copies. faulty: bool [N], copies with FAULTS; the embedding and its limit see
    them, the heads do not. junk: features [m, F] of windows of each kind of junk, where sweeps are
    too few to show where other things lie. plan: of the head that gives the label; None for one
    discriminant of all features. weights: [N], how much each sweep counts for that head; None if
    all count alike, as they do for the embedding. recordings: int [N], numbered without a gap in
    each material; None if they are unknown.
    """

    prefixes: Array
    labels: Array
    conditions: Mapping[str, Array]
    held: Array
    staged: bool
    fixed: int
    copied: AugmentedCopies
    faulty: Array
    plan: HeadPlan | None = None
    weights: Array | None = None
    recordings: Array | None = None
    junk: Mapping[str, Array] = field(default_factory=dict)

    @property
    def groups(self) -> Array:
        """int [N], the values of the hardest condition."""
        return next(iter(self.conditions.values()))

    @cached_property
    def _judges(self) -> dict[bytes, list[JudgingPart]]:
        return {}

    def cross_fitted(self, values: Array, judged: Array) -> list[JudgingPart]:
        """See embedding.cross_fitted; computed once for the same values and sweeps."""
        key = values.tobytes() + judged.tobytes()
        if key not in self._judges:
            given = self.whole, self.labels, values, judged, self.fixed, self.beyond
            self._judges[key] = list(cross_fitted(*given))
        return self._judges[key]

    @property
    def judged(self) -> Array:
        """bool [N], the sweeps that judge."""
        judged: Array = self.held if self.staged else ~self.faulty
        return judged

    @property
    def whole(self) -> Array:
        """Features [N, F] of the whole window."""
        return self.prefixes[:, -1]

    @property
    def beyond(self) -> Array:
        """Mean features [J, F] of every second window of each kind of junk that was made."""
        made = [of[::2].mean(axis=0) for kind, of in self.junk.items() if kind != NOT_THIS]
        return np.stack(made) if made else NOTHING

    @cached_property
    def head_data(self) -> HeadData:
        """All sweeps, and the copies that heads are fitted to."""
        copied = self.copied.take(~self.copied.held)
        values = condition_values(self.conditions, len(self.labels))
        return HeadData(
            self.whole, self.labels, lambda: copied.features, copied.source, values, self.weights
        )

    def naming_head(self, seen: Array) -> tuple[Array, Array]:
        """Weight [F, K] and bias [K] of the head that gives the label, fitted to the sweeps
        `seen` (bool [N]) and their copies."""
        plan = self.plan or HeadPlan((HeadPart(tuple(range(self.whole.shape[1])), copies=True),))
        known = self.head_data.take(seen & ~self.faulty)
        weight, bias = plan.fit(known, int(self.labels.max()) + 1)
        return weight.T, bias


def fit_novelty(
    given: CalibrationInputs,
) -> tuple[Embedding, dict[str, LeftOut], StrangerLimits]:
    """The embedding, the distances of left-out sweeps and materials by condition, and the limits of
    a calibration. Raises FormatError as `embed`, and if there is only one group or no sweep to
    judge by."""
    embedding = in_two_views(given.whole, given.labels, given.fixed, given.beyond)
    distances = left_out_in_turn(given, embedding)
    return embedding, distances, limits(distances, junk=junk_distances(given, embedding))


def fit_calibration(given: CalibrationInputs) -> Calibration:
    """The calibration that is fitted to these features. Raises FormatError as `embed`, and if there
    is only one group or no sweep to judge by."""
    labels = given.labels
    named = {name: _named(given, values) for name, values in given.conditions.items()}
    values, *judged = _deciding(given, named)
    logits, numbers, class_mean_temperature = _prefix_logits(given, values, *judged)
    groups = values[numbers]
    temperatures = fit_early.fit_temperatures(logits, labels[numbers], groups)
    p = softmax(logits / temperatures[:, None])
    embedding, distances, beyond = fit_novelty(given)
    last = float(temperatures[-1])
    steps = fit_early.heads(embedding(given.prefixes), labels, int(labels.max()) + 1)
    held = {}
    for name, (judging, answers) in named.items():
        known = distances[name].corrected()[0][judging] <= np.log(beyond.balanced)
        held[name] = HeldOut(judging, softmax(answers / last), known)
    weight, bias = given.naming_head(np.ones(len(labels), bool))
    return Calibration(
        embedding,
        weight / last,
        bias / last,
        last,
        class_mean_temperature,
        steps.cooled(temperatures[:-1]),
        fit_early.find_rule(p, labels[numbers]),
        beyond,
        _displacement(given, last, answered(beyond.figures)),
        held,
    )


def left_out(
    given: CalibrationInputs, values: Array, judged: Array, finished: Embedding, view: View
) -> LeftOut:
    """Distances of the sweeps `judged` (bool [N]) by embeddings that did not see their value of a
    condition (int [N]). finished: the embedding of all sweeps."""
    x, labels = given.whole, given.labels
    known, strangers, of_finished = (np.full(len(labels), np.nan) for _ in range(3))
    parts = 0
    for seen, numbers, embedding, present in given.cross_fitted(values, judged):
        shapes, without = view(seen, embedding, present)
        z, means = embedding(x[numbers]), embedding.means.astype(np.float64)
        known[numbers] = shaped_distances(z[:, None] - means, shapes).min(axis=1)
        own = np.searchsorted(present, labels[numbers])
        strangers[numbers] = nearest_other(z, own, means, without)
        parts += 1
    z, means = finished(x[judged]), finished.means.astype(np.float64)
    shapes, without = view(np.ones(len(labels), bool), finished, np.arange(len(means)))
    of_finished[judged] = nearest_other(z, labels[judged], means, without)
    learned = np.full(len(labels), np.nan)
    learned[judged] = shaped_distances(z[:, None] - means, shapes).min(axis=1)
    return LeftOut(known, strangers, of_finished, learned, labels, values, parts)


def left_out_in_turn(given: CalibrationInputs, finished: Embedding) -> dict[str, LeftOut]:
    """`left_out` for each condition, with the shapes of the embeddings themselves."""
    judged = (given.judged | (given.fixed > 0)) & ~given.faulty

    def view(seen: Array, embedding: Embedding, present: Array) -> Shapes:
        some = seen & np.isin(given.labels, present)
        own = np.searchsorted(present, given.labels[some])
        without = shapes_without(embedding, embedding(given.whole[some]), own)
        return embedding.shapes.astype(np.float64), without

    return {
        name: left_out(given, values, judged, finished, view)
        for name, values in given.conditions.items()
    }


def junk_distances(given: CalibrationInputs, finished: Embedding) -> dict[str, Array]:
    """Distances of the junk that `beyond` does not show, by kind, to the nearest mean of the
    finished model. Sweeps of NOT_THIS are few: all of them count."""
    return {
        kind: finished.novelty(features if kind == NOT_THIS else features[1::2])
        for kind, features in given.junk.items()
    }


def _named(given: CalibrationInputs, values: Array) -> tuple[Array, Array]:
    """The numbers [n] of the judged sweeps, and logits [n, K] by heads that did not see their value
    of one condition, at temperature 1. Sweeps of a material that occurs in no other part are left
    out."""
    numbers, logits = [], []
    for seen, judging in parts(values, given.judged):
        judging = judging[np.isin(given.labels[judging], given.labels[seen & ~given.faulty])]
        weight, bias = given.naming_head(seen)
        logits.append(given.whole[judging] @ weight + bias)
        numbers.append(judging)
    return np.concatenate(numbers), np.concatenate(logits)


def _deciding(
    given: CalibrationInputs, named: Mapping[str, tuple[Array, Array]]
) -> tuple[Array, Array, Array]:
    """The values [N] of the condition that decides temperatures and rules, and what `_named` gives
    of it. It is the hardest condition under which the labels of at least the share UNSURE are
    right; recordings, if there is none. Where most labels are wrong no answer would be sure, not
    even under values that training has.
    """
    for name, (judging, logits) in named.items():
        if np.mean(logits.argmax(axis=1) == given.labels[judging]) >= UNSURE:
            return given.conditions[name], judging, logits
    values = given.groups if given.recordings is None else given.recordings
    return values, *_named(given, values)


def _prefix_logits(
    given: CalibrationInputs, groups: Array, judging: Array, named: Array
) -> tuple[Array, Array, float]:
    """Logits [n, D + 1, K] of the judged sweeps and their prefixes by heads that did not see their
    value of a condition `groups` [N], at temperature 1; the numbers [n] of these sweeps; the
    temperature of logits from class means. judging, named: of `_named` for this condition."""
    labels = given.labels
    parts = given.cross_fitted(groups, given.judged)
    logits, numbers = fit_early.cross_fitted_logits(given.prefixes, labels, parts)
    temperature = sufficient_temperature(logits[:, -1], labels[numbers], groups[numbers])
    row_of = {number: row for row, number in enumerate(numbers)}
    for number, answers in zip(judging, named, strict=True):
        if number in row_of:
            logits[row_of[number], -1] = answers
    return logits, numbers, temperature


def _displacement(
    given: CalibrationInputs, temperature: float, kept: float
) -> DisplacementFit | None:
    """The rule for displaced contacts, by a head that did not see the groups of held sweeps. kept:
    share of known copies within its limit."""
    copied = given.copied
    if not copied.held.any():
        return None
    embedded = partial(embed, fixed=given.fixed, beyond=given.beyond)
    weight, bias = given.naming_head(~np.isin(given.groups, given.groups[given.held]))
    logits = (copied.features[copied.held] @ weight + bias) / temperature
    return fit_contact.fit(
        given.whole, given.labels, given.groups, given.held, embedded, copied, logits, kept
    )
