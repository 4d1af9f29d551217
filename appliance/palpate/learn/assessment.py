"""The knowledge of a box that is taught, judged by sweeps that were left out.

It is the same for a model that the box fits (palpate_train.teach) and for materials taught into a
delivered bundle (materials.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.statistics import interval, wilson
from palpate.sweeps.sweep_folder import NoSlide

Array = NDArray[Any]
ENOUGH = 0.9
"""Lower end of the interval of the accuracy from which on more sweeps are not asked for."""
SURE = 0.9
"""Least probability of another material at which a sweep may be mislabelled."""
RIGHT = 0.6
"""Least share of the other sweeps of its material that are classified correctly then, and of the
sweeps of the other material. If materials are often confused, a single sweep says nothing about its
label."""
CURVE = 4
"""Number of further sweeps whose effect is estimated."""
MORE = 3
"""Number of further sweeps that an advice asks for."""


@dataclass(frozen=True, slots=True)
class Suspect:
    """A sweep that may have a wrong label: its file, and its number within its material."""

    sweep: str
    number: int
    material: str
    looks_like: str

    @property
    def text(self) -> str:
        return f"sweep {self.number} of {self.material} looks like {self.looks_like}"


@dataclass(frozen=True, slots=True)
class LearningCurve:
    """The effect of sweeps on the material with most errors. sweeps: of the material. fewer: by how
    many less a model was fitted. before, now: its share of sweeps that are classified correctly,
    with fewer sweeps and with all."""

    material: str
    sweeps: int
    fewer: int
    before: float
    now: float

    @property
    def text(self) -> str:
        """The share to expect, if errors fall on as a power of the number of sweeps."""
        n, less = self.sweeps, self.sweeps - self.fewer
        told = f"with {less} instead of {n} sweeps of {self.material}"
        if self.now <= self.before:
            return f"{told} it would be no worse, so more of them may not help"
        power = np.log((n + CURVE) / n) / np.log(n / less)
        then = 1 - (1 - self.now) * ((1 - self.now) / (1 - self.before)) ** power
        return (
            f"{told} {100 * self.before:.0f} instead of {100 * self.now:.0f} % of them would be "
            f"correct; {CURVE} more would bring this to about {100 * then:.0f} %"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """Answers to left-out sweeps.

    materials: all K that an answer can be. labels: int [N], indices of the sweeps' own; a material
    without a sweep was trained before. files: names of the sweeps' files, without suffix. named:
    float [N, K], the share of each sweep's judgements that are each material. chances: float
    [N, K], mean probabilities. left_out: the groups that were left out. clusters: int [N], sweeps
    that succeed or fail together; None if each is on its own. others: for things that were not
    taught, in words, the share that would get a label and their number; empty if not measured.
    unchecked: what nothing could check, in words. curve: None without errors or with few sweeps.
    """

    materials: tuple[str, ...]
    labels: Array
    files: tuple[str, ...]
    named: Array
    chances: Array
    left_out: tuple[str, ...] = ("recording",)
    clusters: Array | None = None
    no_slides: tuple[NoSlide, ...] = ()
    others: Mapping[str, tuple[float, int]] = field(default_factory=dict)
    unchecked: str = ""
    curve: LearningCurve | None = None

    @property
    def right(self) -> Array:
        """float [N], the share of correct judgements of each sweep."""
        shares: Array = self.named[np.arange(len(self.named)), self.labels]
        return shares

    @property
    def interval(self) -> tuple[float, float]:
        return interval(self.right, self.clusters)

    def confused(self) -> tuple[int, int] | None:
        """The two materials that are taken for each other most, None if nothing is confused."""
        counts = self._counts()
        counts += counts.T
        np.fill_diagonal(counts, 0)
        if not counts.any():
            return None
        first, second = divmod(int(counts.argmax()), len(counts))
        return min(first, second), max(first, second)

    def inseparable(self) -> tuple[int, int] | None:
        """The pair of `confused`, both with sweeps, if chance would classify them as well."""
        pair = self.confused()
        if not pair or not self._sweeps()[list(pair)].all():
            return None
        counts = self._counts()[np.ix_(pair, pair)]
        right, total = float(np.trace(counts)), float(counts.sum())
        return pair if wilson(right, max(round(total), 1))[0] <= 0.5 else None

    def suspects(self) -> list[Suspect]:
        """Sweeps that are surely of another material, where both are mostly correct."""
        found, right = [], self.right
        likely = self.chances.argmax(axis=1)
        sure = (likely != self.labels) & (self.chances.max(axis=1) >= SURE)
        for i in np.flatnonzero(sure).tolist():
            own = (self.labels == self.labels[i]) & (np.arange(len(right)) != i)
            of_other = self.labels == likely[i]
            if not own.any() or right[own].mean() < RIGHT:
                continue
            if of_other.any() and right[of_other].mean() < RIGHT:
                continue
            number = int((self.labels[: i + 1] == self.labels[i]).sum())
            label, other = (self.materials[k] for k in (self.labels[i], likely[i]))
            found.append(Suspect(self.files[i], number, label, other))
        return found

    def advice(self) -> str:
        """What to record next, or that it is enough."""
        suspects, pair, low = self.suspects(), self.inseparable(), self.interval[0]
        if suspects:
            return f"look at it first: {suspects[0].text}; move or discard it if that is so"
        if pair:
            one, other = (self.materials[k] for k in pair)
            return (
                f"{one} and {other} cannot be told apart so far; slide differently (faster, "
                "harder, longer), or teach them as one material"
            )
        if low >= ENOUGH:
            least = f"at least {100 * low:.0f} % of such sweeps are classified correctly"
            return f"enough: {least} (with 97.5 % certainty)"
        held = self._sweeps()
        if (worst := self.worst()) is not None:
            return f"{MORE} more of {self.materials[worst]}, from another place"
        fewest = self.materials[int(np.where(held > 0, held, np.inf).argmin())]
        few = f"nothing was confused, but {len(self.named)} sweeps are few"
        return f"{few}: {MORE} more of each, of {fewest} first"

    def worst(self) -> int | None:
        """The material with sweeps that has most errors, None without an error."""
        wrong = self._counts()
        np.fill_diagonal(wrong, 0)
        errors = np.where(self._sweeps() > 0, wrong.sum(axis=0) + wrong.sum(axis=1), 0)
        return int(errors.argmax()) if errors.any() else None

    def json(self) -> dict[str, Any]:
        pair, counts, (low, high) = self.confused(), self._counts(), self.interval
        between = float(counts[pair] + counts[pair[::-1]]) if pair else 0.0
        held = zip(self.materials, self._sweeps().tolist(), strict=True)
        return {
            "accuracy": round(float(self.right.mean()), 4),
            "low": low,
            "high": high,
            "sweeps": len(self.named),
            "materials": {name: n for name, n in held if n},
            "left_out": list(self.left_out),
            "confused": [*(self.materials[k] for k in pair), round(between, 1)] if pair else None,
            "others": {name: [*found] for name, found in self.others.items()},
            "no_slides": [asdict(one) for one in self.no_slides],
            "suspects": [asdict(one) | {"text": one.text} for one in self.suspects()],
            "advice": self.advice(),
            "text": self.text(),
        }

    def text(self) -> str:
        parts = " and ".join(f"{name}s" for name in self.left_out).replace("recording", "sweep")
        low, high = self.interval
        said = (
            f"{100 * self.right.mean():.0f} % of {len(self.named)} sweeps are classified correctly "
            f"among {len(self.materials)} materials if their {parts} are left out "
            f"[{100 * low:.0f}, {100 * high:.0f}]"
        )
        if pair := self.confused():
            one, other = (self.materials[k] for k in pair)
            said += f"; most often confused: {one} and {other}"
        for what, (share, n) in self.others.items():
            said += f"; of {n} {what} {100 * share:.0f} % would get a label"
        more = self.curve.text if self.curve else ""
        return "; ".join(part for part in (said, more, self.unchecked) if part)

    def _counts(self) -> Array:
        """float [K, K], rows by the material of the sweeps, columns by the answers."""
        counts = np.zeros((len(self.materials),) * 2)
        np.add.at(counts, self.labels, self.named)
        return counts

    def _sweeps(self) -> Array:
        """int [K], the number of sweeps of each material."""
        return np.bincount(self.labels, minlength=len(self.materials))
