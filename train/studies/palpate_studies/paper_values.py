"""Values printed in the paper: accuracies by case and method, training cost, confusion, several
sweeps.

The figures of the paper are not text; these are the values printed in them. Cases are named as in
paper_experiment.
"""

from __future__ import annotations

import numpy as np

from palpate_studies import sim_calibration

FIGURES = {"lab": 4, "lopo": 5, "random": 6, "hard": 7}
ACCURACY: dict[str, dict[str, float]] = {
    part: dict(zip(sim_calibration.METHODS, figure.printed, strict=True))
    for part, number in FIGURES.items()
    for figure in sim_calibration.FIGURES
    if figure.number == number
}
"""Figs. 4 to 7."""
CNN = "paper-cnn"
for _part, _share in (("lopo", 0.923), ("hard", 0.917)):
    ACCURACY[_part][CNN] = _share  # Fig. 10
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
"""Fig. 11, the CNN on T-REAL with a position left out: rows are the truth, in the order of
skin.MATERIALS."""
SEVERAL: dict[str, tuple[float | None, ...]] = {
    "H-svm": (0.86, None, 0.92),
    CNN: (0.923, 0.973, 0.975),
}
"""Fig. 13: one, two, three sweeps."""


def short_name(method: str) -> str:
    """A name that fits beside a bar and above a panel."""
    return method.removeprefix("palpate-")
