"""Methods of prior work that the paper compares itself with, and the exploration of Xu et al. 2013.

prior_features computes their features as far as a pressure skin allows, and baselines.learn trains
them. The box does not compute these features. `explore` works with any method: sweeps are added
until the posterior is high enough.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate.core.errors import FormatError
from palpate_studies.peers.baselines import ABSENT, Estimator, Gauss, learn, svm
from palpate_studies.peers.prior_features import correlation, spectrogram, static
from palpate_train.data.sets import Dataset
from palpate_train.models.methods import Method
from palpate_train.onnx_tools.graph_builder import GraphModel

Array = NDArray[Any]
Features = Callable[[Array, float], Array]
"""Raw counts [T, R, C] and their rate in Hz -> features float64 [F]."""


@dataclass(frozen=True)
class OnFeatures:
    """A model of features that the box does not compute."""

    features: Features
    rate_hz: float
    model: GraphModel

    def logits(self, inputs: Array) -> Array:
        """Raw counts [n, T, R, C] -> log probabilities float32 [n, K]."""
        return self.model.logits(_computed(self.features, inputs, self.rate_hz))

    def graph(self) -> onnx.ModelProto:
        """Raises FormatError."""
        raise FormatError(
            "the box does not compute these features of prior work; export another method"
        )


def _computed(features: Features, samples: Array, rate_hz: float) -> Array:
    """Features float32 [n, F] of raw counts [n, T, R, C]."""
    return np.stack([features(counts, rate_hz) for counts in samples]).astype(np.float32)


def _learn(
    features: Features, make: Callable[[], Estimator], sweeps: Dataset, inputs: Array, seed: int
) -> OnFeatures:
    """Train an estimator of `make` as baselines.learn does, on `features` of the raw counts."""
    given = _computed(features, inputs, sweeps.rate_hz)
    return OnFeatures(features, sweeps.rate_hz, learn(make, sweeps, given, seed))


def _on(name: str, about: str, features: Features, make: Callable[[], Estimator]) -> Method:
    return Method(name, about, "raw", partial(_learn, features, make), library="palpate_studies")


METHODS = (
    Method(
        "fishel-bayes",
        "roughness and fineness, independent normal distributions for each class, Bayes (Fishel "
        "and Loeb 2012)",
        "L",
        partial(learn, partial(Gauss, independent=True, first=2)),
    ),
    _on(
        "static-svm",
        "features that do not depend on the order of frames, linear SVM (Hoelscher et al. 2015)",
        static,
        partial(svm, kernel="linear"),
    ),
    _on(
        "spectrogram-svm",
        "5 x 25 bins of log power, RBF SVM (Sinapov et al. 2011)",
        spectrogram,
        svm,
    ),
    _on(
        "correlation-svm",
        "activity, mobility, complexity, correlations between taxels, RBF SVM (Kaboli, Chathuranga "
        "et al. 2015)",
        correlation,
        svm,
    ),
)
"""Fishel and Loeb measured one property at a time, so their likelihoods are multiplied. SVMs come
from baselines.svm; that of Hoelscher et al. is linear."""


def explore(log_probabilities: Array, min_posterior: float) -> tuple[int, int]:
    """One object, sweep after sweep, until a label's posterior reaches `min_posterior`: (label,
    number of sweeps used).

    log_probabilities: [S, K] of its S sweeps in their order. Priors are equal and sweeps
    independent, so log probabilities are added (Xu et al. 2013; the product that the box computes).
    A probability counts as at least 1e-12, as on the box. If no posterior is high enough, all
    sweeps are used. Raises FormatError without a sweep, or if `min_posterior` is not a probability.
    """
    if not 0 < min_posterior <= 1:
        raise FormatError(
            f"a posterior of {min_posterior} cannot be reached; use more than 0, at most 1"
        )
    if log_probabilities.ndim != 2 or 0 in log_probabilities.shape:
        shape = list(log_probabilities.shape)
        raise FormatError(
            f"log probabilities have the shape {shape}; give [sweeps, materials], at least one of "
            "each"
        )
    posterior = softmax(np.maximum(log_probabilities, ABSENT).cumsum(axis=0))
    enough = posterior.max(axis=1) >= min_posterior
    last = int(enough.argmax()) if enough.any() else len(enough) - 1
    return int(posterior[last].argmax()), last + 1
