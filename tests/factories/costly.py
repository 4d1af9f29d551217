"""Methods whose training takes seconds, though a test lets them take few steps; a skin that sends
1,000 frames a second, and two with the format of another.

`make test` tries the others; `make test-all` tries these as well.
"""

from collections.abc import Iterable
from typing import Any

import pytest

COSTLY = {
    *("lite", "ds-cnn", "recurrent", "multirocket-hydra", "quant", "palpate", "palpate-64"),
    *("palpate-stages", "palpate-256", "paper-cnn-centred", "tactnet2", "minirocket"),
    *("papillarray", "reskin", "flexitac"),
}

OF_LIBRARIES = (
    *("static-svm", "spectrogram-svm", "correlation-svm"),
    *("multirocket-hydra", "quant"),
)
"""Methods that have no graph for the box."""
WITH_GRAPH = (
    *("palpate-bands", "palpate-pairs", "palpate-64", "palpate-stages", "palpate-256", "palpate"),
    *("palpate-reattached", "L-gauss", "L-knn", "L-svm", "H-knn", "H-svm", "fishel-bayes"),
    *("st-hmp", "minirocket", "minirocket-augmented", "ds-cnn", "lite", "edge-spectral"),
    *("paper-cnn", "paper-cnn-centred", "tactnet2", "recurrent"),
)
"""All other methods; `methods.every()` would import all of their libraries."""


def quick_first(names: Iterable[str]) -> list[Any]:
    """The names as parameters of a test. The costly methods are marked thorough."""
    return [
        pytest.param(name, marks=pytest.mark.thorough) if name in COSTLY else name for name in names
    ]
