"""Whether the mean level of the taxels shows the material, and whether it still does under a
condition that the model has not seen.

In most tactile sets each material was recorded in one go. Its level then shows the session as well
as the material, and a random split overestimates accuracy. This check fits linear discriminants to
the mean raw count of each taxel alone, and tests them twice on the same sweeps: fitted to other
recordings of the same value of a group (a session, a position, a force), and fitted to other
values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.answer.heads import fit_discriminant
from palpate_train.data.sets import Dataset, evenly
from palpate_train.data.splitters import InnerPart, Protocol, draw, inner_parts
from palpate_train.evaluate.trivial import scaled
from palpate_train.metrics.score import interval

Array = NDArray[Any]
MOST_SWEEPS = 2000
MOST_TAXELS = 255
"""Largest number of means of a sweep that are used, all axes counted."""
MOST_VALUES = 20
"""Largest number of values of a group within which discriminants are fitted."""
FOLDS = 3
UNTESTED = -1
LEFT_OUT = "also where"
"""Words of the warning about a level that shows materials across values; one such line suffices."""


def warnings_of(sweeps: Dataset) -> list[str]:
    """A warning for each group within whose values the mean level shows materials far above chance,
    and across whose values it loses most of that, and one if it shows them far above chance across
    values too. If no group can be left out, a warning if the level shows materials far above
    chance.

    Sets that are too small for this check have no warning.
    """
    try:
        levels = levels_of(sweeps.require_materials().require_pure_recordings())
        parts = inner_parts(levels)
    except FormatError:
        return []
    names = dict.fromkeys(part.group for part in parts)
    if "recording" in names:  # no group can be left out
        return _alone(levels)
    lines = [
        line
        for name in names
        for line in _compared(levels, name, [part for part in parts if part.group == name])
    ]
    across = [line for line in lines if LEFT_OUT in line]
    return [line for line in lines if line not in across] or across[:1]


def levels_of(sweeps: Dataset) -> Dataset:
    """The mean raw count of each taxel as the only frame, scaled to a mean of 0 and a deviation of
    1 over all sweeps: samples float32 [n, 1, F, 1].

    Of more than MOST_SWEEPS sweeps about as many are drawn, of each material alike; of more than
    MOST_TAXELS means as many, evenly. Taxels whose mean never changes are left out.
    """
    drawn = np.arange(len(sweeps))
    if len(drawn) > MOST_SWEEPS:
        each = max(MOST_SWEEPS // len(np.unique(sweeps.labels)), 1)
        drawn = draw(drawn, sweeps.labels, each, 0)
    # sweep by sweep: a copy of all of them might not fit into memory
    means = np.stack([sweeps.samples[i].mean(axis=0, dtype=np.float64).ravel() for i in drawn])
    means = means[:, np.ptp(means, axis=0) > 0]
    levels = scaled(means[:, evenly(means.shape[1], MOST_TAXELS)])
    return replace(
        sweeps,
        samples=levels.astype(np.float32)[:, None, :, None],
        labels=sweeps.labels[drawn],
        groups={name: numbers[drawn] for name, numbers in sweeps.groups.items()},
        unloaded=None,
    )


def _alone(levels: Dataset) -> list[str]:
    """A warning if the level shows materials in a set in which no group can be left out."""
    whole = np.zeros(len(levels), int)
    answers, _ = _within(levels, whole)
    tested = answers != UNTESTED
    if not tested.any():
        return []
    right, chance = (
        (answers == levels.labels)[tested],
        _chance(levels.labels[tested], whole[tested]),
    )
    low, _ = interval(right, _clusters(levels, tested))
    if low <= _middle(chance, 1):
        return []
    groups = (numbers for name, numbers in levels.groups.items() if name != "recording")
    varied = any(len(np.unique(numbers)) > 1 for numbers in groups)
    where = "no group can be left out" if varied else "recorded in one session"
    return [
        f"warning: {where}: the level is not used by the default recipe; alone it names "
        f"{_percent(right.mean())} of the sweeps ({right.sum()} of {len(right)}, chance "
        f"{_percent(chance)})"
    ]


def _compared(levels: Dataset, name: str, parts: Sequence[InnerPart]) -> list[str]:
    """A warning if the level shows materials within values of the group `name`, and loses most of
    that across them. Answers are limited to the materials that occur in the value of a sweep, so
    that chance is the same for both."""
    values = levels.group(name)
    within, possible = _within(levels, values)
    across = np.full(len(levels), UNTESTED)
    for part in parts:
        across[part.out] = _answers(levels, ~part.out, part.out, possible)
    tested = (within != UNTESTED) & (across != UNTESTED)
    if not tested.any():
        return []
    inside, outside = ((found == levels.labels)[tested] for found in (within, across))
    chance = _chance(levels.labels[tested], values[tested])
    low, _ = interval(inside, clusters := _clusters(levels, tested))
    least, high = interval(outside, clusters)
    if least > _middle(chance, 1):
        return [
            f"warning: the mean of each taxel alone names {outside.sum()} of {len(outside)} sweeps "
            f"(chance {_percent(chance)}), {LEFT_OUT} their {name} is left out; if each material "
            "was recorded in one go, this may be the level of that day"
        ]
    if low <= _middle(chance, 1) or high >= _middle(chance, low):
        return []
    several = name if name.endswith("s") else f"{name}s"
    return [
        f"warning: the mean level alone names {_percent(inside.mean())} of the sweeps within one "
        f"{name} and {_percent(outside.mean())} across {several} (chance {_percent(chance)}): "
        f"a level that the {name} sets more than the material; "
        f"leave {several} out when you evaluate (--protocol leave:{name})"
    ]


def _within(levels: Dataset, values: Array) -> tuple[Array, Array]:
    """The answers [N] to sweeps after a fit to other recordings of the same value, or UNTESTED; and
    the materials that such an answer may give, bool [N, K]. values: int [N].

    A material with one recording in a value is left out there, because it cannot be on both sides.
    """
    answers = np.full(len(levels), UNTESTED)
    possible = np.zeros((len(levels), len(levels.materials)), bool)
    present, recording = np.unique(values), levels.group("recording")
    for value in present[evenly(len(present), MOST_VALUES)]:
        mine = np.flatnonzero(values == value)
        pairs = np.unique(np.stack([levels.labels[mine], recording[mine]]), axis=1)
        counts = np.bincount(pairs[0], minlength=len(levels.materials))
        if (counts > 1).sum() < 2:
            continue
        mine = mine[counts[levels.labels[mine]] > 1]
        possible[mine] = counts > 1
        folds = min(FOLDS, int(counts[counts > 1].min()))
        for train, test in Protocol(f"random:{folds}").folds(levels.take(mine), 1):
            answers[mine[test]] = _answers(levels, mine[train], mine[test], possible)
    return answers, possible


def _answers(levels: Dataset, train: Array, test: Array, possible: Array) -> Array:
    """The answers to the sweeps `test` of a discriminant fitted to the sweeps `train` (masks or
    numbers); UNTESTED if these are too few, or for a sweep without a possible material."""
    x, allowed = levels.samples[:, 0, :, 0], possible[test]
    try:
        weight, bias = fit_discriminant(x[train], levels.labels[train], len(levels.materials))
    except FormatError:
        return np.full(len(allowed), UNTESTED)
    logits = np.where(allowed, x[test] @ weight.T + bias, -np.inf)
    return np.where(allowed.any(axis=1), logits.argmax(axis=1), UNTESTED)


def _chance(labels: Array, values: Array) -> float:
    """The accuracy of a model that always gives the most frequent material of the value. labels,
    values: int [n]."""
    most = [np.bincount(labels[values == value]).max() for value in np.unique(values)]
    return float(sum(most) / len(labels))


def _clusters(levels: Dataset, tested: Array) -> Array | None:
    """The recordings of the tested sweeps, for intervals; None if each sweep is its own."""
    recording = levels.group("recording")[tested]
    return recording if len(np.unique(recording)) < len(recording) else None


def _middle(low: float, high: float) -> float:
    """The middle of two accuracies. An accuracy is far above chance if its 95 % interval begins
    above the middle of chance and 1: at six materials above 58 %, at two above 75 %. The interval
    across values has to end below the middle of chance and the lower end within a value: then most
    of the accuracy within a value is due to the group."""
    return low + 0.5 * (high - low)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
