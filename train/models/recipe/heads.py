"""Heads of a trunk in closed form. In: a HeadPlan, features of sweeps. Out: one linear head.

A plan adds the logits of a few discriminants, each of some of the features: several that were
fitted apart know more of an unseen condition than one that was fitted to all features at once, and
together they are still one matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from train.calibration import discriminant

Array = NDArray[Any]
Given = tuple[Array, Array, Array, Array]
"""What a head is fitted to: features [N, F] and labels [N] of sweeps, features [M, F] and labels
[M] of augmented copies."""


@dataclass(frozen=True)
class HeadPart:
    """One discriminant. columns: numbers of the features that it sees. copies: whether it sees
    augmented copies of the sweeps too. factor: of its logits; temperatures are in it."""

    columns: tuple[int, ...]
    copies: bool
    factor: float = 1.0

    def fit(self, given: Given, classes: int) -> tuple[Array, Array]:
        """Weight [K, F] over all features, and bias [K]; see discriminant.fit."""
        columns, (x, y, copied, of) = np.array(self.columns), given
        if self.copies:
            x, y = np.concatenate([x, copied]), np.append(y, of)
        weight = np.zeros((classes, x.shape[1]), np.float32)
        weight[:, columns], bias = discriminant.fit(x[:, columns], y, classes)
        return weight * np.float32(self.factor), bias * np.float32(self.factor)


@dataclass(frozen=True)
class HeadData:
    """Sweeps that a head is fitted to. features: [N, F], labels [N]; copied: [M, F] of augmented
    copies, and the number [M] of the sweep that each was made of."""

    features: Array
    labels: Array
    copied: Array
    source: Array

    def take(self, kept: Array) -> HeadData:
        """The sweeps `kept` (mask) and their copies."""
        position = np.cumsum(kept) - 1
        also = kept[self.source]
        return HeadData(
            self.features[kept], self.labels[kept], self.copied[also], position[self.source[also]]
        )

    def given(self) -> Given:
        """What heads are fitted to."""
        return self.features, self.labels, self.copied, self.labels[self.source]


@dataclass(frozen=True)
class HeadPlan:
    """The discriminants whose logits are added."""

    parts: tuple[HeadPart, ...]

    def fit(self, given: Given, classes: int) -> tuple[Array, Array]:
        """Weight [K, F] and bias [K], float32. Raises FormatError as discriminant.fit."""
        heads = [part.fit(given, classes) for part in self.parts]
        weight: Array = np.sum([w for w, _ in heads], axis=0)
        bias: Array = np.sum([b for _, b in heads], axis=0)
        return weight, bias

    def cooled(self, temperature: float) -> HeadPlan:
        """The same, its logits divided by `temperature`."""
        return HeadPlan(tuple(replace(p, factor=p.factor / temperature) for p in self.parts))

    def uncooled(self) -> HeadPlan:
        """The same with logits as sure as discriminants are by themselves, which is never too
        modest."""
        return self.cooled(max(part.factor for part in self.parts))

    def columns(self) -> Array:
        """Numbers of the features that any of the discriminants sees, ascending."""
        return np.unique(np.concatenate([np.array(part.columns) for part in self.parts]))

    def renumbered(self, kept: Array) -> HeadPlan:
        """The same for a trunk with only the features `kept` (ascending numbers), which include
        `columns`."""
        return HeadPlan(
            tuple(
                replace(p, columns=tuple(np.searchsorted(kept, p.columns).tolist()))
                for p in self.parts
            )
        )

    def json(self) -> list[dict[str, Any]]:
        """For a fit's record."""
        return [asdict(part) for part in self.parts]

    @classmethod
    def read(cls, entries: Sequence[dict[str, Any]]) -> Self:
        """What `json` gave."""
        return cls(
            tuple(HeadPart(**entry | {"columns": tuple(entry["columns"])}) for entry in entries)
        )
