"""Allowances for disturbances of a sweep, found from altered copies: the change of the class means
and the growth of the limit of known materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer import disturbance
from palpate.answer.disturbance import Allowance, Name
from palpate.answer.slide import SlideMeter
from palpate.answer.unknown import shaped_distances
from palpate.answer.window import TINY
from palpate.bundle.contents import Bundle
from palpate.core.types import SweepFormat
from palpate_train.answer import fit_hum
from palpate_train.answer.fit_unknown import DisturbedSweeps
from palpate_train.answer.rule import Rule
from palpate_train.metrics.tolerances import KEPT_COPIES, MARGIN, OUTER

Array = NDArray[Any]
MADE_BY: dict[tuple[Name, int], tuple[str, ...]] = {
    ("noise", 1): ("noise", "bits"),
    ("load", -1): ("gain-down",),
    ("load", 1): ("gain-up",),
    ("speed", -1): ("stretch",),
    ("speed", 1): ("shorten",),
    ("lost", 1): ("lost",),
    ("hum", 1): ("hum",),
}
"""Disturbance and its sign, and the kinds of copies that have it."""
OF_KIND = {kind: name for (name, _), kinds in MADE_BY.items() for kind in kinds}
HARDER = "speed"
"""The disturbance whose copies stretch the counts in time. In them the vibrations of skin and
finger change their frequency, too, which they do not at another speed. Such copies are harder than
a real slide: the means must not follow them, and where they fail nothing is refused."""
OUTERMOST = {"noise": OUTER, "load": 0.1, "speed": OUTER}
"""Share of the training sweeps beyond each edge. Loads spread widely, and a lower gain looks like
a lower load; hum and lost frames begin at 0."""
LOSS = 0.15
"""Accuracy that the nearest means may lose, as a share. Copies of a severity that costs more are
not allowed for."""
FEWEST_COPIES = 30
"""Least number of judged copies of a disturbance."""
SHRINK = 8
"""The change of a material counts as many copies, the mean change of all materials as many as
this."""
SEVERITIES = 6
"""Number of severities of a kind, at equal distances up to the largest."""


class DisturbanceMeter:
    """Measures the disturbances of windows [n, T, R, C] or [n, T, R, C, A] of one format, as the
    box does. tare: counts of the unloaded skin. hum: least ratio that is removed, None if none is;
    found on the training sweeps `trained` [n, T, ...]."""

    def __init__(self, format: SweepFormat, tare: Array, trained: Array) -> None:
        self._format, self._tare, self._slide = format, tare, SlideMeter(format, 1.0)
        self.hum = fit_hum.fit(format, trained)

    def clean(self, samples: Array) -> tuple[Array, Array]:
        """The windows without hum, and the amplitude that was removed of each [n]."""
        return fit_hum.cleaned(self._format, self.hum, samples)

    def values(self, name: str, samples: Array) -> Array:
        """The values [n] of noise, load or speed; NaN where one is not known."""
        if name == "noise":
            return np.array([disturbance.noise(window) for window in samples])
        if name == "load":
            means = (window.mean(axis=0, dtype=np.float64) for window in samples)
            return np.array([disturbance.load(mean, self._tare) for mean in means])
        return np.array([disturbance.speed(self._slide(window).taxels_s) for window in samples])


@dataclass(frozen=True, eq=False)
class _Tried:
    """Copies with one disturbance: labels, embeddings and sizes; more: the change of the size by
    the alteration; moved: that of the embedding."""

    labels: Array
    z: Array
    size: Array
    more: Array
    moved: Array

    @classmethod
    def of(cls, altered: DisturbedSweeps, kinds: Sequence[str], sign: int, start: float) -> _Tried:
        parts = []
        for kind in kinds:
            z, source = altered.copies[kind]
            copied, values = altered.disturbed[kind]
            size, was = (
                np.nan_to_num(sign * (v - start)).clip(0) for v in (copied, values[source])
            )
            labels = altered.labels[source]
            parts.append((labels, z, size, size - was, z - altered.z[source]))
        return cls(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def take(self, kept: Array) -> _Tried:
        return _Tried(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class AllowanceFit:
    """Allowances, and the changes [D, K, r] of the means in each embedding. figures: by
    disturbance the furthest value, the share of judged copies within the limit before and after,
    and that of materials that are left out."""

    allowances: tuple[Allowance, ...]
    changes: tuple[NDArray[np.float16], ...]
    figures: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Judge:
    """Judges allowances by copies that training has not seen. shapes: [K, r, r] of the class means
    [K, r]; limit: of known materials."""

    altered: DisturbedSweeps
    means: Array
    shapes: Array
    limit: float

    def distances(self, z: Array, change: Array | float = 0.0) -> Array:
        """Squared distances [n, K] of embeddings [n, r], as shares of the limit; change: of the
        means, [n, K, r]."""
        away = z[:, None] - self.means - change
        return shaped_distances(away, self.shapes) / self.limit

    def right(self, z: Array, labels: Array) -> Array:
        """Whether the nearest mean is that of the label, bool [n]."""
        nearest: Array = ((z[:, None] - self.means) ** 2).sum(axis=-1).argmin(axis=1) == labels
        return nearest

    def bearable(self, kinds: Sequence[str]) -> NDArray[np.bool_]:
        """Whether a copy of these kinds is of a severity before the first that costs more than
        LOSS, bool [M] in the order of _Tried."""
        altered, kept = self.altered, []
        least = self.right(altered.z, altered.labels).mean() - LOSS
        for kind in kinds:
            z, source = altered.copies[kind]
            right, bearable = self.right(z, altered.labels[source]), np.zeros(len(z), bool)
            for part in np.array_split(np.arange(len(z)), SEVERITIES):
                if len(part) and right[part].mean() < least:
                    break
                bearable[part] = True
            kept.append(bearable)
        return np.concatenate(kept)


def fit(judge: Judge, *training: DisturbedSweeps) -> AllowanceFit:
    """The allowances that `judge` finds, and the changes in the embedding of each of `training`:
    the same sweeps, first in the embedding of the judge."""
    found, changes, figures = [], [], {}
    for (name, sign), (start, made) in _edges(training[0]).items():
        every = _Tried.of(judge.altered, made, sign, start)
        tried = every.take(judge.bearable(made) & (every.size > 0))
        if len(tried.size) < FEWEST_COPIES:
            continue
        end = (1 + MARGIN) * float(tried.size.max())
        copies = [_Tried.of(altered, made, sign, start) for altered in training]
        moved = [_changes(one.take(one.size <= end), len(judge.means)) for one in copies]
        still = [np.zeros_like(moved[0])] * len(moved)
        ways = (still,) if name == HARDER else (moved, still)
        choices = [(_slope(judge, tried, of[0]), of) for of in ways]
        judged, moved = max(choices, key=lambda choice: choice[0].worth)
        slope, figures[f"{name}{'+' if sign > 0 else '-'}"] = judged.slope, judged.figures
        furthest = (1 + MARGIN) * float(every.size.max())
        at = [round(start + sign * size, 4) for size in (0.0, end, furthest)]
        further = at[2] if name == HARDER and at[2] != at[1] else None
        found.append(Allowance(name, at[0], at[1], slope, further))
        changes.append(moved)
    none = np.zeros((0, *judge.means.shape))
    stacked = tuple(
        np.array([of[i] for of in changes] or none).astype(np.float16) for i in range(len(training))
    )
    return AllowanceFit(tuple(found), stacked, figures)


def unnoticed(training: DisturbedSweeps, altered: DisturbedSweeps) -> DisturbedSweeps:
    """`altered` without the copies whose disturbance is beyond the edge of `training`. The box
    notices it and allows for it; other copies have to count as known without that."""
    copies = dict(altered.copies)
    for (_, sign), (start, kinds) in _edges(training).items():
        for kind in kinds:
            within = ~(sign * (altered.disturbed[kind][0] - start) > 0)
            z, source = copies[kind]
            copies[kind] = z[within], source[within]
    return replace(altered, copies={kind: of for kind, of in copies.items() if len(of[1])})


def _edges(training: DisturbedSweeps) -> dict[tuple[Name, int], tuple[float, list[str]]]:
    """Where training ends, and the kinds of copies beyond it, by disturbance and sign."""
    edges: dict[tuple[Name, int], tuple[float, list[str]]] = {}
    for (name, sign), kinds in MADE_BY.items():
        made = [kind for kind in kinds if kind in training.disturbed]
        start = _edge(name, sign, training.disturbed[made[0]][1]) if made else None
        if start is not None:
            edges[name, sign] = start, made
    return edges


def _edge(name: str, sign: int, values: Array) -> float | None:
    """Where training ends on one side, from the values [N] of training sweeps; None if too few of
    them are known."""
    if name not in OUTERMOST:
        return 0.0
    known = values[np.isfinite(values)]
    if len(known) < len(values) / 2:
        return None
    outer = OUTERMOST[name]
    return float(np.quantile(known, 1 - outer if sign > 0 else outer))


def _changes(copies: _Tried, materials: int) -> Array:
    """The change [K, r] of each mean by a disturbance of size 1, by least squares through 0."""
    more, moved, labels = copies.more, copies.moved, copies.labels
    mean = more @ moved / max(float(more @ more), TINY)
    prior = SHRINK * float(more @ more) / max(len(more), 1)
    changes = []
    for k in range(materials):
        own = labels == k
        square = float(more[own] @ more[own])
        changes.append((more[own] @ moved[own] + prior * mean) / max(square + prior, TINY))
    return np.stack(changes)


@dataclass(frozen=True)
class _Slope:
    """The growth of the limit for one disturbance. kept: share of judged copies within the limit,
    before and after; passed: likewise of materials that are left out."""

    slope: float
    kept: tuple[float, float]
    passed: tuple[float, float]
    copies: int

    @property
    def worth(self) -> float:
        return self.kept[1] - self.passed[1]

    @property
    def figures(self) -> dict[str, Any]:
        kept, passed = ([round(v, 4) for v in of] for of in (self.kept, self.passed))
        return {"kept": kept, "left out": passed, "copies": self.copies}


def _slope(judge: Judge, tried: _Tried, change: Array) -> _Slope:
    """The least growth of the limit that keeps KEPT_COPIES of the copies, of small disturbances
    and of large ones, if the means move by `change` [K, r]."""
    before = judge.distances(tried.z)
    after = judge.distances(tried.z, tried.size[:, None, None] * change)
    needed = ((after.min(axis=1) - 1) / tried.size)[np.argsort(tried.size, kind="stable")]
    by_size = np.array_split(needed, SEVERITIES)
    slope = max(0.0, *(float(np.quantile(part, KEPT_COPIES)) for part in by_size if len(part)))

    def within(distances: Array, limit: Array | float) -> float:
        return float((distances.min(axis=1) <= limit).mean())

    limit = 1 + slope * tried.size
    kept = within(before, 1), within(after, limit)
    for distances in (before, after):
        distances[np.arange(len(distances)), tried.labels] = np.inf
    passed = within(before, 1), within(after, limit)
    return _Slope(round(slope, 4), kept, passed, len(tried.labels))


def without(bundle: Bundle) -> Bundle:
    """The bundle that allows for no disturbance."""
    allowed, classes = bundle.manifest.disturbances, bundle.classes
    if not (allowed and allowed.allowances and classes):
        return bundle
    return replace(
        bundle,
        manifest=replace(bundle.manifest, disturbances=replace(allowed, allowances=())),
        classes=replace(classes, changes=classes.changes[:0]),
    )


RULES = {
    "disturbance": Rule("allowances for disturbances", without),
    "hum": Rule("hum removal", fit_hum.without),
}
