"""Types for the checked content of a bundle: manifest, model, golden sweeps, class means, enrolled
labels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle.manifest import Manifest
from palpate.core.types import SweepFormat


@dataclass(frozen=True, slots=True, eq=False)
class DisplacedClasses:
    """The classes for sweeps whose contact is displaced, in a turned embedding in which these
    sweeps have covariance 1.

    turn: float32 [r, r]; embedding @ turn is the turned embedding. means: float32 [K, r]. shapes:
    float16 [K, b, b], see Classes.
    """

    turn: NDArray[np.float32]
    means: NDArray[np.float32]
    shapes: NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class EarlyClasses:
    """The classes after each of D steps of an unfinished sweep. means: float32 [D, K, r]. shapes:
    float16 [D, r, r] of all materials together, see Classes."""

    means: NDArray[np.float32]
    shapes: NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class Classes:
    """Content of means.npz: the class means in the embedding, in the order of the labels.

    means: float32 [K, r].
    bias: float32 [K], added to the product of mean and embedding.
    sweeps: int64 [K], number of sweeps that a label was enrolled from; 0 for a trained label.
    spread: float32 [K], variance of the label's sweeps per direction of the embedding; 1 for a
        trained label.
    shapes: float16 [K, b, b], scatter of the label's sweeps in the last b directions of the
        embedding: a difference from the mean is multiplied by this matrix before it is squared. The
        identity for an enrolled label.
    displaced: the same for sweeps whose contact is displaced, None if the manifest has no rule for
        these.
    early: of unfinished sweeps, None if the manifest has no limits for these.
    changes: float16 [D, K0, r], change of a mean in the embedding by a disturbance of size 1, for
        each of the manifest's allowances and each trained label; D = 0 if the file has no such
        array.
    """

    means: NDArray[np.float32]
    bias: NDArray[np.float32]
    sweeps: NDArray[np.int64]
    spread: NDArray[np.float32]
    shapes: NDArray[np.float16]
    displaced: DisplacedClasses | None = None
    early: EarlyClasses | None = None
    changes: NDArray[np.float16] = field(default_factory=lambda: np.zeros((0, 0, 0), np.float16))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of means.npz by name: of `displaced` displaced_*, of `early` early_*."""
        parts = {"displaced": self.displaced, "early": self.early}
        own = ("means", "bias", "sweeps", "spread", "shapes")
        arrays = {name: getattr(self, name) for name in own} | {
            f"{prefix}_{name}": getattr(part, name)
            for prefix, part in parts.items()
            if part
            for name in part.__slots__
        }
        return arrays | ({"changes": self.changes} if len(self.changes) else {})


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
    """

    base: str
    labels: tuple[str, ...]
    means: NDArray[np.float32]
    sweeps: NDArray[np.int64]
    spread: NDArray[np.float32]
    golden: NDArray[Any]
    logits: NDArray[np.float32]
    least: float


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """A bundle whose files agree with its manifest.

    id: see `bundle.identity`.
    model: the bytes of model.onnx.
    golden: raw counts [G, T, R, C] or [G, T, R, C, A]; golden_logits: float32 [G, K].
    classes: the class means, None if the manifest has no `known`.
    added: labels that a box has enrolled, None if there are none. Manifest, golden sweeps and
        classes include them.
    base: sha256 of manifest.json in the bundle's folder, "" for a bundle that was not read from a
        folder.
    """

    manifest: Manifest
    id: str
    model: bytes
    golden: NDArray[Any]
    golden_logits: NDArray[np.float32]
    classes: Classes | None = None
    added: AddedLabels | None = None
    base: str = ""

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
