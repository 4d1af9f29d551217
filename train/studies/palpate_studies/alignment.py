"""The box's answers to simulated sweeps whose contact is displaced.

A bundle holds the contact positions of training, so the box can show how far a contact is from
them. This module measures how well that distance predicts accuracy: the same simulated sweeps, with
the skin moved further and further.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from palpate.answer.contact import centre
from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate.sim import skin
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.metrics import bundle_score
from palpate_train.metrics.score import interval, provenance

Json = dict[str, Any]
UNSEEN = "other positions"
SETS = {
    "trained positions, other sweeps": "sim:T-REAL/level-blind:1-6:2",
    UNSEEN: "sim:T-REAL/level-blind:101-104:2",
    "T-HARD": "sim:T-HARD/level-blind:101-136:2",
}
OFF_MM = tuple(np.arange(0.5, 6.25, 0.5).tolist())
"""Displacements of the skin in mm."""
DIRECTIONS = {"rows": "dx_mm", "columns": "dy_mm"}
LOSS = 0.05
"""Accuracy counts as lost if it is this far below that of a skin that was not moved."""


def measure(box: Classifier, log: Callable[[str], None]) -> Json:
    """The box's answers to the simulated sweeps of SETS, and with the skin moved from UNSEEN.

    Raises FormatError if the bundle has no positions.
    """
    place = box.bundle.manifest.contact
    if place is None:
        raise FormatError(
            f"bundle {box.bundle.id} has no positions to compare with; export it again"
        )
    result: Json = {
        "bundle": box.bundle.id,
        "limit_mm": place.limit_mm,
        "positions": len(place.rows_mm),
    }
    result |= {
        name: _point(box, EvaluationSweeps.simulated(spec)) | {"set": spec}
        for name, spec in SETS.items()
    }
    test, result["moved"] = EvaluationSweeps.simulated(SETS[UNSEEN]), {}
    for direction, name in DIRECTIONS.items():
        points = []
        for mm in (*(-off for off in reversed(OFF_MM)), 0.0, *OFF_MM):
            log(f"{direction} {mm:+g} mm")
            points.append({"mm": mm} | _point(box, test, partial(_shifted, name=name, mm=mm)))
        result["moved"][direction] = points
        result |= {f"{direction}, {word}": _loss(part) for word, part in _halves(points)}
    return result | provenance()


def _shifted(placement: skin.Placement, name: str, mm: float) -> skin.Placement:
    return replace(placement, **{name: getattr(placement, name) + mm})


def _point(
    box: Classifier,
    test: EvaluationSweeps,
    where: Callable[[skin.Placement], skin.Placement] = lambda p: p,
) -> Json:
    """The box's answers to the test sweeps, with the skin moved. The sweeps of an attachment are
    one cluster.

    accuracy, wrong: answered `ok` with the right and a wrong label. unsure, unknown: the other
    answers. network: most probable label of the network alone is right.
    """
    assert test.scene
    sweeps, place, limits = test.sweeps, box.bundle.manifest.contact, box.bundle.manifest.thresholds
    assert place
    assert limits.contact is not None
    right, moved, wrong, unsure, unknown, network, distance_mm = (
        np.zeros(len(sweeps)) for _ in range(7)
    )
    drawn = replace(sweeps, samples=test.scene.draw(where))
    for i, verdict in bundle_score.verdicts(box, drawn):
        window, truth = drawn.samples[i], sweeps.materials[sweeps.labels[i]]
        named = verdict.status is Status.OK
        right[i], wrong[i] = named and verdict.label == truth, named and verdict.label != truth
        unsure[i], unknown[i] = bool(verdict.label) and not named, verdict.status is Status.UNKNOWN
        moved[i] = verdict.displacement is not None
        network[i] = box.bundle.manifest.labels[int(box.logits(window).argmax())] == truth
        found = centre(window, box.tare, limits.contact)
        distance_mm[i] = np.hypot(*place.offset(found)) if found else np.nan
    attachment = sweeps.group("position")
    return {
        "n": len(sweeps),
        "attachments": len(np.unique(attachment)),
        "accuracy": _share(right, attachment),
        "network": _share(network, attachment),
        "wrong_share": _share(wrong, attachment),
        "unsure": int(unsure.sum()),
        "unknown": int(unknown.sum()),
        "moved": _share(moved, attachment),
        "wrong": int(wrong.sum()),
        "wrong_unflagged": int((wrong * (1 - moved)).sum()),
        "told_mm": round(float(np.nanmedian(distance_mm)), 2)
        if np.isfinite(distance_mm).any()
        else None,
    }


def _share(values: Array, attachment: Array) -> list[float]:
    """Mean and its 95 % interval."""
    return [round(float(values.mean()), 4), *interval(values, attachment)]


def _halves(points: Sequence[Json]) -> Iterator[tuple[str, list[Json]]]:
    """The points from 0 mm outwards, in each of the two directions."""
    middle = len(points) // 2
    yield "forwards", list(points[middle:])
    yield "backwards", list(points[middle::-1])


def _loss(points: Sequence[Json]) -> Json:
    """The first displacement where accuracy has fallen by LOSS, and the share of sweeps flagged
    there and one step before."""
    in_place = points[0]["accuracy"][0]
    for before, point in pairwise(points):
        if point["accuracy"][0] <= in_place - LOSS:
            return {
                "lost_at_mm": abs(point["mm"]),
                "moved": point["moved"],
                "moved_before": before["moved"],
            }
    return {"lost_at_mm": None, "moved": points[-1]["moved"], "moved_before": points[-2]["moved"]}
