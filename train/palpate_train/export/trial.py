"""Which rules of the answer pay: each is left out in turn while the box answers altered copies of
held-out sweeps, and junk made of them.

Held-out sweeps are clean, so they do not show what a rule is for. Copies are displaced, or have a
fault of CORRUPTIONS that applies to raw counts, in rising severity. Junk has no label that is
right. A rule pays if without it fewer copies are classified correctly, or more labels are wrong. A
rule that does not pay stays out while the others are tried, so that of two that do the same one is
kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.bundle.contents import Bundle
from palpate.core.clock import SystemClock
from palpate.core.types import Status, digitized
from palpate.inference.classifier import Classifier, EarlyExit
from palpate_train.answer.altered_sweeps import altered_copies
from palpate_train.answer.rules import RULES, Asked, present
from palpate_train.data.augment import Augmentation, augment
from palpate_train.data.corruptions import applicable
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.junk import JUNK, SLIDES_FIRST, windows
from palpate_train.data.sets import Dataset
from palpate_train.metrics import bundle_score, tolerances

Array = NDArray[Any]
EACH = 16
"""Sweeps of each kind. With fewer held-out sweeps no rule is tried, and all stay."""
MOVED = Augmentation(**dict.fromkeys(vars(Augmentation()), 0.0) | {"shift": 1.0, "displaced": 1.0})
"""Displaced by up to a row, as a skin that was put back."""


SLIDES, ALTERED, DISPLACED, NONE = "slides", "altered", "displaced", "junk"
"""Kinds of sweeps for the box; to junk no label is right."""


@dataclass(frozen=True)
class Given:
    """Sweeps for the box. kind: as above. lost: frames of each that never arrived."""

    sweeps: Dataset
    kind: str
    lost: int = 0


@dataclass(frozen=True)
class Counts:
    """Answers with status ok: the right ones, and the wrong ones, among them all to junk."""

    right: int = 0
    wrong: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.right + other.right, self.wrong + other.wrong)


def decided(
    judge: Bundle, held_out: Dataset, seed: int, asked: Asked
) -> tuple[list[str], dict[str, Any]]:
    """The rules to leave out, and the figures of all that were judged or asked for, by name.

    judge: a bundle with all rules, best fitted without `held_out`.
    """
    figures: dict[str, Any] = {
        name: {"kept": name in asked.kept, "because": "asked"}
        for name in RULES
        if name in asked.kept + asked.left_out
    }
    out = [name for name in asked.left_out if name in RULES]
    for name in out:
        judge = RULES[name].without(judge)
    tried = [name for name in present(judge) if RULES[name].tried and name not in asked.kept]
    if len(held_out) < EACH or len(np.unique(held_out.labels)) < 2 or not tried:
        return out, figures
    given = list(sweeps_for(held_out, judge, seed))
    n = sum(len(one.sweeps) for one in given if one.kind != NONE)
    now = _counted(judge, given)
    for name in tried:
        less = RULES[name].without(judge)
        then = _counted(less, given)
        kept = now.right - then.right >= tolerances.LOST * n or then.wrong > now.wrong
        figures[name] = {
            "kept": kept,
            "because": "tried",
            "of": n,
            "right": [now.right, then.right],
            "wrong": [now.wrong, then.wrong],
        }
        if not kept:
            out.append(name)
            judge, now = less, then
    return out, figures


def sweeps_for(held_out: Dataset, judge: Bundle, seed: int, each: int = EACH) -> Iterator[Given]:
    """`each` of the held-out sweeps, and as many altered copies and junk of each kind."""
    every, rng = EvaluationSweeps(held_out), np.random.default_rng(seed)
    yield Given(held_out.take(rng.permutation(len(held_out))[:each]), SLIDES)
    for corruption in applicable(every):
        source = rng.permutation(len(held_out))[:each]
        samples, severity = altered_copies(corruption, every, source, seed)
        altered = replace(held_out.take(source), samples=samples)
        if corruption.name != "lost":
            yield Given(altered, ALTERED)
            continue
        for share in np.unique(severity):
            lost = round(share * held_out.format.window)
            yield Given(altered.take(severity == share), ALTERED, lost)
    some = held_out.take(rng.permutation(len(held_out))[:each])
    yield Given(_displaced(some, judge.manifest.tare, rng), DISPLACED)
    yield from junk_for(held_out, judge, seed, each)


def junk_for(sweeps: Dataset, judge: Bundle, seed: int, each: int = EACH) -> Iterator[Given]:
    """At most `each` windows of each kind of junk, made of these sweeps."""
    for kind in JUNK:
        samples = windows(kind, sweeps, each, judge.manifest.tare, seed)
        some = sweeps.take(np.arange(len(samples)))
        yield Given(replace(some, samples=samples), NONE)


def _displaced(sweeps: Dataset, tare: Array, rng: Generator) -> Dataset:
    """The sweeps with loads and vibrations displaced along the rows. tare: raw counts of the
    unloaded skin, in the shape of a frame."""
    (n, frames, rows, cols), samples = sweeps.samples.shape[:4], sweeps.samples
    loads = (samples - tare).astype(np.float32).reshape(n, frames, -1).swapaxes(1, 2)
    moved = augment(loads, rows if cols > 1 else 1, MOVED, rng).swapaxes(1, 2)
    counts = digitized(moved.reshape(samples.shape) + tare, samples.dtype)
    return replace(sweeps, samples=counts)


def early_answers(bundle: Bundle, held_out: Dataset, seed: int, each: int = EACH) -> dict[str, Any]:
    """Figures of early answers, for fit_early.text: the mean share of the window that held-out
    sweeps need, and the labels of junk that is no slide from the beginning."""
    box = Classifier(bundle, SystemClock(), slides=False)
    early = EarlyExit(box)
    some = np.random.default_rng(seed).permutation(len(held_out))[: len(JUNK) * each]
    answers = bundle_score.verdicts(box, held_out.take(some), early=early)
    shares = [verdict.share for _, verdict in answers]
    named = list[bool]()
    for kind, junk in zip(JUNK, junk_for(held_out, bundle, seed, each), strict=True):
        if kind not in SLIDES_FIRST:
            answers = bundle_score.verdicts(box, junk.sweeps, early=early)
            named += [verdict.status is Status.OK for _, verdict in answers]
    return {"share": round(float(np.mean(shares)), 4), "junk": [sum(named), len(named)]}


def _counted(bundle: Bundle, given: list[Given]) -> Counts:
    return sum(counted(bundle, given).values(), Counts())


def counted(bundle: Bundle, given: Iterable[Given]) -> dict[str, Counts]:
    """The answers of the box with this bundle, by the kind of the sweeps."""
    box, found = Classifier(bundle, SystemClock(), slides=False), dict[str, Counts]()
    for one in given:
        became = bundle_score.outcomes_of(box, one.sweeps, lost=one.lost)
        right, wrong = int(became["right"].sum()), int(became["wrong"].sum())
        counts = Counts(0, right + wrong) if one.kind == NONE else Counts(right, wrong)
        found[one.kind] = found.get(one.kind, Counts()) + counts
    return found
