"""The room of where the skin sat. In: a training set; a bundle and simulated sweeps. Out: a ContactPositions, and what moving costs.

A ContactPositions goes into the bundle, so that the box can say how far a contact lies from those of training. How well that goes
with accuracy is measured by `palpate-train alignment`: the same sweeps again and again, with the skin ever further off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.core.types import Frames, Status, Sweep
from appliance.inference.classifier import Classifier
from appliance.signal.contact import MOST_POSITIONS, ContactPositions, centre
from appliance.sim import skin
from train.calibration import novelty
from train.data.sets import Dataset
from train.evaluation.corruptions import EvaluationSweeps
from train.metrics.score import interval, provenance

Array = NDArray[Any]
Json = dict[str, Any]
LEAST = 1 / 8
"""The limit is never below this share of the pitch: by so much attaching the skin again in the same place moves the
centre (0.5 of 4 mm hold over 95 % of the simulated ones), whatever few or equal positions say."""
OFF_MM = tuple(np.arange(0.5, 6.25, 0.5).tolist())
"""How far the skin is moved."""
WAYS = {"rows": "dx_mm", "columns": "dy_mm"}
FALL = 0.05
"""Accuracy counts as lost where it is so far below that of a skin in its place."""


def place_of(sweeps: Dataset, contact: float, pitch_mm: float | None = None) -> ContactPositions | None:
    """Where the contact lay at each position of a training set (else at each recording); None where nothing says how
    far apart the taxels are, or nothing touched them.

    contact: the bundle's threshold. pitch_mm: of the skin; a simulated one's is known. The digits are taken as the box
    takes them without a TARE: counted from the unloaded skin.
    The limit keeps 97 % of positions whose own sweeps were left out (their farthest one counts), as known.limit takes
    it; of 33 and less all.
    """
    if pitch_mm is None and all(part.startswith("sim:") for part in sweeps.source.split(" + ")):
        pitch_mm = skin.PITCH_MM
    if pitch_mm is None:
        return None
    tare = np.zeros(sweeps.samples.shape[2:])
    found = [centre(window, tare, contact) for window in sweeps.samples]
    touched = np.array([point is not None for point in found])
    if not touched.any():
        return None
    points = np.array([point for point in found if point]) * pitch_mm
    member = np.unique(sweeps.groups.get("position", sweeps.group("recording"))[touched], return_inverse=True)[1]
    centres = np.stack([points[member == one].mean(axis=0) for one in range(member.max() + 1)])
    limit = max(pitch_mm * LEAST, novelty.limit(farthest(points, member, centres)) if len(centres) > 1 else 0.0)
    kept = centres[np.linspace(0, len(centres) - 1, min(len(centres), MOST_POSITIONS)).round().astype(int)].round(3)
    return ContactPositions(float(pitch_mm), tuple(kept[:, 0].tolist()), tuple(kept[:, 1].tolist()), round(limit, 3))


def farthest(points: Array, member: Array, centres: Array) -> Array:
    """For each position [P] how far (mm) its farthest sweep lies from the nearest of the others: points [N, 2], of the
    positions member [N], whose centres are [P, 2]."""
    told = np.zeros(len(centres))
    for one in range(len(centres)):
        others = np.delete(centres, one, axis=0)
        away = np.linalg.norm(points[member == one][:, None] - others, axis=2).min(axis=1)
        told[one] = away.max()
    return told


def measure(box: Classifier, unseen: str, seen: str, hard: str, log: Callable[[str], None]) -> Json:
    """What the box says of simulated sweeps with the skin where it was not: sets of positions that were not trained
    (`unseen`, which are then moved), of those that were (`seen`), and of T-HARD's. Raises FormatError where the bundle
    has no positions."""
    place = box.bundle.manifest.place
    if place is None:
        raise FormatError(f"bundle {box.bundle.id} has no positions to compare with; export it again")
    told: Json = {"bundle": box.bundle.id, "limit_mm": place.limit_mm, "positions": len(place.rows_mm)}
    told |= {name: _point(box, EvaluationSweeps.simulated(spec)) | {"set": spec} for name, spec in
             (("trained positions, other sweeps", seen), ("other positions", unseen), ("T-HARD", hard))}  # fmt: skip
    trial, told["moved"] = EvaluationSweeps.simulated(unseen), {}
    for way, name in WAYS.items():
        points = []
        for mm in (*(-off for off in reversed(OFF_MM)), 0.0, *OFF_MM):
            log(f"{way} {mm:+g} mm")
            points.append({"mm": mm} | _point(box, trial, partial(_shifted, name=name, mm=mm)))
        told["moved"][way] = points
        told |= {f"{way}, {word}": _fall(part) for word, part in _halves(points)}
    return told | provenance()


def _shifted(placement: skin.Placement, name: str, mm: float) -> skin.Placement:
    return replace(placement, **{name: getattr(placement, name) + mm})


def _point(
    box: Classifier, trial: EvaluationSweeps, where: Callable[[skin.Placement], skin.Placement] = lambda p: p
) -> Json:
    """The box's answers to the trial's sweeps, with the skin moved. Sweeps of one attachment count as together."""
    assert trial.scene
    sweeps, place, limits = trial.sweeps, box.bundle.manifest.place, box.bundle.manifest.thresholds
    assert place
    right, moved, wrong, told = (np.zeros(len(sweeps)) for _ in range(4))
    for i, window in enumerate(trial.scene.draw(where)):
        n = np.arange(len(window))
        verdict = box(Sweep(i, 0, 0, Status.OK, Frames(n, n, window)))
        right[i] = verdict.label == sweeps.materials[sweeps.labels[i]]
        wrong[i], moved[i] = bool(verdict.label) and not right[i], bool(verdict.moved)
        found = centre(window, box.tare, limits.contact)
        told[i] = np.hypot(*place.offset(found)) if found else np.nan
    attachment = sweeps.group("position")
    return {
        "n": len(sweeps), "attachments": len(np.unique(attachment)), "accuracy": _share(right, attachment),
        "moved": _share(moved, attachment), "wrong": int(wrong.sum()), "wrong_unflagged": int((wrong * (1 - moved)).sum()),
        "told_mm": round(float(np.nanmedian(told)), 2) if np.isfinite(told).any() else None,
    }  # fmt: skip


def _share(values: Array, attachment: Array) -> list[float]:
    """Mean and its 95 % interval."""
    return [round(float(values.mean()), 4), *interval(values, attachment)]


def _halves(points: Sequence[Json]) -> Iterator[tuple[str, list[Json]]]:
    """Points from 0 outwards, each way."""
    middle = len(points) // 2
    yield "forwards", list(points[middle:])
    yield "backwards", list(points[middle::-1])


def _fall(points: Sequence[Json]) -> Json:
    """The first displacement where accuracy has fallen by FALL, and how many sweeps are flagged there and one before."""
    at_home = points[0]["accuracy"][0]
    for before, point in pairwise(points):
        if point["accuracy"][0] <= at_home - FALL:
            return {"lost_at_mm": abs(point["mm"]), "moved": point["moved"], "moved_before": before["moved"]}
    return {"lost_at_mm": None, "moved": points[-1]["moved"], "moved_before": points[-2]["moved"]}


def lines(told: Json) -> Iterator[str]:
    """For a person: accuracy and share flagged, with intervals, at each displacement."""
    yield f"bundle {told['bundle']}, {told['positions']} positions, limit {told['limit_mm']} mm"
    named = {k: v for k, v in told.items() if isinstance(v, dict) and "attachments" in v}
    rows = [(name, point) for name, point in named.items()]
    rows += [(f"{way} {p['mm']:+.1f} mm", p) for way, points in told["moved"].items() for p in points]
    for name, point in rows:
        right, moved = ("{:.3f} [{:.3f}, {:.3f}]".format(*point[key]) for key in ("accuracy", "moved"))
        yield f"{name:<32} n {point['n']:>4}  right {right}  moved {moved}  told {point['told_mm']} mm"
