"""Distances of a sweep from the known materials, and whether its material is unknown.

The embedding is scaled so that the sweeps of all materials together have covariance 1 around their
means. A squared distance in it is therefore a squared Mahalanobis distance, and the nearest mean
gives the label. An enrolled material is one more mean; nothing is trained for it.

Without unknown: 769 instead of 747 of 816 altered slides right, 178 instead of 177 of 192 displaced
ones, 115 instead of 52 of 480 junk windows named; 31 us less of 646 (`python -m palpate_studies
rules`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.contact import DisplacementRule
from palpate.answer.disturbance import Disturbances
from palpate.answer.objects import ObjectSweeps
from palpate.answer.pipeline import Context, Refusal
from palpate.core.errors import BundleError
from palpate.core.schema import Positive, Within, check
from palpate.core.status import UNSURE, Reason, Remark
from palpate.core.types import Status

Array = NDArray[np.float64]
KEPT = 16
"""Number of unknown sweeps that are remembered."""
ALIKE = 0.5
"""Largest distance of two sweeps of one unknown material, as a share of the loose limit of known
ones. Of pairs of sweeps of one material 13 to 69 % are within it, of two materials at most 2 %
(simulated skin, four pairs of materials left out). It does not tell two cottons of FabricSlide
apart."""


@dataclass(frozen=True, slots=True)
class Known:
    """Rule for unknown materials. Raises BundleError for a number out of range.

    strict, balanced, loose: largest squared distance from a sweep's embedding to the nearest class
    mean, in rising order; beyond it the material is unknown. The box chooses one of them: a lower
    limit gives fewer unknown materials a label, and fewer known ones theirs. temperature: divisor
    of the logits from class means. enrolled: least probability of all enrolled labels together at
    which a sweep gets one of them; None without enrolled labels.
    """

    strict: Positive
    balanced: Positive
    loose: Positive
    temperature: Positive
    enrolled: Annotated[float, Within(UNSURE, math.nextafter(1, 0))] | None = None

    def __post_init__(self) -> None:
        check(self, "known")
        if not self.strict <= self.balanced <= self.loose:
            raise BundleError(
                f"known has the limits {self.strict:.4g}, {self.balanced:.4g}, {self.loose:.4g}, "
                "which must not fall; export the bundle again"
            )

    def growth(self, strangers: str) -> float:
        """The limit of this name as a multiple of the balanced one. Limits of displaced and of
        unfinished sweeps are balanced, and multiplied by it."""
        return float(getattr(self, strangers)) / self.balanced


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


def shaped_distances(away: NDArray[Any], shapes: NDArray[Any]) -> Array:
    """Squared distances [..., K] of differences `away` [..., K, r] from the class means.

    In the last b directions each material has its own scatter, so the difference is first
    multiplied by the material's matrix of `shapes` [K, b, b]. In the other directions all materials
    have variance 1.
    """
    common = away.shape[-1] - shapes.shape[-1]
    own = np.einsum("...kb,kbc->...kc", away[..., common:], shapes)
    result: Array = (away[..., :common] ** 2).sum(axis=-1) + (own**2).sum(axis=-1)
    return result


def _of_all(changes: Array, labels: int) -> Array:
    """Changes [D, labels, r] of the means of trained labels [D, K0, r] and of the enrolled ones
    after them, which are assumed to change as the trained ones do on average."""
    mean = changes.mean(axis=1, keepdims=True)
    return np.concatenate([changes, mean.repeat(labels - changes.shape[1], axis=1)], axis=1)


def log_softmax(logits: NDArray[Any]) -> Array:
    """Logarithms of the probabilities of logits along the last axis, in float64."""
    z = np.asarray(logits, np.float64)
    result: Array = z - np.logaddexp.reduce(z, axis=-1, keepdims=True)
    return result


class EarlyDistances:
    """Finds unknown materials in unfinished sweeps. limits: [D], largest squared distance of a
    known material at each step."""

    def __init__(self, classes: EarlyClasses, limits: Sequence[float]) -> None:
        self._means, self._shapes = (
            part.astype(np.float64) for part in (classes.means, classes.shapes)
        )
        self._limits = np.array(limits)

    def known(self, z: NDArray[Any]) -> NDArray[np.bool_]:
        """Whether the material is known at each of the first d steps, bool [d]. z: embeddings
        [d, r] after these steps."""
        known: NDArray[np.bool_] = self.nearest(z) <= self._limits[: len(z)]
        return known

    def nearest(self, z: NDArray[Any]) -> Array:
        """Squared distances float64 [d] to the nearest material, see `known`."""
        d = len(z)
        away = (z[:, None] - self._means[:d]) @ self._shapes[:d]  # [d, K, r]
        nearest: Array = (away**2).sum(axis=2).min(axis=1)
        return nearest


class ClassDistances:
    """Computes distances and logits from a bundle's class means. labels: of the means, [K].
    strangers: the limit of `known` that applies. strict, loose: these, for the same embedding.

    displacement: rule for sweeps whose contact is displaced. The distances are then computed in
    `classes.displaced`, where directions that a displacement changes have little weight, and all
    logits are divided by its temperature. disturbances: the allowances for them.
    """

    def __init__(
        self,
        classes: Classes,
        known: Known,
        labels: Sequence[str],
        displacement: DisplacementRule | None = None,
        disturbances: Disturbances | None = None,
        strangers: str = "balanced",
    ) -> None:
        self._disturbances = disturbances or Disturbances()
        self.labels, self.limit, self._temperature = labels, known.balanced, known.temperature
        self._means, self._turn = classes.means.astype(np.float64), np.eye(classes.means.shape[1])
        # the rest of the bias, since the squared distance already contains -|m|^2 / 2; logits that
        # are computed from distances do not suffer from the cancellation of large products
        self._extra = classes.bias + (self._means**2).sum(axis=1) / 2
        self._enrolled = bool((classes.sweeps > 0).any())
        self._softening = displacement.temperature if displacement else 1
        shapes = classes.shapes
        if displacement and classes.displaced:
            self.limit, shapes = displacement.limit, classes.displaced.shapes
            self._means, self._turn = (
                classes.displaced.means.astype(np.float64),
                classes.displaced.turn.astype(np.float64),
            )
        self.strict, self.loose, self.limit = (
            self.limit * known.growth(name) for name in ("strict", "loose", strangers)
        )
        self._shapes = shapes.astype(np.float64)
        n = classes.sweeps
        # a mean of n sweeps has variance 1 / n in every direction: another sweep has variance 1 + 1
        # / n around it
        self._share = np.where(n, n / (n + 1), 1.0) / classes.spread
        changes = classes.changes.astype(np.float64)
        changes = _of_all(changes, len(n)) @ self._turn if len(changes) else changes
        changes = changes.reshape(len(changes), *self._means.shape)
        self._novel = tuple(map(self._scattered, (self._turn[:, None], self._means[None], changes)))

    def _scattered(self, away: Array) -> NDArray[np.float32]:
        """Differences [n, K, r], or [n, 1, r] from all means, in the scatter of each label, [n, K *
        r]: the sum of squares is the distance that is compared with the limit."""
        away = np.broadcast_to(away, (len(away), *self._means.shape)).copy()
        common = away.shape[2] - self._shapes.shape[2]
        away[..., common:] = np.einsum("nkb,kbc->nkc", away[..., common:], self._shapes)
        away *= np.sqrt(self._share)[:, None]
        return away.reshape(len(away), self._means.size).astype(np.float32)

    def distances(self, embedding: NDArray[Any]) -> Array:
        """Squared distances float64 [..., K] from embeddings [..., r] to the class means; no unit.

        The scatter is that of all materials together, so the nearest mean is the result of LDA.
        """
        away: Array = (embedding @ self._turn)[..., None, :] - self._means
        return np.asarray((away**2).sum(axis=-1))

    def logits(self, distances: Array) -> NDArray[np.float32]:
        """Logits [..., K] from `distances` [..., K], up to a term that is the same for all
        labels."""
        result: NDArray[np.float32] = ((self._extra - distances / 2) / self._temperature).astype(
            np.float32
        )
        return result

    def joined(self, network: NDArray[Any], embedding: NDArray[Any]) -> NDArray[np.float32]:
        """Logits float32 [..., K] of all labels of a bundle.

        network: [..., K0], logits of the K0 trained labels, which come first. embedding: [..., r].
        Without enrolled labels these are the network's own. With them, the distances give the
        probability of each enrolled label and that of all trained labels together; the network
        divides the latter among them.
        """
        softened = np.asarray(network / self._softening, np.float32)
        if not self._enrolled:
            return softened
        by_means = np.asarray(self.logits(self.distances(embedding)) / self._softening, np.float32)
        n, logs = network.shape[-1], log_softmax(by_means)
        trained = np.logaddexp.reduce(logs[..., :n], axis=-1, keepdims=True)
        logits = np.concatenate([trained + log_softmax(softened), logs[..., n:]], axis=-1)
        return np.asarray(logits, np.float32)

    def measured(
        self, embedding: NDArray[Any], disturbed: Mapping[str, float]
    ) -> tuple[NDArray[np.float32], float]:
        """Squared distances [K] to the labels, and the limit that they are compared with.

        embedding: [r]. disturbed: values of the sweep's disturbances by name. Each material has
        its own scatter. The embedding was optimised for trained labels, so the distance to an
        enrolled label is multiplied by n / (n + 1) / spread. About the same share of sweeps is
        then accepted for both.
        """
        (turned, means, changes), limit = self._novel, self.limit
        away = embedding.dot(turned) - means[0]
        sizes = self._disturbances.sizes(disturbed)
        if any(sizes):
            away -= np.array(sizes, np.float32).dot(changes)
            limit *= self._disturbances.growth(sizes)
        away = away.reshape(len(self.labels), -1)
        return np.vecdot(away, away), limit

    def apart(self, embedding: NDArray[Any], others: NDArray[Any]) -> Array:
        """Half of the squared distance [n] of an embedding [r] from others [n, r], with the mean
        scatter of all materials. Two sweeps of one material lie as far apart in this measure as
        one of them from its mean."""
        away = ((others - embedding) @ self._turn)[:, None, :]
        distances: Array = shaped_distances(away, self._shapes).mean(axis=-1) / 2
        return distances

    def closest_pair(self) -> tuple[float, str, str]:
        """The squared distance between the two closest class means, and their labels."""
        away = self._means[:, None] - self._means
        between = (away**2).sum(axis=-1) + np.diag(np.full(len(away), np.inf))
        first, second = divmod(int(between.argmin()), len(between))
        return float(between[first, second]), self.labels[first], self.labels[second]


class KnownMaterial:
    """Refuses a sweep that is too far from every known material; joins the logits of the network
    with the logits of the enrolled labels.

    displaced: for sweeps whose contact is displaced, None without a rule for them. Neither a
    displacement nor a disturbance makes a material unknown. Between the strict and the loose limit
    a sweep is doubtful: two of an object are judged together. The latest sweeps of unknown
    materials are kept, to notice a material that comes again.
    """

    def __init__(
        self, means: ClassDistances, displaced: ClassDistances | None, objects: ObjectSweeps
    ) -> None:
        self._means, self._displaced, self._objects = means, displaced, objects
        self._unknown: deque[tuple[int, NDArray[Any]]] = deque(maxlen=KEPT)

    def apply(self, context: Context) -> Refusal | None:
        """Refuse an unknown material."""
        off = context.displacement.off and self._displaced is not None
        means = self._displaced if off and self._displaced else self._means
        z = context.embedding
        context.logits = means.joined(context.logits, z)
        far, limit = means.measured(z, context.disturbed)
        k = int(far.argmin())
        if not off:
            context.far, share = np.log1p(far / means.limit), limit / means.limit
            doubtful = means.strict * share < far[k] <= means.loose * share
            numbers = doubtful and np.isfinite(context.logits).all()
            if numbers and self._objects.fuses(context.sweep):
                context.doubtful = np.log1p(far / limit)
                if (both := self._objects.joined(context)) is not None:
                    far = (np.expm1(both) * limit).astype(np.float32)
                    k = int(far.argmin())
        if far[k] <= limit:
            return None
        if len(context.doubtful):
            self._objects.doubted(context)
        novelty = {"distance": float(far[k]), "label": means.labels[k], "limit": limit}
        # a golden sweep has no number, and nobody touched it
        if not off and context.sweep.id and (alike := self._keep(context.sweep.id, z)):
            again = Remark(Reason.UNLIKE_ALL_AGAIN, novelty | {"sweep": alike})
            return Refusal(Status.UNKNOWN, again)
        return Refusal(Status.UNKNOWN, Remark(Reason.UNLIKE_ALL, novelty))

    def _keep(self, sweep: int, embedding: NDArray[Any]) -> int:
        """Keep the embedding [r] of the sweep with this number. The number of the sweep before it
        that is most alike, 0 if none is nearly as alike as two sweeps of one material."""
        alike = 0
        if self._unknown:
            numbers, others = zip(*self._unknown, strict=True)
            apart = self._means.apart(embedding, np.stack(others))
            nearest = int(apart.argmin())
            if apart[nearest] <= ALIKE * self._means.loose:
                alike = numbers[nearest]
        self._unknown.append((sweep, embedding))
        return alike
