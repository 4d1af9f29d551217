"""All feature sets by name. They map the raw counts of one sweep's window to float32 features.

KINDS holds the features that the box computes and those of prior work, which only the desktop
computes. A bundle may name only a feature set of palpate.answer.features.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer import features
from palpate_train.features import prior_work

Array = NDArray[np.float64]
KINDS: Mapping[str, Callable[[NDArray[Any], float], Array]] = MappingProxyType(
    {
        **features.KINDS,
        "static": prior_work.static,
        "spectrogram": prior_work.spectrogram,
        "correlation": prior_work.correlation,
    }
)


def compute(kind: str, taxels: NDArray[Any], rate_hz: float) -> NDArray[np.float32]:
    """The feature set `kind` of KINDS for raw counts [T, R, C] at `rate_hz`, float32 [n]. Raises
    FormatError."""
    return features.compute(kind, taxels, rate_hz, KINDS)


def graph_input(kind: str, taxels: NDArray[Any], rate_hz: float) -> NDArray[Any]:
    """The input `kind` of a graph: the raw counts [T, R, C] themselves if it is "raw", else their
    features, as `compute` gives them."""
    return features.graph_input(kind, taxels, rate_hz, KINDS)
