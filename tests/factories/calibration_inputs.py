"""Inputs of `fit_calibration` for tests, without augmented copies."""

import numpy as np

from palpate_train.answer.calibrate import CalibrationInputs
from palpate_train.answer.fit_contact import AugmentedCopies


def plain_inputs(
    prefixes: np.ndarray,
    labels: np.ndarray,
    groups: np.ndarray,
    held: np.ndarray,
    fixed: int = 0,
    faulty: np.ndarray | None = None,
) -> CalibrationInputs:
    """Inputs from features [N, D + 1, F] and labels. faulty: by default none."""
    none = AugmentedCopies(prefixes[:0, -1], labels[:0], groups[:0], np.zeros(0, bool))
    return CalibrationInputs(
        prefixes,
        labels,
        {"recording": groups},
        held,
        True,
        fixed,
        none,
        np.zeros(len(labels), bool) if faulty is None else faulty,
    )
