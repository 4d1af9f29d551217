"""The library: the recipe as a classifier of scikit-learn, and bundles with the box's answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

from palpate.core.errors import FormatError
from tests.factories.later import Later

base = Later("sklearn.base")
exceptions = Later("sklearn.exceptions")
model_selection = Later("sklearn.model_selection")
estimator_checks = Later("sklearn.utils.estimator_checks")
library = Later("palpate_train.library")
sweeps = Later("palpate_train.library.sweeps")
if TYPE_CHECKING:
    from palpate_train import PalpateClassifier

RNG = np.random.default_rng(0)
LABELS = np.array(["felt", "wood"])[np.arange(48) % 2]
GROUPS = np.arange(48) // 12
SWEEPS = RNG.normal(0, 8, (48, 4, 100)) + 100
SWEEPS[LABELS == "wood"] += 20 * np.sin(np.arange(100) * 0.9)
SWEEPS = np.rint(SWEEPS).astype(np.uint8)


def small(**changes: object) -> PalpateClassifier:
    """A classifier that fits in seconds."""
    return library.PalpateClassifier(**{"grid": (2, 2), "steps": 0, "size": "bands"} | changes)


@pytest.fixture(scope="module")
def fitted() -> PalpateClassifier:
    return small().fit(SWEEPS[:36], LABELS[:36], groups=GROUPS[:36])


def test_scikit_learn_accepts_it(fitted: PalpateClassifier):
    """Its checks without data of two axes; parameters, clones, an unfitted classifier."""
    for check in (
        estimator_checks.check_no_attributes_set_in_init,
        estimator_checks.check_get_params_invariance,
        estimator_checks.check_set_params,
        estimator_checks.check_parameters_default_constructible,
        estimator_checks.check_estimator_repr,
    ):
        check("PalpateClassifier", library.PalpateClassifier())
    with pytest.warns(UserWarning, match="Can't test estimator"):
        estimator_checks.check_estimator(library.PalpateClassifier())
    copy = base.clone(fitted)
    assert copy.get_params() == fitted.get_params()
    with pytest.raises(exceptions.NotFittedError):
        copy.predict(SWEEPS)


def test_labels_and_probabilities(fitted: PalpateClassifier):
    """New sweeps get the right label; probabilities are in the order of classes_; [n, time, rows,
    columns] gives the same answers as [n, channels, time]."""
    assert fitted.classes_.tolist() == ["felt", "wood"]
    assert fitted.score(SWEEPS[36:], LABELS[36:]) == 1
    found = fitted.predict_proba(SWEEPS[36:])
    np.testing.assert_allclose(found.sum(axis=1), 1)
    frames = SWEEPS.transpose(0, 2, 1).reshape(48, 100, 2, 2)
    np.testing.assert_array_equal(fitted.predict_proba(frames[36:]), found)
    np.testing.assert_array_equal(sweeps.raw_counts(frames), sweeps.raw_counts(SWEEPS, (2, 2)))
    assert fitted.sweeps.groups["position"].tolist() == GROUPS[:36].tolist()


@pytest.mark.slow
@pytest.mark.thorough  # four fits
def test_groups_are_left_out():
    """cross_val_score over whole groups."""
    leave = model_selection.LeaveOneGroupOut()
    found = model_selection.cross_val_score(small(), SWEEPS, LABELS, groups=GROUPS, cv=leave)
    assert found.tolist() == [1, 1, 1, 1]


def test_a_bundle_answers_with_the_boxs_code(fitted: PalpateClassifier, tmp_path: Path):
    """save_bundle, load_bundle, predict; the card names the origin of the bundle."""
    manifest = fitted.save_bundle(tmp_path / "b", licence="CC-BY-4.0", proven=False)
    assert manifest.labels == ("felt", "wood")
    head = yaml.safe_load((tmp_path / "b" / "card.md").read_text().split("---")[1])
    assert head["license"] == "CC-BY-4.0"
    assert head["sensor"] == "2x2 uint8 at 100 Hz, window 100"
    assert head["materials"].keys() == {"felt", "wood"}
    assert head["groups"] == {"position": 2}
    assert head["protocol"] == "held-out position"
    assert 0 <= head["interval_95"][0] <= head["accuracy"] <= head["interval_95"][1] <= 1
    assert len(head["training_digest"]) == 16
    box = library.load_bundle(tmp_path / "b")
    assert box.score(SWEEPS[36:], LABELS[36:]) >= 0.8
    known = set(box.predict(SWEEPS[36:])) - {"unknown"}
    assert known == {"felt", "wood"}
    assert box.predict_proba(SWEEPS[36:]).shape == (12, 2)
    for found, verdict in zip(
        box.predict_proba(SWEEPS[36:]), box.verdicts(SWEEPS[36:]), strict=True
    ):
        if verdict.label:
            assert found.max() == pytest.approx(verdict.probability)
    with pytest.raises(FormatError, match="takes 2x2 uint8"):
        box.predict(SWEEPS[36:, :, :50])
    with pytest.raises(FormatError, match="float32"):
        box.predict(SWEEPS[36:] + 0.5)


FORMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "highest byte first": lambda x: x.astype(x.dtype.newbyteorder(">")),
    "by columns": np.asfortranarray,
    "of a larger array": lambda x: np.repeat(x, 2, axis=2)[:, :, ::2],
    "backwards": lambda x: x[:, :, ::-1].copy()[:, :, ::-1],
    "read only": lambda x: np.frombuffer(x.tobytes(), x.dtype).reshape(x.shape),
}


@pytest.mark.parametrize("form", FORMS)
def test_counts_are_the_same_however_they_lie_in_memory(fitted: PalpateClassifier, form: str):
    """A fit and its answers get the numbers that NumPy shows, in this machine's byte order."""
    expected = fitted.predict_proba(SWEEPS[36:])
    for kind in ("u2", "i2", "f4"):
        x = FORMS[form](SWEEPS[36:].astype(kind))
        np.testing.assert_array_equal(fitted.predict_proba(x), expected)
        made = small()._dataset(x, LABELS[36:], GROUPS[36:])
        np.testing.assert_array_equal(made.samples, sweeps.raw_counts(SWEEPS[36:], (2, 2)))
        assert made.samples.dtype.isnative


@pytest.mark.parametrize(
    ("x", "y", "why"),
    [
        (np.zeros((4, 4)), LABELS[:4], r"X holds float64 \[4, 4\]"),
        (np.zeros((4, 3, 9)), LABELS[:4], "2x2 has 4"),
        (np.zeros((4, 4, 9)), LABELS[:3], r"\[3\] values for 4"),
        (np.zeros((4, 4, 9)), None, "y is missing"),
        ([[[1, 2], [3]]], ["a"], "objects|inhomogeneous"),
    ],
)
def test_what_cannot_be_fitted_is_named(x: object, y: object, why: str):
    """Before any training."""
    with pytest.raises((FormatError, ValueError), match=why):
        small().fit(x, y)
