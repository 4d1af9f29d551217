"""Detection of unknown materials: an embedding of features, and the limit of its distances.

The embedding is shrinkage LDA in another form: a linear map of the features after which the sweeps
of every material scatter around its mean with covariance 1. The nearest mean gives the material, as
in LDA, and a sweep far from all means is of an unknown material. The box needs only this map and
the means.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.unknown import Classes, shaped_distances
from palpate.core.errors import FormatError
from palpate_train.answer.heads import shrinkage
from palpate_train.metrics import tolerances
from palpate_train.onnx_tools.graph_builder import sixteen_bits

Array = NDArray[Any]
PARTS = 10
"""Largest number of parts of the groups; each part is judged by a fit to the others."""
FEW_SHARE = 1.5
"""Least shrinkage of the scatter of n sweeps of a material, times n - 1. By Ledoit and Wolf's
formula two sweeps have no noise, so without this every new sweep would lie infinitely far away."""
NOTHING = np.empty((0, 0))
FLAT = 1e-9
"""Least variance of a direction, relative to that of the widest direction: a silent channel stays
finite."""


@dataclass(frozen=True, eq=False)
class Embedding:
    """z = features @ projection + offset. offset: float32 [r]; means: float32 [K, r], of each
    label.

    The projection [F, r] is kept in two factors, because most of it only selects features:
    directions [F, d] and the last F' features themselves, side by side, times turn [d + F', r]. F'
    is 0 if two factors would not be smaller.

    The sweeps of all materials have the identity as covariance in z (Mahalanobis distance; Lee et
    al. 2018). shapes: float16 [K, b, b], the scatter of each material's own sweeps in the last b
    directions; see the box's shaped_distances.
    """

    directions: Array
    turn: Array
    offset: Array
    means: Array
    shapes: Array

    @property
    def selected(self) -> int:
        """Number of features, the last ones, that `turn` takes as they are."""
        return int(self.turn.shape[0] - self.directions.shape[1])

    @cached_property
    def projection(self) -> Array:
        """float32 [F, r]."""
        turn, rest = np.split(self.turn.astype(np.float64), [self.directions.shape[1]])
        product = self.directions @ turn
        product[len(product) - len(rest) :] += rest
        return product.astype(np.float32)

    @cached_property
    def untrained(self) -> Array:
        """[r, b], multiplies differences of z to give differences of the features that `turn` takes
        as they are; the identity if it takes none."""
        r = len(self.offset)
        if not self.selected:
            return np.eye(r)
        view: Array = np.linalg.inv(self.turn.astype(np.float64))[:, r - self.selected :]
        return view

    @property
    def beyond(self) -> Array:
        """Orthonormal directions [r, J] towards things that are of no material."""
        r, trained = len(self.offset), len(self.means) - 1
        every = self.shapes.shape[1] and not self.selected
        return np.eye(r)[:, trained : trained if every else r - self.selected]

    def __call__(self, features: Array) -> Array:
        """Features [..., F] -> z, float64 [..., r]."""
        if features.ndim > 2:  # in float64, prefixes of all sweeps would not fit into memory
            return np.stack([self(one) for one in features])
        z: Array = np.asarray(features, np.float64) @ self.projection + self.offset
        return z

    def classes(self) -> Classes:
        """The means as a bundle holds them; each counts as trained."""
        bias, k = -(self.means.astype(np.float64) ** 2).sum(1) / 2, len(self.means)
        return Classes(
            self.means,
            bias.astype(np.float32),
            np.zeros(k, np.int64),
            np.ones(k, np.float32),
            self.shapes,
        )

    def novelty(self, features: Array) -> Array:
        """Squared distance [...] of features [..., F] to the nearest mean, with the scatter of each
        material. The limit is a limit of this."""
        away = self(features)[..., None, :] - self.means.astype(np.float64)
        nearest: Array = shaped_distances(away, self.shapes.astype(np.float64)).min(axis=-1)
        return nearest

    def logits(self, features: Array) -> Array:
        """Features [..., F] -> logits [..., K] of LDA with equal priors, up to a term that all
        labels share."""
        means = self.means.astype(np.float64)
        logits: Array = self(features) @ means.T - (means**2).sum(1) / 2
        return logits


def embed(features: Array, labels: Array, fixed: int = 0, beyond: Array = NOTHING) -> Embedding:
    """The Embedding of training features [N, F] with labels [N] from 0 to K - 1, in r = min(K - 1 +
    J + fixed, F) directions. beyond: mean features [J, F] of things that are of no material.

    The covariance is Ledoit and Wolf's, as in heads.fit_discriminant. The first K - 1
    directions hold everything that LDA uses. The next J lead from the materials to `beyond`. More
    are added until they contain the last `fixed` features, which were not trained (see
    spectrum.py): trained materials do not differ there, but an unknown one may. In these directions
    each material has its own shape.

    Raises FormatError if there is one material, if a label is missing, or if each material has only
    one sweep.
    """
    labels = np.asarray(labels)
    if len(missing := np.setdiff1d(np.arange(labels.max(initial=0) + 1), labels)):
        raise FormatError(
            f"no sweep has the label {missing[0]}; number the materials that occur from 0 on"
        )
    if (classes := int(labels.max(initial=0)) + 1) < 2:
        raise FormatError("all sweeps are of one material; a classifier needs two")
    if len(labels) <= classes:
        raise FormatError(
            f"{len(labels)} sweeps of {classes} materials say nothing of how they vary; record more"
        )
    x = np.asarray(features, np.float64)
    middle, size = x.mean(axis=0), x.shape[1]
    means = np.stack([x[labels == k].mean(axis=0) for k in range(classes)]) - middle
    covariance = _covariance(x, labels)
    axes = covariance.orthonormal(_apart(covariance, means - means.mean(axis=0), classes - 1))
    if (room := min(len(beyond), size - fixed - classes)) > 0:
        others = beyond - middle - means.mean(axis=0)
        others -= others @ axes @ covariance.times(axes).T
        more = np.hstack([axes, _apart(covariance, others, room)])
        axes = covariance.orthonormal(more)
    last = np.arange(max(size - fixed, axes.shape[1]), size)
    both = np.hstack([axes, np.eye(size)[:, last]])
    turn = covariance.turn(both)
    if fixed and both.shape[1] < size:
        directions = axes
    else:
        directions, turn = both @ turn, np.eye(both.shape[1])
    # rounded as the graph of a bundle holds them
    (whole, steps), (turn, sizes) = sixteen_bits(directions), sixteen_bits(turn)
    bare = Embedding(whole * steps, turn * sizes, *[np.empty(0)] * 3)
    projection = bare.projection
    means = (means @ projection).astype(np.float32)
    own = min(fixed, projection.shape[1])
    away = ((x - middle) @ projection - means[labels])[:, projection.shape[1] - own :]
    shapes = np.stack([_shape(away[labels == k]) for k in range(classes)])
    return replace(
        bare, offset=(-middle @ projection).astype(np.float32), means=means, shapes=shapes
    )


def in_two_views(
    features: Array, labels: Array, fixed: int = 0, beyond: Array = NOTHING
) -> Embedding:
    """As `embed`, with distances that are the sum of two: in the features that were not trained,
    and in the directions in which the means differ, or `beyond` from them. Which of them shows an
    unknown material depends on the skin (docs/decisions/0005). In both, each material has its own
    scatter, and the sweeps lie at r from their mean on average. Without untrained features it is
    `embed`."""
    z = embed(features, labels, fixed, beyond)
    if not z.shapes.shape[1]:
        return z
    away = z(features) - z.means[labels]
    each = [away[labels == k] for k in range(len(z.means))]
    return replace(z, shapes=_in_both(each, z.means, z).astype(np.float16))


def _in_both(each: Sequence[Array], means: Array, of: Embedding) -> Array:
    """The shapes [K, r, r] of `in_two_views` for differences from the means [K, r], [n, r] of each
    material."""
    own = np.stack([own_scatter(sweeps) for sweeps in each])
    trained = np.hstack([differing(means), of.beyond])
    shapes = shapes_of(within(own, of.untrained) + within(own, trained))
    total = sum(float(((x @ w) ** 2).sum()) for x, w in zip(each, shapes, strict=True))
    scaled: Array = np.sqrt(sum(x.size for x in each) / max(total, FLAT)) * shapes
    return scaled


def shapes_without(embedding: Embedding, z: Array, labels: Array) -> Callable[[int], Array]:
    """Gives the shapes [K - 1, r, r] of `in_two_views` without a material k. z: embeddings [n, r]
    of the sweeps that the embedding was fitted to; labels: int [n]."""
    means = embedding.means.astype(np.float64)
    each = [z[labels == k] - mean for k, mean in enumerate(means)]

    def without(k: int) -> Array:
        others = np.delete(means, k, axis=0)
        if embedding.shapes.shape[1]:
            rest = [of for number, of in enumerate(each) if number != k]
            return _in_both(rest, others, embedding)
        view = np.hstack([differing(others), embedding.beyond])
        return np.broadcast_to(view @ view.T, (len(others), *view.T.shape[1:] * 2))

    return without


def differing(means: Array) -> Array:
    """Orthonormal directions [r, K - 1] in which class means [K, r] differ."""
    rows = np.linalg.svd(means - means.mean(axis=0), full_matrices=False)[2]
    directions: Array = rows[: len(means) - 1].T
    return directions


def within(covariances: Array, view: Array) -> Array:
    """M [K, r, r], so that away @ M @ away is the squared Mahalanobis distance of a difference in
    the directions `view` [r, b], by covariances [K, r, r]."""
    seen = view.T @ covariances @ view
    size = max(seen.shape[1], 1)
    flat = FLAT * np.trace(seen, axis1=1, axis2=2)[:, None, None] / size
    squares: Array = view @ np.linalg.inv(seen + flat * np.eye(seen.shape[1])) @ view.T
    return squares


def shapes_of(squares: Array) -> Array:
    """W [K, r, r] with W W' = M, for the matrices M [K, r, r] of `within` or sums of them."""
    variances, vectors = np.linalg.eigh(squares)
    shapes: Array = vectors * np.sqrt(np.maximum(variances, 0))[:, None]
    return shapes


