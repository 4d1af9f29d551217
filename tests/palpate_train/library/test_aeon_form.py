"""The recipe with aeon's base class: aeon's own checks, and the answers of the other classifier."""

from functools import partial
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.slow  # the import of aeon takes seconds
RNG = np.random.default_rng(5)
LABELS = np.array(["felt", "wood"])[np.arange(32) % 2]
SWEEPS = RNG.normal(0, 8, (32, 4, 100)) + 100
SWEEPS[LABELS == "wood"] += 20 * np.sin(np.arange(100) * 0.9)


@pytest.fixture
def form() -> Any:
    """The classifier with aeon's base class."""
    pytest.importorskip("aeon")
    from palpate_train.library.aeon_form import AeonPalpateClassifier

    return AeonPalpateClassifier


def test_it_answers_as_the_classifier_does(form: Any):
    """Fit, labels and probabilities; it can stand at the end of a pipeline of aeon."""
    small = partial(dict, steps=0, size="bands", grid=(2, 2))
    from aeon.classification.compose import ClassifierPipeline
    from aeon.transformations.collection import Normalizer

    from palpate_train import PalpateClassifier

    made = form(**small()).fit(SWEEPS[:24], LABELS[:24])
    same = PalpateClassifier(**small()).fit(SWEEPS[:24], LABELS[:24])
    np.testing.assert_array_equal(made.predict_proba(SWEEPS[24:]), same.predict_proba(SWEEPS[24:]))
    assert made.score(SWEEPS[24:], LABELS[24:]) == 1
    assert made.palpate_.sweeps.format.rows == 2
    pipeline = ClassifierPipeline(Normalizer(), form(**small()))
    pipeline.fit(SWEEPS[:24], LABELS[:24])
    assert set(pipeline.predict(SWEEPS[24:])) <= {"felt", "wood"}


@pytest.mark.thorough  # aeon's checks fit a dozen times
def test_aeons_own_checks_pass(form: Any):
    """All of them, with its sweeps of 20 frames, which need a size with filters."""
    from aeon.testing.estimator_checking import check_estimator

    found = check_estimator(form, raise_exceptions=False, verbose=False)
    assert len(found) > 20
    assert {name: said for name, said in found.items() if said != "PASSED"} == {}
