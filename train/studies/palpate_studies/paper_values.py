"""Accuracies that the paper prints, by case of paper_experiment and method.

The figures of the paper are not text; these are the values printed in them.
"""

from __future__ import annotations

import numpy as np

CNN = "paper-cnn"
FIVE = ("L-gauss", "L-knn", "L-svm", "H-knn", "H-svm")
FIGURES = {"lab": 4, "lopo": 5, "random": 6, "hard": 7}
"""Number of the figure by case."""
ACCURACY: dict[str, dict[str, float]] = {
    "lab": dict(zip(FIVE, (0.85, 0.82, 0.85, 0.90, 0.96), strict=True)),
    "lopo": dict(zip((*FIVE, CNN), (0.78, 0.77, 0.79, 0.75, 0.86, 0.923), strict=True)),
    "random": dict(zip(FIVE, (0.80, 0.80, 0.83, 0.85, 0.93), strict=True)),
    "hard": dict(zip((*FIVE, CNN), (0.57, 0.58, 0.55, 0.50, 0.70, 0.917), strict=True)),
}
"""Figs. 4 to 7, and Fig. 10 for the CNN."""
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
