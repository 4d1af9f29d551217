"""The scale of what a sensor feels. In: raw counts. Out: the factor that brings their texture to
about 1."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def texture_scale(samples: NDArray[Any]) -> float:
    """The factor that gives raw counts [N, T, R, C] a deviation of 1 once each taxel's mean over
    its sweep is subtracted."""
    deviation = samples - samples.mean(axis=1, keepdims=True, dtype=np.float32)
    return float(1 / max(np.sqrt(np.mean(deviation**2)), 1e-6))
