"""Curves of accuracy over reduced sweeps of a scene, one for each kind of reduction.

For each curve, the chosen method is trained again on reduced sweeps, with the same parts, and
compared with the whole sweeps, paired by sweep. A reduction is accepted if it and every weaker one
lose at most one standard error; the strongest accepted reduction is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from train.data import transforms
from train.data.transforms import WHOLE, Change
from train.metrics.score import confusion
from train.selection.nested_cv import Trials
from train.selection.scene import Scene
from train.selection.select import Selection

Array = NDArray[Any]
Json = dict[str, Any]
Step = tuple[str, float, list[Change], Change]
"""One point of a curve: its name, the share that is left, the change for each part, and the change
for all sweeps."""
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


def most(trials: Trials, kinds: Collection[str]) -> int:
    """The largest number of trainings for the curves of these kinds and for their joint
    application."""
    taxels = trials.sweeps.format.rows * trials.sweeps.format.cols
    points = {
        "window": len(WINDOWS),
        "rate": len(RATES),
        "bits": len(BITS),
        "taxels": (taxels - 1).bit_length(),
    }
    return (
        sum(1 + points[kind] for kind in kinds if kind in points)
        * len(trials.parts)
        * len(trials.seeds)
    )


def curves(choice: Selection, scene: Scene) -> tuple[list[Json], Change, Json]:
    """The curves of scene.reduce, the reductions of scene.apply as one Change, and the accuracy
    with that change."""
    found: list[Json] = []
    strongest: dict[str, Step] = {}
    for at, kind in enumerate(scene.reduce):
        choice.trials.progress.left(most(choice.trials, scene.reduce[at:]))
        if kind == "classes":
            found.append(classes(choice, scene.accuracy))
            continue
        curve, strongest[kind] = _curve(choice, scene, kind)
        found.append(curve)
    applied, accuracy = _together(
        choice, scene, {kind: strongest[kind] for kind in scene.apply if kind in strongest}
    )
    for curve in found:
        curve["applied"] = getattr(applied, curve["kind"], None) != getattr(
            WHOLE, curve["kind"], None
        )
    return found, applied, accuracy


def _curve(choice: Selection, scene: Scene, kind: str) -> tuple[Json, Step]:
    trials, method = choice.trials, choice.final.chosen
    full = choice.final.scores[method]
    whole: Step = ("all", 1.0, [WHOLE] * len(trials.parts), WHOLE)
    points, kept, beyond = [_point(trials, full, full, whole, True)], whole, 0
    for step in STEPS[kind](trials):
        try:
            scores = _scores(trials, method, step)
        except FormatError as e:
            points.append({"name": step[0], "share": step[1], "refused": str(e)})
            break
        fine = _fine(trials, scene, full, scores)
        points.append(_point(trials, full, scores, step, fine))
        beyond += not fine
        if beyond == POINTS_BEYOND:
            break
        if not beyond:
            kept = step
    change = kept[3]
    how_to_set = HOW_TO_SET[kind].format(change.rate) if change != WHOLE else ""
    taxels = {"taxels": [list(divmod(t, trials.sweeps.format.cols)) for t in sorted(change.taxels)]}
    return {"kind": kind, "points": points, "kept": kept[0], "set": how_to_set} | (
        taxels if change.taxels else {}
    ), kept


def _scores(trials: Trials, method: str, step: Step) -> Array:
    trials.run(method, [(p,) for p in range(len(trials.parts))], step[2])
    return trials.scores(method, None, step[2])


def _fine(trials: Trials, scene: Scene, full: Array, scores: Array) -> bool:
    """Whether the reduced sweeps suffice: they lose little, and they reach the wanted accuracy if
    the whole sweeps do."""
    falls_short = trials.mean(scores) < scene.accuracy <= trials.mean(full)
    return trials.difference(full, scores).within and not falls_short


def _point(trials: Trials, full: Array, scores: Array, step: Step, fine: bool) -> Json:
    behind = trials.difference(full, scores).json()
    return {
        "name": step[0],
        "share": round(step[1], 4),
        "accuracy": trials.accuracy(scores),
        "behind": behind,
        "fine": fine,
    }


def _windows(trials: Trials) -> Iterator[Step]:
    for share in WINDOWS:
        seconds = share * trials.sweeps.format.window / trials.sweeps.rate_hz
        yield (
            f"{seconds:.3g} s",
            share,
            [Change(window=share)] * len(trials.parts),
            Change(window=share),
        )


def _rates(trials: Trials) -> Iterator[Step]:
    for rate in RATES:
        yield (
            f"{trials.sweeps.rate_hz / rate:.4g} Hz",
            1 / rate,
            [Change(rate=rate)] * len(trials.parts),
            Change(rate=rate),
        )


def _bits(trials: Trials) -> Iterator[Step]:
    kind = trials.sweeps.samples.dtype
    all_bits = 8 if kind.kind == "f" else 8 * kind.itemsize
    for bits in BITS:
        yield (
            f"{all_bits - bits} bits",
            1 - bits / all_bits,
            [Change(bits=bits)] * len(trials.parts),
            Change(bits=bits),
        )


def _taxels(trials: Trials) -> Iterator[Step]:
    """Numbers of taxels that are powers of two. The taxels are selected again without each part,
    since their selection is part of the test."""
    format = trials.sweeps.format
    count = format.rows * format.cols
    orders = [transforms.rank_taxels(trials.sweeps.take(~part.out)) for part in trials.parts]
    overall = transforms.rank_taxels(trials.sweeps)
    n = 2 ** ((count - 1).bit_length() - 1) if count > 1 else 0
    while n:
        change = [Change(taxels=tuple(sorted(order[:n]))) for order in orders]
        yield f"{n} taxels", n / count, change, Change(taxels=tuple(sorted(overall[:n])))
        n //= 2


STEPS: dict[str, Callable[[Trials], Iterator[Step]]] = {
    "window": _windows,
    "rate": _rates,
    "taxels": _taxels,
    "bits": _bits,
}


def _together(choice: Selection, scene: Scene, least: dict[str, Step]) -> tuple[Change, Json]:
    """The reductions of `least`, applied one after another; each is kept only if all kept ones
    together still suffice."""
    trials, method = choice.trials, choice.final.chosen
    full = reduced = choice.final.scores[method]
    changes, total = [WHOLE] * len(trials.parts), WHOLE
    for name, share, each, change in least.values():
        if change == WHOLE:
            continue
        both = [a.and_then(b) for a, b in zip(changes, each, strict=True)]
        try:
            scores = _scores(trials, method, (name, share, both, total.and_then(change)))
        except FormatError:
            continue
        if _fine(trials, scene, full, scores):
            changes, total, reduced = both, total.and_then(change), scores
    return total, trials.accuracy(reduced) | {"behind": trials.difference(full, reduced).json()}


def classes(choice: Selection, wanted: float) -> Json:
    """The accuracy gained by merging materials, the most confused pair first, counted without
    another training.

    Pairs are proposed that are CONFUSED, and as many as are needed for the wanted accuracy. Nothing
    is applied: only the user knows whether two materials may share a label.
    """
    trials = choice.trials
    group, _, sweep, probability = trials.tested(choice.final.chosen)
    label = trials.sweeps.labels[sweep]
    names: list[tuple[str, ...]] = [(name,) for name in trials.sweeps.materials]
    points: list[Json] = []
    proposed, merged, proposing = list(names), "", True
    while True:
        rows = _rows(trials, group, sweep, probability.argmax(1) == label)
        accuracy, share = trials.accuracy(rows), len(names) / len(trials.sweeps.materials)
        points.append(
            {
                "name": f"{len(names)}",
                "share": round(share, 4),
                "accuracy": accuracy,
                "merged": merged,
            }
        )
        if len(names) == 2:
            break
        confused = _confused(label, probability)
        a, b = np.unravel_index(confused.argmax(), confused.shape)
        names[a], merged = names[a] + names[b], " + ".join(names[a] + names[b])
        names.pop(b)
        if proposing := proposing and (confused[a, b] >= CONFUSED or accuracy["mean"] < wanted):
            proposed = list(names)
        probability[:, a] += probability[:, b]
        probability = np.delete(probability, b, axis=1)
        label = np.where(label == b, a, label - (label > b))
    together = [list(merge) for merge in proposed if len(merge) > 1]
    return {
        "kind": "classes",
        "points": points,
        "kept": points[0]["name"],
        "proposed": together,
        "set": "",
    }


def _confused(label: Array, probability: Array) -> Array:
    """[K, K], above the diagonal: for two materials, the share of their sweeps that are taken for
    the other."""
    counts = confusion(label, probability)
    size = counts.sum(1)
    return np.triu((counts + counts.T) / np.maximum(size[:, None] + size, 1), 1)


def _rows(trials: Trials, group: Array, sweep: Array, right: Array) -> Array:
    """`right` of all tests as scores [groups, N]."""
    total, count = np.zeros((2, len(trials.groups), len(trials.sweeps)))
    np.add.at(total, (group, sweep), right)
    np.add.at(count, (group, sweep), 1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
