"""Distances of a sweep to the known materials. In: a bundle's class means, an embedding. Out: distances, logits, and
whether the material is unknown.

The embedding is scaled so that the sweeps of each material have covariance 1 around their mean. A squared distance in
it is therefore a squared Mahalanobis distance, and the nearest mean names the material. An enrolled material is one
more mean; nothing is trained for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.bundle import Classes
from appliance.bundle.manifest import Known

Array = NDArray[np.float64]


class Means:
    """Computes distances and logits from a bundle's class means. labels: those of the means, [K]."""

    def __init__(self, classes: Classes, known: Known, labels: Sequence[str]) -> None:
        self.labels, self.limit, self._temperature = labels, known.limit, known.temperature
        self._means = classes.means.astype(np.float64)
        # the rest of the bias, since the squared distance already contains -|m|^2 / 2; computed from distances, logits
        # do not suffer the cancellation of large products
        self._extra = classes.bias + (self._means**2).sum(axis=1) / 2
        n = classes.sweeps
        # a mean of n sweeps has variance 1 / n in every direction: another sweep has variance 1 + 1 / n around it
        self._share = np.where(n, n / (n + 1), 1.0) / classes.spread

    def distances(self, embedding: NDArray[Any]) -> Array:
        """Squared distances float64 [..., K] from embeddings [..., r] to the class means; no unit."""
        away = embedding[..., None, :] - self._means
        result: Array = (away**2).sum(axis=-1)
        return result

    def logits(self, distances: Array) -> NDArray[np.float32]:
        """Logits [..., K] from `distances` [..., K], up to a term that is the same for all labels."""
        result: NDArray[np.float32] = ((self._extra - distances / 2) / self._temperature).astype(np.float32)
        return result

    def novelty(self, distances: Array) -> str:
        """The distance to the nearest material if it is beyond the limit, as text; "" for a known material.

        distances: [K], of one embedding. The distance to an enrolled label is multiplied by n / (n + 1) / spread, so
        that about as many of its sweeps are accepted as of a trained label, for which the embedding was optimised.
        """
        scaled = distances * self._share
        k = int(scaled.argmin())
        if scaled[k] <= self.limit:
            return ""
        return f"squared distance {scaled[k]:.4g} from {self.labels[k]}, limit {self.limit:.4g}"

    def closest_pair(self) -> float:
        """Squared distance between the two closest class means."""
        between = self.distances(self._means)
        return float(between[~np.eye(len(between), dtype=bool)].min())
