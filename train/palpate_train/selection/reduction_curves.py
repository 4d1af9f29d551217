"""Curves of accuracy over reduced sweeps, one for each kind of reduction.

For each curve, the chosen size is fitted again to reduced sweeps and judged on the same held-out
sweeps, paired by sweep. A reduction is accepted if it and every weaker one lose at most one
standard error; the strongest accepted reduction is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data import transforms
from palpate_train.data.sets import Dataset
from palpate_train.data.transforms import WHOLE, Change
from palpate_train.metrics.score import confusion
from palpate_train.selection.dial import Selection, difference, estimate, judge

Array = NDArray[Any]
Json = dict[str, Any]
Step = tuple[str, float, Change]
"""One point of a curve: its name, the share that is left, and the change."""
REDUCTIONS = ("window", "rate", "taxels", "bits", "classes")
"""Properties of the sweeps that can be reduced."""
APPLIED = ("window",)
"""The reductions with which the model is fitted. Another rate, fewer taxels or bits need another
setting of the sensor, and only the user knows whether two materials may share a label."""
WINDOWS, RATES, BITS = (0.75, 0.5, 0.25), (2, 4, 8), (1, 2, 3, 4)
POINTS_BEYOND = 2
"""A curve ends at the second point that loses too much: two points show where accuracy falls."""
CONFUSED = 0.25
"""Share of confused sweeps from which on two materials are proposed as one; guessing confuses
half."""
HOW_TO_SET = {
    "window": (
        "nothing to set: the box uses the middle of each sweep; the robot may slide for less time"
    ),
    "rate": "set the readout board to average {0} frames and send one",
    "taxels": (
        "connect only these taxels, in this order, or leave the others out on the readout board"
    ),
    "bits": (
        "a converter of this many bits is enough; the raw counts keep their type, and the bundle "
        "does not change"
    ),
}


def right(choice: Selection, change: Change) -> Array:
    """bool [n], the held-out sweeps that the chosen size, fitted to reduced sweeps, classifies
    correctly with `change`. Raises FormatError if the reduced sweeps are too short."""
    whole = choice.judgement
    run = replace(whole.setup.run, folder=None)
    run.log(f"with less: {change}")
    sweeps, settings = change.of(whole.setup.sweeps), whole.reduced(choice.chosen)
    return judge(sweeps, run, settings, [choice.chosen], whole.staged).right(choice.chosen)


def fine(choice: Selection, full: Array, less: Array) -> bool:
    """Whether the reduced sweeps suffice: they lose little, and they reach the wanted accuracy if
    the whole sweeps do."""
    falls_short = less.mean() < choice.wanted.accuracy <= full.mean()
    return difference(full, less, choice.judgement.clusters).within and not bool(falls_short)


def _point(choice: Selection, full: Array, less: Array, step: Step) -> Json:
    """A point of a curve for scripts."""
    clusters = choice.judgement.clusters
    return {
        "name": step[0],
        "share": round(step[1], 4),
        "accuracy": estimate(less, clusters),
        "behind": difference(full, less, clusters).json(),
        "fine": fine(choice, full, less),
    }


def curves(choice: Selection, kinds: Collection[str]) -> tuple[list[Json], Change]:
    """The curves of these kinds, and the reductions of APPLIED among them as one Change."""
    found: list[Json] = []
    applied = WHOLE
    for kind in kinds:
        if kind == "classes":
            found.append(classes(choice))
            continue
        curve, change = _curve(choice, kind)
        if kind in APPLIED:
            applied = applied.and_then(change)
        found.append(curve | {"applied": kind in APPLIED and change != WHOLE})
    return found, applied


def _curve(choice: Selection, kind: str) -> tuple[Json, Change]:
    judged = choice.judgement
    full = judged.right(choice.chosen)
    whole: Step = ("all", 1.0, WHOLE)
    points, kept, beyond = [_point(choice, full, full, whole)], whole, 0
    for step in STEPS[kind](judged.setup.sweeps):
        try:
            less = right(choice, step[2])
        except FormatError as e:
            points.append({"name": step[0], "share": step[1], "refused": str(e)})
            break
        points.append(_point(choice, full, less, step))
        beyond += not points[-1]["fine"]
        if beyond == POINTS_BEYOND:
            break
        if not beyond:
            kept = step
    change = kept[2]
    how_to_set = HOW_TO_SET[kind].format(change.rate) if change != WHOLE else ""
    cols = judged.setup.sweeps.format.cols
    taxels = {"taxels": [list(divmod(t, cols)) for t in sorted(change.taxels)]}
    return {"kind": kind, "points": points, "kept": kept[0], "set": how_to_set} | (
        taxels if change.taxels else {}
    ), change


def _windows(sweeps: Dataset) -> Iterator[Step]:
    for share in WINDOWS:
        seconds = share * sweeps.format.window / sweeps.rate_hz
        yield f"{seconds:.3g} s", share, Change(window=share)


def _rates(sweeps: Dataset) -> Iterator[Step]:
    for rate in RATES:
        yield f"{sweeps.rate_hz / rate:.4g} Hz", 1 / rate, Change(rate=rate)


def _bits(sweeps: Dataset) -> Iterator[Step]:
    kind = sweeps.samples.dtype
    all_bits = 8 if kind.kind == "f" else 8 * kind.itemsize
    for bits in BITS:
        yield f"{all_bits - bits} bits", 1 - bits / all_bits, Change(bits=bits)


def _taxels(sweeps: Dataset) -> Iterator[Step]:
    """Numbers of taxels that are powers of two. All sweeps select the taxels, so this curve is
    slightly too high."""
    count = sweeps.format.rows * sweeps.format.cols
    order = transforms.rank_taxels(sweeps)
    n = 2 ** ((count - 1).bit_length() - 1) if count > 1 else 0
    while n:
        yield f"{n} taxels", n / count, Change(taxels=tuple(sorted(order[:n])))
        n //= 2


STEPS: dict[str, Callable[[Dataset], Iterator[Step]]] = {
    "window": _windows,
    "rate": _rates,
    "taxels": _taxels,
    "bits": _bits,
}


def classes(choice: Selection) -> Json:
    """The accuracy gained by merging materials, the most confused pair first, counted without
    another fit.

    Pairs are proposed that are CONFUSED, and as many as are needed for the wanted accuracy. Nothing
    is applied: only the user knows whether two materials may share a label.
    """
    judged = choice.judgement
    names: list[tuple[str, ...]] = [(name,) for name in judged.setup.sweeps.materials]
    label, named, total = judged.labels, judged.sizes[choice.chosen].named, len(names)
    points: list[Json] = []
    proposed, merged, proposing = list(names), "", True
    while True:
        accuracy = estimate(named == label, judged.clusters)
        points.append(
            {
                "name": f"{len(names)}",
                "share": round(len(names) / total, 4),
                "accuracy": accuracy,
                "merged": merged,
            }
        )
        if len(names) == 2:
            break
        confused = _confused(label, named, len(names))
        a, b = (int(i) for i in np.unravel_index(confused.argmax(), confused.shape))
        names[a], merged = names[a] + names[b], " + ".join(names[a] + names[b])
        names.pop(b)
        wanting = accuracy["mean"] < choice.wanted.accuracy
        if proposing := proposing and (confused[a, b] >= CONFUSED or wanting):
            proposed = list(names)
        label, named = (np.where(x == b, a, x - (x > b)) for x in (label, named))
    return {
        "kind": "classes",
        "points": points,
        "kept": points[0]["name"],
        "proposed": [list(merge) for merge in proposed if len(merge) > 1],
        "set": "",
        "applied": False,
    }


def _confused(label: Array, named: Array, count: int) -> Array:
    """[K, K], above the diagonal: for two materials, the share of their sweeps that are taken for
    the other."""
    counts = confusion(label, np.eye(count)[named])
    size = counts.sum(1)
    return np.triu((counts + counts.T) / np.maximum(size[:, None] + size, 1), 1)