def own_scatter(away: Array) -> Array:
    """The covariance of differences [n, r] from a mean, pulled towards 1, the covariance of all
    materials, as if r more sweeps had it (regularized discriminant analysis; Friedman 1989)."""
    n, r = away.shape
    covariance: Array = (away.T @ away + r * np.eye(r)) / (n + r)
    return covariance


def _shape(away: Array) -> Array:
    """W float16 [b, b], so that |away @ W|^2 is the Mahalanobis distance of differences `away` [n,
    b] from a class mean, by their own scatter."""
    shape: Array = np.linalg.cholesky(np.linalg.inv(own_scatter(away))).astype(np.float16)
    return shape


@dataclass(frozen=True, eq=False)
class _Covariance:
    """C = diagonal + rows' rows [F, F], the covariance within materials, with `rows` [n, F]. No
    matrix of the size [F, F] is computed if there are fewer sweeps."""

    diagonal: Array
    rows: Array

    def times(self, b: Array) -> Array:
        """C times `b` [F, m]."""
        product: Array = self.diagonal[:, None] * b + self.rows.T @ (self.rows @ b)
        return product

    def solved(self, b: Array) -> Array:
        """The inverse of C times `b` [F, m] (Woodbury's identity)."""
        root = np.sqrt(self.diagonal)
        scaled, b = self.rows / root, b / root[:, None]
        if (n := len(scaled)) < len(root):
            inner = np.linalg.solve(np.eye(n) + scaled @ scaled.T, scaled @ b)
            x = b - scaled.T @ inner
        else:
            x = np.linalg.solve(np.eye(len(root)) + scaled.T @ scaled, b)
        solution: Array = x / root[:, None]
        return solution

    def turn(self, b: Array) -> Array:
        """The upper matrix T [m, m] so that b @ T has the covariance 1, for `b` [F, m]."""
        upper: Array = np.linalg.inv(np.linalg.cholesky(b.T @ self.times(b))).T
        return upper

    def orthonormal(self, b: Array) -> Array:
        """Directions [F, m] with the covariance 1 in which lies the same as in `b` [F, m]."""
        return b @ self.turn(b)


