"""Robustness: counts of right answers under each corruption, joined over seeds. All results hold
only numbers and text, for JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_train.data.corruptions import Corruption
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.metrics.score import interval

Array = NDArray[Any]
Json = dict[str, Any]
POINTS = 0.05
"""Loss of accuracy at which a method counts as failed, against its own accuracy on clean sweeps."""


class CorruptionCounts:
    """Counts right answers to `test` under one corruption after another; `merge` takes the
    result."""

    def __init__(self, test: EvaluationSweeps) -> None:
        self.test, self.curves = test, dict[str, Json]()

    def add(self, corruption: Corruption, answers: Sequence[Array]) -> None:
        """answers: for each severity, bool [N] of the right answers."""
        position = self.test.sweeps.groups.get("position")
        low, high = zip(*(interval(right, position) for right in answers), strict=True)
        self.curves[corruption.name] = {
            "title": corruption.title,
            "unit": corruption.unit,
            "about": corruption.about,
            "severities": [float(s) for s in corruption.severities],
            "right": [int(right.sum()) for right in answers],
            "low": list(low),
            "high": list(high),
        }

    def task(self, name: str, seed: int, pairs: Json | None = None) -> Json:
        """All counts as a task of the method `name`. pairs: curves of two corruptions at once."""
        sweeps = self.test.sweeps
        return {
            "method": name,
            "seed": seed,
            "set": sweeps.source,
            "refused": "",
            "total": len(sweeps),
            "curves": self.curves,
            "pairs": pairs or {},
        }


def merge(tasks: Iterable[Json]) -> Json:
    """Join tasks in any order: {"sets": [...], "methods": {name: entry}}.

    An entry holds seeds, refused ("" or the reason), curves and pairs; pairs are curves of two
    corruptions at once. A curve holds title, unit, about, severities, right and total (sums),
    accuracy, low and high, falls and lost. low and high are the means of the tasks' 95 % intervals,
    extended to the spread of the tasks: seeds share their sweeps, and the interval of their sum
    would be too narrow.
    """
    tasks = sorted(tasks, key=lambda t: (t["set"], t["seed"]))
    names = sorted({t["method"] for t in tasks})
    entries = {name: _entry([t for t in tasks if t["method"] == name]) for name in names}
    return {"sets": sorted({t["set"] for t in tasks}), "methods": entries}


def falls(curve: Json) -> float | None:
    """The severity at which accuracy is POINTS below that of clean sweeps, interpolated between
    two severities; None if it never is."""
    severity: list[float] = curve["severities"]
    accuracy: list[float] = curve["accuracy"]
    limit = accuracy[0] - POINTS + 1e-9  # .9 - .05 is less than .85
    for i in range(1, len(accuracy)):
        if accuracy[i] <= limit:
            part = (accuracy[i - 1] - limit) / (accuracy[i - 1] - accuracy[i])
            return round(severity[i - 1] + part * (severity[i] - severity[i - 1]), 6)
    return None


def breaks_first(curves: Mapping[str, Any]) -> list[str]:
    """The corruptions that cost five points, ordered by the share of their range that this
    takes."""
    reach = {
        name: curve["falls"] / curve["severities"][-1]
        for name, curve in curves.items()
        if curve["falls"] is not None
    }
    return sorted(reach, key=lambda name: (reach[name], -curves[name]["lost"], name))


def _entry(tasks: list[Json]) -> Json:
    """The entry of one method from all its tasks."""
    done = [t for t in tasks if not t["refused"]]
    totals = np.array([t["total"] for t in done])
    return {
        "seeds": sorted({t["seed"] for t in done}),
        "refused": next((t["refused"] for t in tasks if t["refused"]), ""),
    } | {
        kind: {
            name: _curve([t[kind][name] for t in done], totals)
            for name in (done[0][kind] if done else ())
        }
        for kind in ("curves", "pairs")
    }


def _curve(parts: list[Json], totals: Array) -> Json:
    """The joined curve of one method and corruption. totals [tasks]: sweeps of each task."""
    right = np.array([part["right"] for part in parts])  # [tasks, severities]
    shares = right / totals[:, None]
    accuracy = right.sum(axis=0) / totals.sum()
    low = np.minimum(np.mean([part["low"] for part in parts], axis=0), shares.min(axis=0))
    high = np.maximum(np.mean([part["high"] for part in parts], axis=0), shares.max(axis=0))
    curve = {k: parts[0][k] for k in ("title", "unit", "about", "severities")} | {
        "right": right.sum(axis=0).tolist(),
        "total": int(totals.sum()),
        "accuracy": accuracy.round(6).tolist(),
        "low": low.round(4).tolist(),
        "high": high.round(4).tolist(),
        "lost": round(float(np.mean(accuracy[0] - accuracy[1:])), 4),
    }
    return curve | {"falls": falls(curve)}
