"""What `fit_posthoc` is fitted to, without augmented copies where none are given."""

from __future__ import annotations

import numpy as np

from train.calibration.moved import AugmentedCopies
from train.calibration.posthoc import PosthocInputs


def plain_inputs(
    tenths: np.ndarray,
    labels: np.ndarray,
    groups: np.ndarray,
    judged: np.ndarray,
    fixed: int = 0,
    disturbed: np.ndarray | None = None,
) -> PosthocInputs:
    """Features [N, D + 1, F] and what is known of these sweeps; disturbed: None where none is."""
    none = AugmentedCopies(tenths[:0, -1], labels[:0], groups[:0], np.zeros(0, bool))
    return PosthocInputs(
        tenths,
        labels,
        groups,
        judged,
        fixed,
        none,
        np.zeros(len(labels), bool) if disturbed is None else disturbed,
    )