def _apart(covariance: _Covariance, means: Array, most: int) -> Array:
    """The directions [F, m] in which `means` [K, F] are farthest from 0 for their scatter, at
    `most`. Where means coincide, any directions take the place of the others."""
    size = means.shape[1]
    solved = covariance.solved(means.T)
    squares, vectors = np.linalg.eigh(means @ solved)
    most = min(most, size)
    seen = np.flatnonzero(squares > FLAT * max(float(squares.max()), FLAT))[::-1][:most]
    directions = solved @ (vectors[:, seen] / np.sqrt(squares[seen]))
    others = np.random.default_rng(0).standard_normal((size, most - len(seen)))
    return np.hstack([directions, others / np.sqrt(covariance.diagonal)[:, None]])


def _covariance(x: Array, labels: Array) -> _Covariance:
    """The covariance of LinearDiscriminantAnalysis(shrinkage="auto"): Ledoit and Wolf's covariance
    of each material's features [n, F] at the same spread, averaged by the number of sweeps. Few
    sweeps are shrunk by FEW_SHARE at least."""
    diagonal, rows = np.zeros(x.shape[1]), []
    for label in np.unique(labels):
        own = x[labels == label]
        away, spread = centred(own)
        z = away / spread
        share, mean = shrinkage(z, z @ z.T if len(z) < len(spread) else z.T @ z)
        share = max(share, min(1.0, FEW_SHARE / max(len(z) - 1, 1)))
        diagonal += len(own) / len(x) * share * mean * spread**2
        rows.append(np.sqrt((1 - share) / len(x)) * away)
    diagonal = np.maximum(diagonal, max(FLAT * float(diagonal.max()), FLAT))
    return _Covariance(diagonal, np.concatenate(rows))


