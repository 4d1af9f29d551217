"""Evaluation protocols: a text such as "leave:position" says which sweeps train and which test.

A protocol never puts parts of one recording on both sides. Nothing here imports scikit-learn,
because a box that is taught does not have it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from math import isclose
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data.group_values import text_of
from palpate_train.data.sets import Dataset

Array = NDArray[Any]
Fold = tuple[Array, Array]
FORMS = "random:FOLDS, leave:GROUP or split:GROUP=a,b->c"
RANDOM = re.compile(r"random:(\d+)")
LEAVE = re.compile(r"leave:(\w+)")
SPLIT = re.compile(r"split:(\w+)=(.+?)->(.+)")


def _random_folds(sweeps: Dataset, folds: int, seed: int) -> Iterator[Fold]:
    """Whole recordings divided into `folds` parts at random, materials in equal shares: the paper's
    protocol, which overestimates accuracy.

    Raises FormatError if a material has fewer recordings than there are folds.
    """
    recordings, labels = sweeps.group("recording"), sweeps.labels
    for label in np.unique(labels):
        if (n := len(np.unique(recordings[labels == label]))) < 2:
            raise FormatError(
                f"material {sweeps.materials[label]!r} has one recording; "
                "record two of each or more, to test on one"
            )
        if n < folds:
            raise FormatError(
                f"random:{folds} needs {folds} recordings of each material; "
                f"{sweeps.materials[label]!r} has {n}: use random:{n} or less"
            )
    fold = _spread_evenly(labels, recordings, folds, seed)
    for k in range(folds):
        yield np.flatnonzero(fold != k), np.flatnonzero(fold == k)


def _spread_evenly(labels: Array, groups: Array, folds: int, seed: int) -> Array:
    """The fold [N] of each sweep: whole groups, with the materials in equal shares.

    Groups are dealt out in random order, of the most unequal materials first. Each goes where
    the shares of the materials then differ least between folds, and of equal folds to the smallest.
    The folds are the same as of scikit-learn's StratifiedGroupKFold with shuffling.
    """
    kinds, label = np.unique(labels, return_inverse=True)
    values, member = np.unique(groups, return_inverse=True)
    counts = np.zeros((len(values), len(kinds)))
    np.add.at(counts, (member, label), 1)
    order = np.arange(len(values))
    np.random.RandomState(seed).shuffle(order)
    order = order[np.argsort(-counts[order].std(axis=1), kind="stable")]
    totals, held, fold = (
        counts.sum(axis=0),
        np.zeros((folds, len(kinds))),
        np.empty(len(values), int),
    )
    into = np.eye(folds)[:, :, None]
    for group in order:
        best, least, size = 0, np.inf, np.inf
        tried = held + into * counts[group]  # [fold of the group, folds, K]
        sizes = held.sum(axis=1).tolist()
        for k, unequal in enumerate((tried / totals).std(axis=1).mean(axis=1).tolist()):
            smaller = isclose(unequal, least, rel_tol=1e-5, abs_tol=1e-8) and sizes[k] < size
            if unequal < least or smaller:
                best, least, size = k, unequal, sizes[k]
        held[best] += counts[group]
        fold[group] = best
    dealt: Array = fold[member]
    return dealt


def _leave_one_out(sweeps: Dataset, name: str) -> Iterator[Fold]:
    """Test on one value of the group `name` at a time and train on all others. Raises FormatError
    if the group has only one value or cuts a recording in two."""
    group = sweeps.group(name)
    if len(values := np.unique(group)) < 2:
        raise FormatError(
            f"leave:{name} needs two values of the group {name!r}; "
            f"all sweeps have {text_of(group[0])}: choose another group"
        )
    for value in values:
        out = group == value
        yield _checked(f"leave:{name}, {text_of(value)} left out", ~out, out, sweeps)


def _train_test(sweeps: Dataset, name: str, train: list[Any], test: list[Any]) -> Fold:
    """Train on some values of the group `name` and test on others, such as T-REAL and T-HARD.
    Raises FormatError if a value is unknown or on both sides."""
    group = sweeps.group(name)
    present = np.unique(group)
    for value in (*train, *test):
        if value not in present:
            raise FormatError(
                f"group {name!r} has no {text_of(value)}; "
                f"it has {', '.join(map(text_of, present[:20]))}"
            )
    if both := set(train) & set(test):
        raise FormatError(
            f"{name}={text_of(min(both))} is on both sides of the split; name it once"
        )
    return _checked(f"split:{name}", np.isin(group, train), np.isin(group, test), sweeps)


@dataclass(frozen=True)
class Protocol:
    """A protocol by its text. Raises FormatError if the text matches none of FORMS."""

    text: str

    def __post_init__(self) -> None:
        if not any(form.fullmatch(self.text) for form in (RANDOM, LEAVE, SPLIT)):
            raise FormatError(f"protocol {self.text!r} cannot be read; use {FORMS}")
        if (found := RANDOM.fullmatch(self.text)) and int(found[1]) < 2:
            raise FormatError(f"protocol {self.text!r} has too few folds; use random:2 or more")

    def folds(self, sweeps: Dataset, seed: int) -> list[Fold]:
        """All pairs (training, test) of sweep numbers. seed: for random folds. Raises FormatError
        if the protocol cannot split `sweeps`."""
        sweeps.require_materials().require_pure_recordings()
        if found := RANDOM.fullmatch(self.text):
            return list(_random_folds(sweeps, int(found[1]), seed))
        if found := LEAVE.fullmatch(self.text):
            return list(_leave_one_out(sweeps, found[1]))
        found = SPLIT.fullmatch(self.text)
        assert found
        name, *sides = found.groups()
        try:
            train, test = (sweeps.listed(name, side) for side in sides)
        except FormatError as e:
            raise FormatError(f"protocol {self.text!r} cannot be read; {e}") from None
        return [_train_test(sweeps, name, train, test)]

    def left_out(self, sweeps: Dataset, test: Array) -> dict[str, list[Any]]:
        """The values that the tested sweeps have of the group that the protocol leaves out; {} for
        random folds. test: numbers of sweeps."""
        found = LEAVE.fullmatch(self.text) or SPLIT.fullmatch(self.text)
        return {found[1]: np.unique(sweeps.group(found[1])[test]).tolist()} if found else {}

    def clusters(self, sweeps: Dataset) -> Array | None:
        """A cluster number for each sweep [N], for intervals: sweeps of a cluster succeed or fail
        together. Clusters are the left-out groups, or else recordings of several windows. None if
        sweeps are independent."""
        if found := LEAVE.fullmatch(self.text):
            return sweeps.group(found[1])
        recording = sweeps.group("recording")
        return recording if len(np.unique(recording)) < len(sweeps) else None


def draw(train: Array, labels: Array, each: int, seed: int) -> Array:
    """At most `each` sweeps of every material, from the sweep numbers `train`; sorted. labels: int
    [N], of all sweeps.

    With the same seed, a larger `each` adds to the sweeps of a smaller value, so a learning curve
    only grows.
    """
    rng = np.random.default_rng(seed)
    mine = labels[train]
    return np.sort(
        np.concatenate([rng.permutation(train[mine == label])[:each] for label in np.unique(mine)])
    )


def _checked(what: str, train: Array, test: Array, sweeps: Dataset) -> Fold:
    """The masks as numbers. Raises FormatError if both sides share a recording or there is too
    little to train on."""
    recordings = sweeps.group("recording")
    if shared := set(recordings[train].tolist()) & set(recordings[test].tolist()):
        raise FormatError(
            f"{what}: {len(shared)} recordings, {min(shared)} among them, would be trained on and "
            "tested on; choose a group that does not cut recordings"
        )
    if len(np.unique(sweeps.labels[train])) < 2:
        raise FormatError(
            f"{what}: {train.sum()} sweeps of fewer than two materials are left to train on; "
            "leave out less, or add sweeps"
        )
    return np.flatnonzero(train), np.flatnonzero(test)


WEIGHT = "sample_weight"
"""Group that says how much a sweep counts."""
OF_THE_SET = ("recording", "set", "split", "trial", "world", WEIGHT)
"""Groups that say where a sweep comes from, or what it counts. They are not conditions that a user
would vary."""
RANDOM_PARTS, MOST_PARTS = 5, 3
"""Parts of recordings, and most parts of another group."""


@dataclass(frozen=True, eq=False)
class InnerPart:
    """Sweeps of a training set that are held out to judge a model fitted to the other sweeps.
    group: the name of the group that is left out. out: bool [N]."""

    group: str
    out: Array


def inner_parts(sweeps: Dataset, varies: Sequence[str] = ()) -> list[InnerPart]:
    """The parts of each group that can be left out, at most MOST_PARTS of each. If no group can,
    the parts are recordings, with materials spread evenly. varies: only these groups.

    The first part of every group comes first, then the second parts, and so on. A group can be left
    out if it does not cut recordings in two, and if the other sweeps hold every material that is
    tested and two of one. Raises FormatError if nothing can be left out, or a group of `varies`
    cannot.
    """
    names = varies or sorted(set(sweeps.groups) - set(OF_THE_SET))
    of_all = [_parts_of(sweeps, name) for name in names]
    for name, parts in zip(varies, of_all, strict=False):
        if not parts:
            raise FormatError(
                f"{sweeps.source}: no value of {name!r} can be left out; it needs two values, "
                "materials under several of them, and no recording under two"
            )
    if any(of_all):
        return [part for turn in zip_longest(*of_all) for part in turn if part]
    return recording_parts(sweeps)


def recording_parts(sweeps: Dataset) -> list[InnerPart]:
    """Parts of recordings, with materials spread evenly; each sweep is in one of them. Raises
    FormatError if a material has one recording, or if one sweep of each would be left."""
    fewest = min(
        len(np.unique(sweeps.group("recording")[sweeps.labels == k]))
        for k in np.unique(sweeps.labels)
    )
    if fewest < 2:
        raise FormatError(
            f"{sweeps.source}: a material has one recording; "
            "choosing a model needs two of each, so record more"
        )
    drawn = Protocol(f"random:{min(RANDOM_PARTS, fewest)}").folds(sweeps, 1)
    parts = [InnerPart("recording", np.isin(np.arange(len(sweeps)), test)) for _, test in drawn]
    if not all(_varied(sweeps.labels[~part.out]) for part in parts):
        raise FormatError(
            f"{sweeps.source}: {len(sweeps)} sweeps of {len(np.unique(sweeps.labels))} materials "
            "are too few to choose a model, which leaves some of each out; record three of each"
        )
    return parts


def _varied(labels: Array) -> bool:
    """Whether some material has two sweeps, which show how a material varies."""
    return len(labels) > len(np.unique(labels))


def _parts_of(sweeps: Dataset, name: str) -> list[InnerPart]:
    values, member = np.unique(sweeps.group(name), return_inverse=True)
    recording = sweeps.group("recording")
    shuffled = np.random.default_rng(0).permutation(len(values))
    if len(shuffled) < 2 or len(np.unique(np.stack([recording, member]), axis=1).T) > len(
        np.unique(recording)
    ):
        return []
    parts = [
        np.isin(member, some) for some in np.array_split(shuffled, min(MOST_PARTS, len(shuffled)))
    ]
    labels = sweeps.labels
    rests = [(out, labels[~out]) for out in parts]
    return [
        InnerPart(name, out)
        for out, rest in rests
        if set(labels[out]) <= set(rest) and _varied(rest)
    ]
