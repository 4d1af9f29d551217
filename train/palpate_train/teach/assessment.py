"""The knowledge of a box so far, judged by sweeps that the heads did not see.

Each part of the sweeps is left out in turn: places, sessions or objects if there are several of
them, else single sweeps. The candidates of the recipe are compared on the same parts, so accuracy
is slightly too high.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.statistics import wilson
from palpate.inference import advice
from palpate.inference.classifier import softmax
from palpate_train.data.splitters import InnerPart, recording_parts
from palpate_train.metrics.score import interval
from palpate_train.models.methods import Log, no_log
from palpate_train.models.recipe import recipe
from palpate_train.teach.lesson import Lesson

Array = NDArray[Any]


@dataclass(frozen=True)
class Suspect:
    """A sweep that may have a wrong label. sweep: the name of its file; number: among those of its
    material."""

    sweep: str
    number: int
    material: str
    looks_like: str

    @property
    def text(self) -> str:
        return advice.suspicion(self.number, self.material, self.looks_like)


@dataclass(frozen=True)
class Assessment:
    """Answers to left-out sweeps.

    named: float [N, K], the share of each sweep's judgements that name each material. left_out: the
    groups that were left out. low, high: 95 % interval of the accuracy.
    """

    lesson: Lesson
    named: Array
    left_out: tuple[str, ...]
    low: float
    high: float
    suspects: tuple[Suspect, ...]

    @property
    def right(self) -> Array:
        """float [N], the share of right judgements of each sweep."""
        shares: Array = self.named[np.arange(len(self.named)), self.lesson.sweeps.labels]
        return shares

    def confused(self) -> tuple[int, int] | None:
        """The two materials that are taken for each other most, None if nothing is confused."""
        counts = self._counts()
        counts += counts.T
        np.fill_diagonal(counts, 0)
        if not counts.any():
            return None
        first, second = divmod(int(counts.argmax()), len(counts))
        return min(first, second), max(first, second)

    def inseparable(self) -> tuple[int, int] | None:
        """The pair of `confused` if chance would name its sweeps as well."""
        if not (pair := self.confused()):
            return None
        counts = self._counts()[np.ix_(pair, pair)]
        right, total = float(np.trace(counts)), float(counts.sum())
        return pair if wilson(right, max(round(total), 1))[0] <= 0.5 else None

    def advice(self) -> str:
        """What to record next, or that it is enough."""
        materials, counts = self.lesson.sweeps.materials, np.bincount(self.lesson.sweeps.labels)
        suspicions = [one.text for one in self.suspects]
        pair = self.inseparable()
        if pair and not suspicions:
            one, other = (materials[k] for k in pair)
            return (
                f"{one} and {other} cannot be told apart so far; slide differently (faster, "
                "harder, longer), or teach them as one material"
            )
        if said := advice.first(suspicions, self.low):
            return said
        wrong = self._counts()
        np.fill_diagonal(wrong, 0)
        errors = wrong.sum(axis=0) + wrong.sum(axis=1)
        if errors.any():
            return advice.more(materials[int(errors.argmax())])
        fewest = materials[int(counts.argmin())]
        return (
            f"nothing was confused, but {len(self.named)} sweeps are few: {advice.MORE} more of "
            f"each, of {fewest} first"
        )

    def json(self) -> dict[str, Any]:
        """The assessment for pages and programs."""
        materials = self.lesson.sweeps.materials
        pair = self.confused()
        counts = self._counts()
        between = float(counts[pair] + counts[pair[::-1]]) if pair else 0.0
        return {
            "accuracy": round(float(self.right.mean()), 4),
            "low": self.low,
            "high": self.high,
            "sweeps": len(self.named),
            "materials": dict(
                zip(materials, np.bincount(self.lesson.sweeps.labels).tolist(), strict=True)
            ),
            "left_out": list(self.left_out),
            "confused": [*(materials[k] for k in pair), round(between, 1)] if pair else None,
            "no_slides": [asdict(one) for one in self.lesson.no_slides],
            "suspects": [asdict(one) | {"text": one.text} for one in self.suspects],
            "advice": self.advice(),
            "text": self.text(),
        }

    def text(self) -> str:
        """The accuracy in a sentence."""
        parts = " and ".join(f"{name}s" for name in self.left_out).replace("recording", "sweep")
        said = (
            f"{100 * self.right.mean():.0f} % of {len(self.named)} sweeps are named rightly if "
            f"their {parts} are left out [{100 * self.low:.0f}, {100 * self.high:.0f}]"
        )
        if pair := self.confused():
            one, other = (self.lesson.sweeps.materials[k] for k in pair)
            said += f"; most often confused: {one} and {other}"
        return said

    def _counts(self) -> Array:
        """float [K, K], rows by the material of the sweeps, columns by the answers."""
        counts = np.zeros((self.named.shape[1],) * 2)
        np.add.at(counts, self.lesson.sweeps.labels, self.named)
        return counts


def assess(lesson: Lesson, seed: int = 0, log: Log = no_log) -> Assessment:
    """Judge a model of the materials that have two sweeps or more. Raises FormatError if fewer than
    two materials have."""
    lesson = lesson.repeated()
    settings = recipe.Settings(steps=0, most=len(lesson.sweeps))
    setup = recipe.Setup.of(lesson.sweeps, seed, settings, log)
    fixed = setup.fixed
    choice = recipe.judge(recipe.candidates(fixed, setup), fixed, setup)
    parts, scores, chosen = setup.parts, choice.scores, choice.chosen
    if not np.any([part.out for part in parts], axis=0).all():
        # some materials are of one place: their sweeps are judged by others of that place
        parts = recording_parts(lesson.sweeps)
        scores = setup.scores(fixed.data, parts)
        chosen = scores.score(chosen.plan.parts)
    return judged(lesson, parts, softmax(chosen.logits[scores.own]))


def judged(lesson: Lesson, parts: Sequence[InnerPart], p: Array) -> Assessment:
    """The assessment by probabilities [n, K] of the sweeps of all parts, one part after another;
    each sweep is in one part or more."""
    shape, cluster = (len(lesson.sweeps), p.shape[1]), np.zeros(len(lesson.sweeps), int)
    numbers = np.concatenate([np.flatnonzero(part.out) for part in parts])
    named, chances = np.zeros(shape), np.zeros(shape)
    np.add.at(named, (numbers, p.argmax(axis=1)), 1)
    np.add.at(chances, numbers, p)
    times = np.bincount(numbers)[:, None]
    named, chances = named / times, chances / times
    for k, part in enumerate(parts):
        cluster[part.out] = k
    groups = tuple(sorted({part.group for part in parts}))
    right = named[np.arange(len(named)), lesson.sweeps.labels]
    low, high = interval(right, None if groups == ("recording",) else cluster)
    return Assessment(lesson, named, groups, low, high, _suspects(lesson, named, chances))


def _suspects(lesson: Lesson, named: Array, chances: Array) -> tuple[Suspect, ...]:
    """Sweeps that are surely of another material, whose other sweeps are named rightly, as are the
    others of their own."""
    labels, materials = lesson.sweeps.labels, lesson.sweeps.materials
    right = named[np.arange(len(labels)), labels]
    found = []
    for i in np.flatnonzero(
        (chances.argmax(axis=1) != labels) & (chances.max(axis=1) >= advice.SURE)
    ):
        other = int(chances[i].argmax())
        beside = (labels == labels[i]) & (np.arange(len(labels)) != i)
        of_other = labels == other
        if beside.any() and min(right[beside].mean(), right[of_other].mean()) >= advice.RIGHT:
            label = materials[labels[i]]
            found.append(Suspect(lesson.names[i], lesson.number(i), label, materials[other]))
    return tuple(found)