def centred(x: Array) -> tuple[Array, Array]:
    """Differences [n, F] of features [n, F] from their means, and their spread [F]; 1 for a
    constant feature."""
    spread = x.std(axis=0)
    spread[spread <= 10 * np.finfo(float).eps * np.abs(x).max(axis=0)] = 1
    return x - x.mean(axis=0), spread


def parts(groups: Array, judged: Array, most: int = PARTS) -> Iterator[tuple[Array, Array]]:
    """Pairs (bool [N] to fit to, numbers of the sweeps to judge the fit by).

    Each sweep of `judged` (bool [N]) judges once, a fit that did not see its group. groups: int
    [N], divided into `most` parts at most. Raises FormatError if there is only one group.
    """
    values = np.unique(groups[judged])
    if len(np.unique(groups)) < 2:
        raise FormatError(
            "all sweeps are of one group; what judges must not be trained on; record a second "
            "position"
        )
    part_of = np.full(len(groups), -1)
    judging = np.isin(groups, values)
    part_of[judging] = np.searchsorted(values, groups[judging]) % min(most, len(values))
    for part in range(min(most, len(values))):
        yield part_of != part, np.flatnonzero((part_of == part) & judged)


JudgingPart = tuple[Array, Array, Embedding, Array]
"""The sweeps to fit to (bool [N]), the numbers of the sweeps that judge, the embedding, and the
labels [K] of its means."""


def cross_fitted(
    features: Array,
    labels: Array,
    groups: Array,
    judged: Array,
    fixed: int = 0,
    beyond: Array = NOTHING,
) -> Iterator[JudgingPart]:
    """A JudgingPart for each of `parts`. Sweeps of a material that occurs in no other part do not
    judge."""
    for fit, numbers in parts(groups, judged):
        present, numbered = np.unique(labels[fit], return_inverse=True)
        embedding = in_two_views(features[fit], numbered, fixed, beyond)
        yield fit, numbers[np.isin(labels[numbers], present)], embedding, present


def limit(novelty: Array, kept: float = tolerances.KEPT) -> float:
    """The limit that keeps `kept` of sweeps like those with this `novelty` [n], which were not
    trained on. NaN is left out.

    It is the ceil((n + 1) * kept)-th smallest, as in split conformal prediction, so that a new
    sweep is kept with at least that probability (Vovk et al. 2005); the largest if n is too small.
    Raises FormatError if only NaN is left.
    """
    novelty = novelty[~np.isnan(novelty)]
    if not (n := len(novelty)):
        raise FormatError(
            "no known sweep is left to find the limit with; record each material in several "
            "positions"
        )
    rank = min(int(np.ceil((n + 1) * kept)), n) - 1
    return float(max(np.sort(novelty)[rank], np.finfo(np.float32).tiny))


def auroc(known: Array, unknown: Array) -> float:
    """The probability that a novelty of `unknown` [m] is above one of `known` [n], with ties
    counted half (Mann and Whitney). Raises FormatError if either is empty."""
    if not len(known) or not len(unknown):
        raise FormatError(
            "no AUROC without sweeps of both kinds; test on known and on unknown ones"
        )
    order = np.sort(known)
    below = np.searchsorted(order, unknown, "left") + np.searchsorted(order, unknown, "right")
    return float(below.mean() / (2 * len(known)))
