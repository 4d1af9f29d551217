"""Where a sweep lies among the materials. In: a bundle's class means, an embedding. Out: how far each is, logits.

The embedding is scaled such that the sweeps of each material scatter around its mean with covariance 1. So a squared
distance there is a number of deviations squared (Mahalanobis), and materials are told apart by the nearest mean. An
enrolled material is one mean more; nothing is trained for it.
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
    """Class means at work; `labels` [K] are theirs."""

    def __init__(self, classes: Classes, known: Known, labels: Sequence[str]) -> None:
        self.labels, self.limit, self._temperature = labels, known.limit, known.temperature
        self._means = classes.means.astype(np.float64)
        # what stays of the bias when -|m|^2 / 2 is in the distance already: distances do not cancel as products do
        self._extra = classes.bias + (self._means**2).sum(axis=1) / 2
        n = classes.sweeps
        # a mean of n sweeps is itself 1 / n off in every direction: another sweep of the material lies 1 + 1 / n away
        self._share = np.where(n, n / (n + 1), 1.0) / classes.spread

    def distances(self, embedding: NDArray[Any]) -> Array:
        """Squared distances [..., K] of embeddings [..., r] to the class means; no unit."""
        away = embedding[..., None, :] - self._means
        result: Array = (away**2).sum(axis=-1)
        return result

    def logits(self, distances: Array) -> NDArray[np.float32]:
        """Logits [..., K] from `distances`: those of means and bias, but for a term that is the same for all labels."""
        result: NDArray[np.float32] = ((self._extra - distances / 2) / self._temperature).astype(np.float32)
        return result

    def strange(self, distances: Array) -> str:
        """How far the nearest material is from one embedding where that is beyond the limit, else "".

        An enrolled label's distance counts n / (n + 1) / spread, so that about as many of its sweeps are kept as of a
        trained one's: the embedding was not made to hold them together.
        """
        scaled = distances * self._share
        k = int(scaled.argmin())
        if scaled[k] <= self.limit:
            return ""
        return f"squared distance {scaled[k]:.4g} from {self.labels[k]}, limit {self.limit:.4g}"

    def closest_pair(self) -> float:
        """Squared distance of the two class means that lie closest together."""
        between = self.distances(self._means)
        return float(between[~np.eye(len(between), dtype=bool)].min())
