"""Measures how altered sweeps move the embedding of a bundle, and lets these changes count little
in its check of unknown materials.

Copies of training sweeps are altered as in a test of robustness: hum, noise, gain, speed, lost
frames, fewer bits, displacement. Copies of held-out sweeps judge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.disturbance import Disturbances, hum
from palpate_train.answer import fit_disturbance
from palpate_train.answer.calibrate import CalibrationInputs, Shapes, left_out
from palpate_train.answer.embedding import Embedding
from palpate_train.answer.fit_unknown import (
    FEWEST_JUDGED,
    DisturbedSweeps,
    Embed,
    Scatters,
    ShapeRule,
    choose,
)
from palpate_train.answer.stranger_limits import LeftOut
from palpate_train.data.corruptions import TAXEL_FAULTS, Corruption, applicable
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset
from palpate_train.metrics import tolerances

Array = NDArray[Any]
FIGURES = "altered sweeps"
"""Key of the figures in a manifest."""


@dataclass(frozen=True, eq=False)
class Widened:
    """Shapes of materials that alterations have widened.

    shapes: float16 [K, r, r] of each embedding that was given. rule: gave them. training: features
    of the training sweeps and of their altered copies, without those whose disturbance the box
    notices. figures: for the manifest. disturbances: likewise. changes: float16 [D, K, r] by these,
    of the class means of each embedding.
    """

    shapes: tuple[NDArray[np.float16], ...]
    rule: ShapeRule
    training: DisturbedSweeps
    figures: dict[str, Any]
    disturbances: Disturbances
    changes: tuple[NDArray[np.float16], ...]


def few(held_out: Dataset) -> bool:
    """Whether too few sweeps of a material were held out to judge weights."""
    each = np.bincount(held_out.labels, minlength=len(held_out.materials))
    return bool(each.min() < FEWEST_JUDGED)


def measure(
    features: Embed,
    train: Dataset,
    held_out: Dataset,
    judge: Embedding,
    *others: Embedding,
    tare: Array,
    seed: int = 0,
) -> Widened | None:
    """The widened shapes in the embedding `judge`, best fitted without `held_out`, and in others,
    by the rule that `judge` finds; None if it finds none. features: of raw counts, which the
    embeddings take. tare: counts [R, C] or [R, C, A] of the unloaded skin, 0 if unknown."""
    meter = fit_disturbance.DisturbanceMeter(train.format, tare, train.samples)
    given = enumerate(map(EvaluationSweeps, (train, held_out)))
    training, held = (disturbed(features, of, seed + i, meter) for i, of in given)
    held, embeddings = held.seen_by(judge), (judge, *others)
    seen = [training.seen_by(embedding) for embedding in embeddings]
    unnoticed = fit_disturbance.unnoticed(training, training)
    scatters = [Scatters.of(unnoticed.seen_by(one), one) for one in embeddings]
    judging = fit_disturbance.unnoticed(training, held)
    rule = choose(scatters[0], judging)
    if rule is None:
        return None
    shapes = tuple(map(rule.shapes, scatters))
    widened = shapes[0].astype(np.float64)
    judged = fit_disturbance.Judge(held, scatters[0].means, widened, rule.limit)
    allowed = fit_disturbance.fit(judged, *seen)
    return Widened(
        shapes,
        rule,
        unnoticed,
        _figures(rule, judging) | {"disturbances": allowed.figures},
        Disturbances(allowed.allowances, meter.hum),
        allowed.changes,
    )


def left_out_in_turn(
    found: Widened, given: CalibrationInputs, finished: Embedding
) -> dict[str, LeftOut]:
    """As calibrate.left_out_in_turn, with widened shapes."""
    trained = len(found.training.labels)

    def view(seen: Array, embedding: Embedding, present: Array) -> Shapes:
        training = found.training.take(seen[:trained], present).seen_by(embedding)
        scatters = Scatters.of(training, embedding)

        def shapes(of: Scatters) -> Array:
            return found.rule.shapes(of).astype(np.float64)

        return shapes(scatters), lambda k: shapes(scatters.without(k))

    return {
        name: left_out(given, values, given.judged, finished, view)
        for name, values in given.conditions.items()
    }


def disturbed(
    features: Embed, every: EvaluationSweeps, seed: int, meter: fit_disturbance.DisturbanceMeter
) -> DisturbedSweeps:
    """The features of sweeps and of copies with each fault of CORRUPTIONS that applies to recorded
    counts, with the disturbances that `meter` measures. Broken taxels are left out, because the
    box bridges them."""
    sweeps, rng = every.sweeps, np.random.default_rng(seed)
    copies, sizes, usual = {}, {}, dict[str, Array]()
    for corruption in applicable(every):
        if (kind := corruption.name) in TAXEL_FAULTS:
            continue
        source = rng.permutation(len(sweeps))[: tolerances.COPIES]
        samples, severity = altered_copies(corruption, every, source, seed)
        name, counts = fit_disturbance.OF_KIND.get(kind), np.empty(0)
        if name == "hum":
            samples, counts = meter.clean(samples)
        copies[kind] = features(samples), source
        if name in ("lost", "hum"):
            value = severity if name == "lost" else np.array([hum(one) for one in counts])
            sizes[kind] = value, np.zeros(len(sweeps))
        elif name:
            if name not in usual:
                usual[name] = meter.values(name, sweeps.samples)
            sizes[kind] = meter.values(name, samples), usual[name]
    return DisturbedSweeps(features(sweeps.samples), sweeps.labels, copies, sizes)


def altered_copies(
    corruption: Corruption, every: EvaluationSweeps, source: Array, seed: int
) -> tuple[Array, Array]:
    """Copies of the sweeps `source` (numbers [M]), a part of them at each severity; and the
    severities [M]."""
    most, copies, severities = corruption.severities[-1], [], []
    for step, part in enumerate(np.array_split(source, fit_disturbance.SEVERITIES), start=1):
        if len(part):
            some, severity = every.take(part), most * step
            severities.append(min(most, severity / fit_disturbance.SEVERITIES))
            copies.append(corruption.apply(some, severities[-1], seed))
    return np.concatenate(copies), np.repeat(severities, [len(one) for one in copies])


def _figures(rule: ShapeRule, held: DisturbedSweeps) -> dict[str, Any]:
    before, after = rule.passed
    return {
        "sweeps": len(held.labels),
        "left out": [round(before, 4), round(after, 4)],
        "kept": {kind: [round(share, 4) for share in shares] for kind, shares in rule.kept.items()},
        "weights": dict(rule.weights),
        "trained directions": rule.trained,
    }


def text(figures: Mapping[str, Any]) -> str:
    """The figures of a manifest in words."""
    found = figures.get(FIGURES)
    if not found:
        return (
            "altered sweeps: not measured, so hum, noise or another gain look like a new material"
        )
    before, after = (np.mean([shares[i] for shares in found["kept"].values()]) for i in range(2))
    lines = [
        f"altered sweeps: {100 * after:.1f} % count as a known material, before {100 * before:.1f} "
        f"%; of materials that are left out {100 * found['left out'][1]:.1f} %, before "
        f"{100 * found['left out'][0]:.1f} %"
    ]
    for kind, (was, now) in found["kept"].items():
        lines.append(f"  {kind}: {100 * now:.1f} %, before {100 * was:.1f} %")
    for name, shares in found.get("disturbances", {}).items():
        (was, now), (passed, passes) = shares["kept"], shares["left out"]
        lines.append(
            f"  allowed for {name}: {100 * now:.1f} % known, before {100 * was:.1f} %; of left-out "
            f"materials {100 * passes:.1f} %, before {100 * passed:.1f} %"
        )
    return "\n".join(lines)
