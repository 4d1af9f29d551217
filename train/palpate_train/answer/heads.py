"""Heads in closed form: linear discriminants with shrinkage, and sums of them.

A discriminant assumes that the sweeps of every material scatter alike around its mean, and that
materials are equally probable. The covariance is that of Ledoit and Wolf (2004), of features that
are scaled to the same scatter. If there are fewer sweeps than features, the equations are solved
among the sweeps (Woodbury's identity): the same solution, many times as fast.

Sweeps under a value of a condition that training lacks, such as a new force, scatter further than
training sweeps. How the known values differ within a material shows how far: their differences
count as in a prediction for one more value.

A plan adds the logits of a few discriminants, each of some of the features. Several discriminants
that were fitted apart classify sweeps of a new condition better than a single one of all features,
and together they are still one matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError

Array = NDArray[Any]
ABSENT = -1e4
"""Logit of a material without a sweep."""
LEAST_SHRINKAGE = 1e-4
"""Least shrinkage: even if the scatter is known well, equations with equal features need a
solution."""
BATCH = 512
"""Number of features, or of sweeps, of which temporary results are held at a time."""


@dataclass(frozen=True)
class HeadPart:
    """One discriminant. columns: numbers of the features that it sees. copies: whether it sees
    augmented copies of the sweeps too. factor: of its logits; temperatures are in it. weight: the
    size of its logits, relative to other discriminants."""

    columns: tuple[int, ...]
    copies: bool
    factor: float = 1.0
    weight: float = 1.0

    def fit(self, data: HeadData, classes: int) -> tuple[Array, Array]:
        """Weight [K, F] over all features, and bias [K]; see fit_discriminant."""
        columns, y, under = np.array(self.columns), data.labels, data.conditions
        counts = data.weights
        weight = np.zeros((classes, data.features.shape[1]), np.float32)
        seen = data.features[:, columns]
        if self.copies:
            seen = np.concatenate([seen, data.copied[:, columns]])
            y, under = np.append(y, y[data.source]), np.concatenate([under, under[data.source]])
            counts = None if counts is None else np.append(counts, counts[data.source])
        weight[:, columns], bias = fit_discriminant(seen, y, classes, under, counts)
        return weight * np.float32(self.factor), bias * np.float32(self.factor)


@dataclass(frozen=True, eq=False)
class HeadData:
    """Sweeps that a head is fitted to. features: [N, F], labels [N]. of_copies: gives the features
    [M, F] of augmented copies, called when a head first sees them; source: the number [M] of the
    sweep of each copy. conditions: int [N, C], the value of each condition that can be new in
    service. weights: [N], how much each sweep counts with its copies; None if all count alike."""

    features: Array
    labels: Array
    of_copies: Callable[[], Array]
    source: Array
    conditions: Array
    weights: Array | None = None

    @cached_property
    def copied(self) -> Array:
        """Features [M, F] of augmented copies."""
        return self.of_copies()

    @property
    def drawn(self) -> bool:
        """Whether a head has seen copies."""
        return "copied" in vars(self)

    def take(self, kept: Array) -> HeadData:
        """The sweeps `kept` (mask) and their copies."""
        position = np.cumsum(kept) - 1
        also = kept[self.source]
        return HeadData(
            self.features[kept],
            self.labels[kept],
            lambda: self.copied[also],
            position[self.source[also]],
            self.conditions[kept],
            None if self.weights is None else self.weights[kept],
        )

    def seen(self, columns: Array) -> HeadData:
        """The features of these numbers alone."""
        seen = self.features[:, columns]
        return replace(self, features=seen, of_copies=lambda: self.copied[:, columns])

    def beside(self, other: HeadData) -> HeadData:
        """These features, then the features of `other`, for the same sweeps and copies."""
        features = np.hstack([self.features, other.features])
        of_both = lambda: np.hstack([self.copied, other.copied])  # noqa: E731
        return replace(self, features=features, of_copies=of_both)


def condition_values(groups: Mapping[str, Array], count: int) -> Array:
    """int [count, C], the values of `groups` as numbers. Recordings are left out: a user does not
    vary them."""
    found = [
        np.unique(values, return_inverse=True)[1]
        for name, values in groups.items()
        if name != "recording"
    ]
    return np.stack(found, axis=1) if found else np.empty((count, 0), int)


@dataclass(frozen=True)
class HeadPlan:
    """The discriminants whose logits are added."""

    parts: tuple[HeadPart, ...]

    def fit(self, data: HeadData, classes: int) -> tuple[Array, Array]:
        """Weight [K, F] and bias [K], float32. Raises FormatError as fit_discriminant."""
        heads = [part.fit(data, classes) for part in self.parts]
        weight: Array = np.sum([w for w, _ in heads], axis=0)
        bias: Array = np.sum([b for _, b in heads], axis=0)
        return weight, bias

    def cooled(self, temperature: float) -> HeadPlan:
        """The same plan with logits divided by `temperature`."""
        return HeadPlan(tuple(replace(p, factor=p.factor / temperature) for p in self.parts))

    def uncooled(self) -> HeadPlan:
        """The same plan with the logits of plain discriminants, whose probabilities are never too
        low."""
        return self.cooled(max(part.factor for part in self.parts))

    def columns(self) -> Array:
        """Numbers of the features that a discriminant sees, ascending."""
        return np.unique(np.concatenate([np.array(part.columns) for part in self.parts]))

    def renumbered(self, kept: Array) -> HeadPlan:
        """The same plan for a trunk with only the features `kept` (ascending numbers), which
        include `columns`."""
        return HeadPlan(
            tuple(
                replace(p, columns=tuple(np.searchsorted(kept, p.columns).tolist()))
                for p in self.parts
            )
        )

    def json(self) -> list[dict[str, Any]]:
        """The entry in the file of a fit."""
        return [asdict(part) for part in self.parts]

    @classmethod
    def read(cls, entries: Sequence[dict[str, Any]]) -> Self:
        """The plan that gave these `entries`."""
        return cls(
            tuple(HeadPart(**entry | {"columns": tuple(entry["columns"])}) for entry in entries)
        )


def fit_discriminant(
    features: Array,
    labels: Array,
    classes: int,
    conditions: Array | None = None,
    weights: Array | None = None,
) -> tuple[Array, Array]:
    """Weight [K, F] and bias [K], float32, from features [N, F] of sweeps with labels [N] below
    `classes`.

    conditions: int [N, C], the value of each condition; how the values differ widens the scatter to
    what one more value is expected to add. weights: [N], how much each sweep counts for the means
    and the scatter; a sweep that counts 0 is left out. The logits of a material without a sweep are
    ABSENT.
    Raises FormatError if there is only one sweep of each material, which does not show how
    materials vary.
    """
    if weights is not None and not weights.all():
        kept = weights > 0
        under = None if conditions is None else conditions[kept]
        return fit_discriminant(features[kept], labels[kept], classes, under, weights[kept])
    present, member = np.unique(labels, return_inverse=True)
    x = np.array(features, np.float64)
    if len(x) <= len(present):
        raise FormatError(
            f"{len(x)} sweeps of as many materials are too few for a linear discriminant; record "
            "more"
        )
    means = _centre(x, member, weights)
    columns = range(0, x.shape[1], BATCH)
    spread = np.concatenate([x[:, first : first + BATCH].std(axis=0) for first in columns])
    spread = np.maximum(spread, max(1e-6 * float(spread.max(initial=0)), 1e-12))
    middle = means.mean(axis=0)
    wanted = (means - middle) / spread
    x /= spread
    more = np.empty((0, x.shape[1])) if conditions is None else _differences(x, member, conditions)
    solved = _solve(x, more, wanted)
    weight, bias = np.zeros((classes, len(spread))), np.full(classes, ABSENT)
    centred = solved - solved.mean(axis=0)  # then the largest logit is above ABSENT
    sizes = 0.5 * (wanted * solved).sum(axis=1)
    weight[present] = centred / spread
    bias[present] = sizes.mean() - sizes - weight[present] @ middle
    return weight.astype(np.float32), bias.astype(np.float32)


def _centre(x: Array, member: Array, weights: Array | None) -> Array:
    """Means [K, F] of the rows of `x` [N, F] of each label; subtracts them, and scales each row so
    that its square counts by its weight. In place: features of many sweeps fill the memory."""
    counts = np.ones(len(x)) if weights is None else weights / weights.mean()
    means = []
    for k in range(int(member.max()) + 1):
        of = member == k
        own = x[of]
        means.append(own.mean(axis=0) if weights is None else counts[of] @ own / counts[of].sum())
        x[of] = own - means[-1]
    if weights is not None:
        x *= np.sqrt(counts)[:, None]
    return np.stack(means)


def _differences(z: Array, labels: Array, conditions: Array) -> Array:
    """Rows [M, F] whose squares, added to the squares of `z` [N, F], give the scatter under one
    more value of each condition [N, C]. The means of `z` for labels [N] are 0.

    The squares of the G known values of a label hold (G - 1) / G of their variance; the distance of
    one more value from their mean varies by (G + 1) / G of it. So 2 / (G - 1) of them are added.
    """
    rows = [np.empty((0, z.shape[1]))]
    for values in conditions.T:
        kinds, kind, counts = np.unique(
            np.stack([labels, values]), axis=1, return_inverse=True, return_counts=True
        )
        known = np.bincount(kinds[0])[kinds[0]]
        first = np.append(0, np.cumsum(counts)[:-1])
        sums = np.add.reduceat(z[np.argsort(kind.ravel(), kind="stable")], first)
        several = known > 1
        share = 2 / (known[several] - 1)
        rows.append(sums[several] * np.sqrt(share / counts[several])[:, None])
    return np.concatenate(rows)


def _solve(z: Array, more: Array, wanted: Array) -> Array:
    """`wanted` [K, F] times the inverse of the shrunk covariance of `z` [N, F], whose means are 0,
    with the squares of the rows `more` [M, F] added. Only `z` is a sample, so it alone sets the
    shrinkage."""
    n, size = z.shape
    few = n + len(more) < size
    gram = z @ z.T if few else z.T @ z
    share, mean = shrinkage(z, gram)
    mean += float((more**2).sum()) / n / size
    share = max(share, LEAST_SHRINKAGE)
    ridge = max(share * mean, 1e-12)
    if not few:
        covariance = (1 - share) / n * (gram + more.T @ more) + ridge * np.eye(size)
        solution: Array = np.linalg.solve(covariance, wanted.T).T
        return solution
    share, rows = min(share, 1 - LEAST_SHRINKAGE), np.concatenate([z, more])
    among = (rows @ rows.T if len(more) else gram) + ridge * n / (1 - share) * np.eye(len(rows))
    inner = np.linalg.solve(among, rows @ wanted.T)
    solution = (wanted - (rows.T @ inner).T) / ridge
    return solution


def shrinkage(z: Array, gram: Array) -> tuple[float, float]:
    """Ledoit and Wolf's share of the mean variance in the covariance of `z` [N, F], whose means are
    0, and that variance.

    gram: the smaller of z @ z.T and z.T @ z.
    """
    n, size = z.shape
    trace, squares = float(np.trace(gram)) / n, float((gram**2).sum()) / n**2
    norms = [(z[first : first + BATCH] ** 2).sum(axis=1) for first in range(0, n, BATCH)]
    fourth = float((np.concatenate(norms) ** 2).sum())
    mean = trace / size
    distance = (squares - 2 * mean * trace + size * mean**2) / size
    noise = min(max((fourth / n - squares) / (size * n), 0.0), distance)
    return noise / distance if distance > 0 else 1.0, mean
