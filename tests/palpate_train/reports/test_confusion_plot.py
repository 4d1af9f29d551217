"""The picture of a confusion matrix."""

import numpy as np
import pytest

from palpate_train.reports import confusion_plot


@pytest.mark.parametrize(
    ("names", "upright"),
    [
        (["wood", "metal", "foam"], 0),
        (["foam", "metal", "paper", "plastic-rough", "plastic smooth", "wood"], 0),
        ([f"texture number {i}" for i in range(21)], 21),
    ],
)
def test_names_above_the_columns_do_not_overlap(names: list[str], upright: int):
    """They have a line for each word, and stand upright where a word is wider than its column."""
    matrix = np.eye(len(names), dtype=int)
    assert confusion_plot.draw(matrix, names, "about").count("rotate(-90") == upright
