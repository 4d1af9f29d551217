"""The room of what the paper printed: accuracies by part and method, training cost, confusion, several sweeps.

Its figures did not survive as text; these are the values printed in them. Parts are named as in paper.py.
"""

from __future__ import annotations

import numpy as np

from train.evaluation import sim_calibration

FIGURES = {"lab": 4, "lopo": 5, "random": 6, "hard": 7}
ACCURACY = {
    part: dict(zip(sim_calibration.METHODS, figure.printed, strict=True))
    for part, number in FIGURES.items()
    for figure in sim_calibration.FIGURES
    if figure.number == number
}
"""Figs. 4 to 7."""
MEANS_OUT = ", means out"
CNNS = ("paper-cnn", "paper-cnn" + MEANS_OUT)
"""The paper's network, and the same on sweeps without each taxel's mean, which needs far fewer iterations: the printed
numbers are the first one's, and what the second one is compared with."""
for _cnn in CNNS:
    ACCURACY["lopo"][_cnn], ACCURACY["hard"][_cnn] = 0.923, 0.917  # Fig. 10
COST = ((500, 0.08), (2500, 0.002))
"""Fig. 9: iteration, cross entropy; flat after 3,300."""
CONFUSION = np.array(
    [
        [0.78, 0.10, 0.00, 0.00, 0.12, 0.00],
        [0.06, 0.90, 0.00, 0.02, 0.02, 0.00],
        [0.00, 0.00, 0.98, 0.00, 0.01, 0.01],
        [0.00, 0.01, 0.02, 0.97, 0.00, 0.00],
        [0.07, 0.01, 0.01, 0.00, 0.90, 0.00],
        [0.01, 0.00, 0.00, 0.00, 0.00, 0.99],
    ]
)
"""Fig. 11, the CNN on T-REAL with a position left out: rows are the truth, in the order of skin.MATERIALS."""
SEVERAL = {"H-svm": (0.86, None, 0.92), **dict.fromkeys(CNNS, (0.923, 0.973, 0.975))}
"""Fig. 13: one, two, three sweeps."""


def short(method: str) -> str:
    """A name that fits beside a bar."""
    return f"–{MEANS_OUT[1:]}" if method.endswith(MEANS_OUT) else method
