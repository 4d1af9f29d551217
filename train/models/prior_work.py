"""The room of the work that the paper compares itself with. In: features of training sweeps. Out: Models that the box runs.

Their features, as a pressure skin allows them, stand in appliance/related.py, their training in baselines.py. Here is
also the exploration of Xu et al. 2013, for any method: sweeps are added until the posterior is sure.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.inference.classifier import softmax
from train.models.baselines import ABSENT, Gauss, learn, svm
from train.models.methods import Method

Array = NDArray[Any]

METHODS = (
    Method(
        "fishel-bayes",
        "roughness and fineness, independent normal distributions a class, Bayes (Fishel and Loeb 2012)",
        "L",
        partial(learn, partial(Gauss, independent=True, first=2)),
    ),
    Method(
        "static-svm",
        "what does not depend on the order of frames, linear SVM (Hoelscher et al. 2015)",
        "static",
        partial(learn, partial(svm, kernel="linear")),
    ),
    Method(
        "spectrogram-svm",
        "5 x 25 bins of log power, RBF SVM (Sinapov et al. 2011)",
        "spectrogram",
        partial(learn, svm),
    ),
    Method(
        "correlation-svm",
        "activity, mobility, complexity, correlations between taxels, RBF SVM (Kaboli, Chathuranga et al. 2015)",
        "correlation",
        partial(learn, svm),
    ),
)
"""Fishel and Loeb measured one property at a time, so their likelihoods multiply. SVMs are those of baselines.svm, but
Hoelscher et al.'s is linear."""


def explore(log_probabilities: Array, sure: float) -> tuple[int, int]:
    """One object, sweep after sweep, until a label's posterior reaches `sure`: (label, sweeps used).

    log_probabilities: [S, K] of its S sweeps in the order in which they are made; all materials are equally likely
    beforehand and sweeps independent, so that they add up (Xu et al. 2013; the box's product). A probability counts as
    at least 1e-12, as on the box. Where no posterior is sure all sweeps are used.
    Raises FormatError where there is no sweep, or `sure` is no probability.
    """
    if not 0 < sure <= 1:
        raise FormatError(f"a posterior of {sure} cannot be reached; use more than 0, at most 1")
    if log_probabilities.ndim != 2 or 0 in log_probabilities.shape:
        shape = list(log_probabilities.shape)
        raise FormatError(f"log probabilities have the shape {shape}; give [sweeps, materials], at least one of each")
    posterior = softmax(np.maximum(log_probabilities, ABSENT).cumsum(axis=0))
    enough = posterior.max(axis=1) >= sure
    last = int(enough.argmax()) if enough.any() else len(enough) - 1
    return int(posterior[last].argmax()), last + 1
