"""Warnings about a sweep set or a protocol that flatters a method, or wrongs it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.window import WindowLimits
from palpate.core.status import Status
from palpate_train.answer import fit_window
from palpate_train.answer.fit_contact import find_limit
from palpate_train.data import repeats
from palpate_train.data.readers import counted
from palpate_train.data.sets import Dataset, shortened
from palpate_train.data.splitters import OF_THE_SET
from palpate_train.evaluate import level_check

Array = NDArray[Any]


def of_set(sweeps: Dataset, learned: bool = True) -> list[str]:
    """The warnings about a set: sweeps that it holds twice; and if a model can learn from it,
    sweeps that the box would refuse, materials that were recorded under one condition only, and
    the mean level."""
    twice = repeats.warnings_of(sweeps, repeats.pairs(sweeps))
    if not learned:
        return list(twice)
    return [
        *_refused(sweeps),
        *twice,
        *_coinciding(sweeps),
        *level_check.warnings_of(sweeps),
    ]


def _refused(sweeps: Dataset) -> Iterator[str]:
    """A warning about sweeps that the box refuses by the usual limits of its check of a window,
    which no figure of a fit contains. It bridges some broken taxels only where export proves that
    this pays."""
    limit = find_limit(sweeps)
    limits = WindowLimits(limit.contact, fit_window.highest_count(sweeps))
    found = fit_window.findings(sweeps, limits, limit.tare)
    refused = Counter(str(one.status) for one in found if one.status is not Status.OK)
    if refused:
        few = refused.total() <= fit_window.MOST_REFUSED * len(sweeps)
        does = (
            "the box would refuse them unless it may bridge their taxels; drop them"
            if few
            else "a bundle accepts such sweeps, and faults like these with them; mend the skin"
        )
        yield (
            f"warning: {refused.total()} of {len(sweeps)} sweeps look like faults of the skin: "
            f"{counted(refused)}; {does}"
        )


def _coinciding(sweeps: Dataset) -> Iterator[str]:
    """A warning for each group whose values cannot be left out without a material."""
    for name in sorted(set(sweeps.groups) - {*OF_THE_SET, "object"}):
        values, _, counts = sweeps.counts_by(name)
        once = (counts > 0).sum(axis=0) == 1
        if len(values) < 2 or not once.any():
            continue
        n = int(counts[:, once].sum())
        materials = [sweeps.materials[k] for k in np.flatnonzero(once)]
        yield (
            f"warning: {n} of {len(sweeps)} sweeps are of materials with one {name} only "
            f"({shortened(materials)}): a protocol that leaves it out cannot name them, and others "
            f"may name the {name} in place of the material; record them under another one, too"
        )


def of_protocol(sweeps: Dataset, text: str, folds: Sequence[tuple[Array, Array]]) -> Iterator[str]:
    """The warnings about the folds of a protocol, pairs (training, test) of sweep numbers."""
    tested = sum(len(test) for _, test in folds)
    unnamed = sum(
        int((~np.isin(sweeps.labels[test], sweeps.labels[train])).sum()) for train, test in folds
    )
    if unnamed:
        yield (
            f"warning: {text}: {unnamed} of {tested} tested sweeps are of a material that their "
            "fold is not trained on, so no method can name them; leave out another group"
        )
    found = repeats.pairs(sweeps)
    shared = sum(len(found.across(*fold)) for fold in folds)
    if shared:
        yield (
            f"warning: {text}: {shared} of {tested} tested sweeps are identical to a training "
            "sweep or share frames with one, so even noise would get its label; give windows of "
            "one recording the same number in the group recording"
        )
