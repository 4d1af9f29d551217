"""Linear discriminant analysis with shrinkage, quick where there are fewer sweeps than features.
In: features. Out: a head.

Sweeps of every material are taken to scatter alike about their mean. The covariance is Ledoit and
Wolf's (2004), of features scaled to the same scatter; materials are equally probable. Where there
are fewer sweeps than features the equations are solved among the sweeps (Woodbury's identity): the
same solution, many times as fast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError

Array = NDArray[Any]
ABSENT = -1e4
"""Logit of a material without a sweep."""
LEAST_SHRINKAGE = 1e-4
"""Where the scatter is known so well that none is needed, equations with equal features must have a
solution."""


def fit(features: Array, labels: Array, classes: int) -> tuple[Array, Array]:
    """Weight [K, F] and bias [K], float32, from features [N, F] of sweeps with labels [N] below
    `classes`.

    The logits of a material without a sweep are ABSENT. Raises FormatError where there is only one
    sweep of each material, which says nothing of how materials vary.
    """
    present, member = np.unique(labels, return_inverse=True)
    x = np.asarray(features, np.float64)
    if len(x) <= len(present):
        raise FormatError(
            f"{len(x)} sweeps of as many materials are too few for a linear discriminant; record more"
        )
    means = np.stack([x[member == k].mean(axis=0) for k in range(len(present))])
    scatter = x - means[member]
    spread = scatter.std(axis=0)
    spread = np.maximum(spread, max(1e-6 * float(spread.max(initial=0)), 1e-12))
    middle = means.mean(axis=0)
    wanted = (means - middle) / spread
    solved = _solve(scatter / spread, wanted)
    weight, bias = np.zeros((classes, x.shape[1])), np.full(classes, ABSENT)
    weight[present] = solved / spread
    bias[present] = -0.5 * (wanted * solved).sum(axis=1) - weight[present] @ middle
    return weight.astype(np.float32), bias.astype(np.float32)


def _solve(z: Array, wanted: Array) -> Array:
    """`wanted` [K, F] times the inverse of the shrunk covariance of `z` [N, F], whose means are
    0."""
    n, size = z.shape
    few = n < size
    gram = z @ z.T if few else z.T @ z
    share, mean = shrinkage(z, gram)
    share = max(share, LEAST_SHRINKAGE)
    ridge = max(share * mean, 1e-12)
    if not few:
        solution: Array = np.linalg.solve((1 - share) / n * gram + ridge * np.eye(size), wanted.T).T
        return solution
    share = min(share, 1 - LEAST_SHRINKAGE)
    inner = np.linalg.solve(gram + ridge * n / (1 - share) * np.eye(n), z @ wanted.T)
    solution = (wanted - (z.T @ inner).T) / ridge
    return solution


def shrinkage(z: Array, gram: Array) -> tuple[float, float]:
    """Ledoit and Wolf's share of the mean variance in the covariance of `z` [N, F], whose means are
    0, and that variance.

    gram: z @ z.T or z.T @ z, whichever is smaller.
    """
    n, size = z.shape
    trace, squares = float(np.trace(gram)) / n, float((gram**2).sum()) / n**2
    fourth = float(((z**2).sum(axis=1) ** 2).sum())
    mean = trace / size
    distance = (squares - 2 * mean * trace + size * mean**2) / size
    noise = min(max((fourth / n - squares) / (size * n), 0.0), distance)
    return noise / distance if distance > 0 else 1.0, mean
