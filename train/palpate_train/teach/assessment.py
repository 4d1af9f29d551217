"""The knowledge of a box so far, judged by sweeps that the heads did not see.

Each part of the sweeps is left out in turn: places, sessions or objects if there are several of
them, else single sweeps. The candidates of the recipe are compared on the same parts, so accuracy
is slightly too high. A bundle of all sweeps answers junk that is made of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from palpate.answer.objects import softmax
from palpate.bundle import bundle
from palpate.core.errors import ApplianceError
from palpate.core.sweep_set import Array
from palpate.learn.assessment import CURVE, Assessment, LearningCurve
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.answer import stranger_limits
from palpate_train.answer.heads import HeadData, HeadPart
from palpate_train.data.run import Run
from palpate_train.data.splitters import InnerPart, recording_parts
from palpate_train.export import quantized_bundle, trial
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import Fit
from palpate_train.teach.lesson import Lesson
from palpate_train.teach.taught import NAME

DRAWS, LEAST = 3, 2
"""Draws of sweeps that are left out to see what they have brought, and the fewest sweeps of a
material that remain."""


def assess(lesson: Lesson) -> Assessment:
    """Judge a model of the materials that have two sweeps or more. Raises FormatError if fewer than
    two materials have."""
    lesson = lesson.repeated()
    settings = recipe.Settings(most=len(lesson.sweeps), displaced=False, strangers=lesson.strangers)
    setup = recipe.Setup.of(lesson.sweeps, Run(0), settings)
    fixed = setup.fixed
    choice = recipe.judge(recipe.candidates(fixed, setup), fixed, setup)
    parts, scores, chosen = setup.parts, choice.scores, choice.chosen
    if not np.any([part.out for part in parts], axis=0).all():
        # some materials are of one place: their sweeps are judged by others of that place
        parts = recording_parts(lesson.sweeps)
        scores = setup.scores(fixed.data, parts)
        chosen = scores.score(chosen.plan.parts)
    found = judged(lesson, parts, softmax(chosen.logits[scores.own]))
    found = replace(found, curve=curve(found, setup, fixed.data, parts, chosen.plan.parts))
    with suppress(ApplianceError):  # too few sweeps for a bundle
        found = replace(found, others=others(recipe.finish(None, choice, setup)))
    return found


def curve(
    found: Assessment,
    setup: recipe.Setup,
    data: HeadData,
    parts: Sequence[InnerPart],
    heads: Sequence[HeadPart],
) -> LearningCurve | None:
    """What the last sweeps of the worst material have brought: some are left out, DRAWS times, and
    the material's other sweeps judge."""
    if (worst := found.worst()) is None:
        return None
    own = np.flatnonzero(found.labels == worst)
    if len(own) < 2 * LEAST:
        return None
    fewer, rng = min(CURVE, len(own) // 2), np.random.default_rng(0)
    before, now = [], []
    for _ in range(DRAWS):
        kept = ~np.isin(np.arange(len(data.labels)), rng.choice(own, fewer, replace=False))
        left = [InnerPart(one.group, one.out[kept]) for one in parts if one.out[kept].any()]
        scores = setup.scores(data.take(kept), left)
        right = scores.right(scores.score(heads))[scores.own & (scores.labels == worst)]
        before.append(float(right.mean()))
        now.append(float(found.right[kept & (found.labels == worst)].mean()))
    name = found.materials[worst]
    return LearningCurve(name, len(own), fewer, float(np.mean(before)), float(np.mean(now)))


def others(fit: Fit) -> dict[str, tuple[float, int]]:
    """For things that were not taught, in words, the share to which the box would give a label, and
    their number. Raises FormatError or ExportRefused if the sweeps do not suffice for a bundle."""
    told = dict[str, tuple[float, int]]()
    with TemporaryDirectory() as folder:
        out = Path(folder) / NAME
        manifest = quantized_bundle.export(fit, out, NAME, "1", "", proven=False)
        made = bundle.load(out)
        given = list(trial.junk_for(fit.train, made, fit.about["seed"]))
        n = sum(len(one.sweeps) for one in given)
        wrong = sum(found.wrong for found in trial.counted(made, given).values())
        told["windows without a slide over one material"] = wrong / n, n
        found = manifest.figures.get(stranger_limits.FIGURES, {})
        if named := found.get("balanced", {}).get("named"):
            told["sweeps of materials that were left out"] = named[0], found["strangers"]
        if own := found.get(NOT_THIS):
            told[f"sweeps of {NOT_THIS!r}"] = found["balanced"][NOT_THIS], own
    return told


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
    return Assessment(
        lesson.sweeps.materials,
        lesson.sweeps.labels,
        lesson.names,
        named,
        chances,
        groups,
        None if groups == ("recording",) else cluster,
        lesson.no_slides,
        unchecked=lesson.unchecked,
    )
