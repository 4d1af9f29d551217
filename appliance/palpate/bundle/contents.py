"""Types for the checked content of a bundle: manifest, model, golden sweeps, class means, enrolled
labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.unknown import Classes
from palpate.bundle.manifest import Manifest
from palpate.core.types import Status, SweepFormat

_LISTS = ("means", "sweeps", "spread", "golden")


@dataclass(frozen=True, slots=True, eq=False)
class AddedLabels:
    """Content of enrolment.npz: the labels that a box has enrolled into a bundle, in the order of
    enrolment.

    base: sha256 of the bundle's manifest, hexadecimal.
    labels: [n].
    means: float32 [n, r], of each label's sweeps in the embedding.
    sweeps: int64 [n], number of each label's sweeps.
    spread: float32 [n], as in Classes.
    golden: raw counts [n, T, R, C] or [n, T, R, C, A], one sweep of each label.
    logits: float32 [G + n, K + n] of the bundle's G golden sweeps followed by `golden`, for the
        bundle's K labels followed by `labels`.
    least: as Known.enrolled.
    displays: [n], names of the labels for people; "" shows the label.
    """

    base: str
    labels: tuple[str, ...]
    means: NDArray[np.float32]
    sweeps: NDArray[np.int64]
    spread: NDArray[np.float32]
    golden: NDArray[Any]
    logits: NDArray[np.float32]
    least: float
    displays: tuple[str, ...]

    def only(self, kept: Sequence[int]) -> AddedLabels:
        """The labels with these indices; the logits of all labels stay."""
        lists: dict[str, Any] = {name: getattr(self, name)[kept] for name in _LISTS}
        labels, displays = (tuple(of[k] for k in kept) for of in (self.labels, self.displays))
        return replace(self, labels=labels, displays=displays, **lists)

    def plus(self, other: AddedLabels) -> AddedLabels:
        """These labels and the labels of `other`, with the logits and the rule of `other`."""
        lists: dict[str, Any] = {
            name: np.concatenate([getattr(one, name) for one in (self, other)]) for name in _LISTS
        }
        labels, displays = self.labels + other.labels, self.displays + other.displays
        return replace(other, labels=labels, displays=displays, **lists)


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """A bundle whose files agree with its manifest.

    id: see `bundle.identity`.
    model: the bytes of model.onnx.
    golden: raw counts [G, T, R, C] or [G, T, R, C, A]; golden_logits: float32 [G, K];
        golden_refusals: the status of each, ok for one with a label; () if export refused none.
    classes: the class means, None if the manifest has no `known`.
    added: labels that a box has enrolled, None if there are none. Manifest, golden sweeps and
        classes include them.
    base: sha256 of manifest.json in the bundle's folder, "" for a bundle that was not read from a
        folder.
    before: the bundle without the added labels, None without such labels.
    """

    manifest: Manifest
    id: str
    model: bytes
    golden: NDArray[Any]
    golden_logits: NDArray[np.float32]
    classes: Classes | None = None
    added: AddedLabels | None = None
    base: str = ""
    golden_refusals: tuple[Status, ...] = ()
    before: Bundle | None = None

    @property
    def enrolled(self) -> dict[str, int]:
        """The labels that were enrolled, with the number of sweeps each was enrolled from."""
        if self.classes is None:
            return {}
        return {
            label: int(n)
            for label, n in zip(self.manifest.labels, self.classes.sweeps, strict=True)
            if n
        }

    @property
    def format(self) -> SweepFormat:
        """The sweep format that the model was trained for."""
        return self.manifest.format
