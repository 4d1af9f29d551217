"""The library: the recipe as a classifier of scikit-learn, and bundles with the box's answers."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml

from palpate.answer.objects import softmax
from palpate.core.errors import FormatError
from palpate.inference import session
from tests.factories.later import Later

exceptions = Later("sklearn.exceptions")
estimator_checks = Later("sklearn.utils.estimator_checks")
pandas = Later("pandas")
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


UNEQUAL = {
    "check_sample_weight_equivalence_on_dense_data": "filters and copies are drawn for each sweep "
    "of the set, also for one that counts 0 or twice"
}
"""Checks of scikit-learn that fail, with the reason."""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_scikit_learn_accepts_it():
    """All checks pass but UNEQUAL and the skipped array API's."""
    found = estimator_checks.check_estimator(
        library.PalpateClassifier(steps=0, size="64"),
        expected_failed_checks=UNEQUAL,
        on_skip=None,
        on_fail="raise",
    )
    assert len(found) > 60
    others = {check["check_name"] for check in found if check["status"] != "passed"}
    assert others <= {*UNEQUAL, "check_array_api_input"}


@pytest.mark.slow
def test_a_sweep_that_counts_nothing_changes_no_head(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Wrong labels of weight 0, for a bundle too."""
    weights = np.where(np.arange(48) < 12, 0.0, 1.0)
    y = np.where(weights > 0, LABELS, LABELS[::-1])
    one = small().fit(SWEEPS, y, sample_weight=weights)
    assert one.score(SWEEPS[12:], LABELS[12:]) == 1
    assert one.fit_.about["conditions"] == ["recording"]
    monkeypatch.setattr("palpate_train.export.pack.MOST_UNKNOWN", 1.0)  # ten are held out
    one.save_bundle(tmp_path / "b", proven=False)
    scores = library.load_bundle(tmp_path / "b").predict_proba(SWEEPS[12:])
    known = ~np.isnan(scores).any(axis=1)
    named = np.array(one.classes_)[scores[known].argmax(axis=1)]
    assert known.mean() > 0.7
    assert np.mean(named == LABELS[12:][known]) > 0.9
    for bad in (weights[:-1], -weights, weights * np.nan):
        with pytest.raises(ValueError, match=r"(?i)sample.weight"):
            small().fit(SWEEPS, y, sample_weight=bad)


def test_parameters_without_a_fit(fitted: PalpateClassifier):
    """Clones have the parameters, and no fit."""
    base = Later("sklearn.base")
    for check in (
        estimator_checks.check_no_attributes_set_in_init,
        estimator_checks.check_parameters_default_constructible,
    ):
        check("PalpateClassifier", library.PalpateClassifier())
    copy = base.clone(fitted)
    assert copy.get_params() == fitted.get_params()
    for answer in (copy.predict, copy.transform):
        with pytest.raises(exceptions.NotFittedError):
            answer(SWEEPS)


def test_answers_and_features_are_those_of_the_head(fitted: PalpateClassifier):
    """In the order of classes_, for both shapes; its own head gives its logits."""
    pipeline = Later("sklearn.pipeline")
    linear_model = Later("sklearn.linear_model")
    assert fitted.classes_.tolist() == ["felt", "wood"]
    assert fitted.score(SWEEPS[36:], LABELS[36:]) == 1
    found = fitted.predict_proba(SWEEPS[36:])
    np.testing.assert_allclose(found.sum(axis=1), 1)
    frames = SWEEPS.transpose(0, 2, 1).reshape(48, 100, 2, 2)
    np.testing.assert_array_equal(fitted.predict_proba(frames[36:]), found)
    np.testing.assert_array_equal(sweeps.raw_counts(frames), sweeps.raw_counts(SWEEPS, (2, 2)))
    assert fitted.sweeps.groups["position"].tolist() == GROUPS[:36].tolist()
    features = fitted.transform(SWEEPS[36:])
    weight, bias = fitted.fit_.int8_head()
    logits = features @ weight.T + bias
    np.testing.assert_allclose(softmax(logits), fitted.predict_proba(SWEEPS[36:]), atol=1e-5)
    assert fitted.get_feature_names_out().shape == features.shape[1:]
    piped = pipeline.make_pipeline(small(), linear_model.LogisticRegression()).fit(
        SWEEPS[:36], LABELS[:36]
    )
    assert piped.score(SWEEPS[36:], LABELS[36:]) == 1


@pytest.mark.slow
@pytest.mark.thorough  # four fits
def test_groups_are_left_out():
    """cross_val_score over whole groups."""
    model_selection = Later("sklearn.model_selection")
    leave = model_selection.LeaveOneGroupOut()
    found = model_selection.cross_val_score(small(), SWEEPS, LABELS, groups=GROUPS, cv=leave)
    assert found.tolist() == [1, 1, 1, 1]


@pytest.mark.slow
def test_a_bundle_scores_labels_that_are_numbers(tmp_path: Path):
    """The fit takes them, so their bundle does; its own labels are texts."""
    numbers = (LABELS == "wood").astype(int)
    made = small().fit(SWEEPS[:36], numbers[:36], groups=GROUPS[:36])
    made.save_bundle(tmp_path / "b", proven=False)
    assert library.load_bundle(tmp_path / "b").score(SWEEPS[36:], numbers[36:]) >= 0.8


@pytest.mark.slow
def test_a_bundle_answers_with_the_boxs_code(fitted: PalpateClassifier, tmp_path: Path):
    """save_bundle, library.load_bundle, predict; the card names the origin of the bundle."""
    # Words of the box's own refusals
    also = "holds|inf|objects|grid|impossible"
    manifest = fitted.save_bundle(tmp_path / "b", licence="CC-BY-4.0", proven=False)
    assert manifest.labels == ("felt", "wood")
    head = yaml.safe_load((tmp_path / "b" / "card.md").read_text().split("---")[1])
    assert head["license"] == "CC-BY-4.0"
    assert head["sensor"] == str(fitted.sweeps.format)
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
    want = box.predict_proba(SWEEPS[36:])
    for form in FORMS.values():
        np.testing.assert_array_equal(box.predict_proba(form(SWEEPS[36:].astype("i2"))), want)
    for x, why in REFUSED.values():
        if 0 not in getattr(x, "shape", ()):
            with pytest.raises(ValueError, match=f"{why}|{also}"):
                box.predict(x)
    with pytest.raises(FormatError, match="takes 2x2 uint8"):
        box.predict(SWEEPS[36:, :, :50])
    with pytest.raises(FormatError, match="no uint8"):
        box.predict(SWEEPS[36:] + 0.5)


class Polars:
    """A table or column as polars has it: NumPy asks it for an array."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape = values, values.shape

    def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
        return self.values

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter(self.values)


def column(x: np.ndarray) -> np.ndarray:
    """A column of arrays, one a sweep."""
    made = np.empty(len(x), object)
    made[:] = list(x)
    return made


def mapped(x: np.ndarray) -> np.ndarray:
    """A file that is mapped, and cannot be written."""
    with tempfile.NamedTemporaryFile(suffix=".npy") as file:
        np.save(file.name, x)
        return np.load(file.name, mmap_mode="r")


FORMS: dict[str, Callable[[np.ndarray], Any]] = {
    "highest byte first": lambda x: x.astype(x.dtype.newbyteorder(">")),
    "by columns": np.asfortranarray,
    "of a larger array": lambda x: np.repeat(x, 2, axis=2)[:, :, ::2],
    "backwards": lambda x: x[:, :, ::-1].copy()[:, :, ::-1],
    "read only": mapped,
    "a subclass": lambda x: x.view(np.recarray),
    "nothing masked": np.ma.masked_array,
    "lists": lambda x: x.tolist(),
    "a column": column,
    "a column of pandas": lambda x: pandas.Series(list(x)),
    "a column of polars": lambda x: Polars(column(x)),
    "a list of arrays": list,
    "objects": lambda x: x.astype(object),
    "whole numbers": lambda x: x.astype(np.int64),
    "float64": lambda x: x.astype(np.float64),
    "a tensor": lambda x: pytest.importorskip("torch").from_numpy(x.astype("f4")),
}


@pytest.mark.parametrize("form", FORMS)
def test_counts_are_the_same_however_they_are_given(fitted: PalpateClassifier, form: str):
    """A fit and its answers get the numbers that NumPy shows, in this machine's byte order."""
    expected = fitted.predict_proba(SWEEPS[36:])
    for kind in ("u2", "i2", "f4"):
        x = FORMS[form](SWEEPS[36:].astype(kind))
        np.testing.assert_array_equal(fitted.predict_proba(x), expected)
        made = small()._dataset(x, LABELS[36:], GROUPS[36:])
        np.testing.assert_array_equal(made.samples, sweeps.raw_counts(SWEEPS[36:], (2, 2)))
        assert type(made.samples) is np.ndarray
        assert made.samples.dtype.isnative


@pytest.mark.slow
def test_a_table_is_one_channel():
    """[n, time], of NumPy, pandas and polars, is [n, 1, time]."""
    x, one = SWEEPS[:, 0], small(grid=None)
    want = one.fit(SWEEPS[:, :1], LABELS).predict_proba(SWEEPS[:, :1])
    for form in (np.asarray, pandas.DataFrame, Polars):
        np.testing.assert_array_equal(one.fit(form(x), LABELS).predict_proba(form(x)), want)


def broken(value: float) -> np.ndarray:
    """Sweeps with one count replaced."""
    x = SWEEPS[36:].astype(np.float32)
    x[3, 1, 7] = value
    return x


REFUSED: dict[str, tuple[Any, str]] = {
    "NaN": (broken(np.nan), "NaN"),
    "infinite": (broken(np.inf), "inf"),
    "impossible": (broken(1e13), "1e|no uint8"),
    "masked": (np.ma.masked_greater(SWEEPS[36:], 120), "masked"),
    "no sweep": (SWEEPS[:0], "0 sample"),
    "no channel": (SWEEPS[36:, :0], "0"),
    "no frame": (SWEEPS[36:, :, :0], "0"),
    "structured": (np.zeros((12, 4, 100), [("a", "u1")]), "numeric|holds"),
    "complex": (SWEEPS[36:] + 1j, "omplex"),
    "texts": (SWEEPS[36:].astype(str), "numeric|holds"),
    "dates": (SWEEPS[36:].astype("M8[s]"), "holds|M8"),
    "unequal": ([SWEEPS[0], SWEEPS[1, :, :50]], "equal length"),
    "one sweep": (SWEEPS[0, 0], "Reshape|equal length"),
    "no uint8": (SWEEPS[36:] + 0.5, "no uint8"),
    "beyond uint8": (SWEEPS[36:].astype(np.int64) + 256, "no uint8"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_counts_is_refused(fitted: PalpateClassifier, what: str):
    """By predict, transform and, unless a fit could learn of it, by fit, as a ValueError."""
    x, why = REFUSED[what]
    ways = [fitted.predict, fitted.transform]
    if "uint8" not in what:
        ways.append(lambda x: small().fit(x, LABELS[: len(x)]))
    for way in ways:
        with pytest.raises(ValueError, match=why):
            way(x)


def test_a_pickle_answers_without_the_sweeps(fitted: PalpateClassifier, tmp_path: Path):
    """It is smaller than the bundle, and refuses to make one."""
    fitted.save_bundle(tmp_path / "b", proven=False)
    packed = pickle.dumps(fitted)
    assert len(packed) <= 2 * sum(file.stat().st_size for file in (tmp_path / "b").iterdir())
    again = pickle.loads(packed)
    for name in ("predict_proba", "transform"):
        want, found = (getattr(one, name)(SWEEPS[36:]) for one in (fitted, again))
        np.testing.assert_array_equal(found, want)
    with pytest.raises(exceptions.NotFittedError):
        again.save_bundle(tmp_path / "c")


def test_a_fit_opens_one_session(monkeypatch: pytest.MonkeyPatch):
    """Answers do not build the graph again."""
    opened: list[bytes] = []
    real = session.session
    monkeypatch.setattr(session, "session", lambda model: opened.append(model) or real(model))
    one = small(random_state=3).fit(SWEEPS[:36], LABELS[:36])
    assert one.fit_.about["seed"] == 3
    del opened[:]
    for i in range(36, 40):
        one.predict(SWEEPS[i : i + 1])
    assert opened == []


@pytest.mark.parametrize("state", [None, np.random.RandomState(1)])
def test_other_random_states_draw_a_seed(state: Any):
    """Any that the fit takes."""
    assert 0 <= small(random_state=state)._seed() < 2**31


@pytest.mark.slow
def test_several_groups_are_conditions():
    """As a dictionary or a table; `varies` says which of them will be new."""
    groups = {"speed": np.arange(48) % 4 * 10.0, "who": LABELS, "position": GROUPS}
    for given in (groups, pandas.DataFrame(groups)):
        one = small(varies=("speed",)).fit(SWEEPS, LABELS, groups=given)
        assert one.sweeps.groups["speed"].tolist() == groups["speed"].tolist()
        assert one.fit_.about["conditions"] == ["speed"]
    with pytest.raises(ValueError, match="force"):
        small(varies=("force",)).fit(SWEEPS, LABELS, groups=groups)


@pytest.mark.parametrize(
    ("x", "y", "why"),
    [
        (np.zeros((4, 4)), LABELS[:4], "2x2 has 4"),
        (np.zeros((4, 3, 9)), LABELS[:4], "2x2 has 4"),
        (np.zeros((4, 4, 9)), LABELS[:3], "inconsistent"),
        (np.zeros((4, 4, 9)), None, "requires y"),
        ([[[1, 2], [3]]], ["a"], "equal length"),
    ],
)
def test_what_cannot_be_fitted_is_named(x: object, y: object, why: str):
    """Before any training."""
    with pytest.raises(ValueError, match=why):
        small().fit(x, y)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("rate_hz", value) for value in (0, -1.0, np.nan, "fast")),
        *(("mains_hz", value) for value in (0, np.nan)),
        *(("steps", value) for value in (-1, 1.5)),
        *(("grid", value) for value in (4, (-2, -2), (0, 4))),
        *(("random_state", value) for value in (-3, 1.5, np.random.default_rng())),
        *(("group", None), ("varies", None), ("size", "x"), ("reattached", "no")),
    ],
)
def test_parameters_that_nothing_can_use_are_named(name: str, value: object):
    """Before any training, as scikit-learn's estimators do."""
    with pytest.raises(ValueError, match=name):
        small(**{name: value}).fit(SWEEPS, LABELS)


@pytest.mark.parametrize(
    ("y", "groups", "why"),
    [
        (np.where(LABELS == "felt", None, "wood"), GROUPS, "y has values of several types"),
        (LABELS, np.where(GROUPS == 1, None, "a"), "position has values of several types"),
        (LABELS, np.stack([GROUPS, GROUPS], axis=1), r"position holds \[48, 2\]"),
    ],
)
def test_labels_and_groups_without_an_order_are_named(y: np.ndarray, groups: np.ndarray, why: str):
    """One value a sweep, all of one type."""
    with pytest.raises(ValueError, match=why):
        small().fit(SWEEPS, y, groups=groups)


def test_a_word_and_an_array_are_parameters_too():
    """One name in `varies`, and a grid of NumPy."""
    one = small(varies="position", grid=np.array([2, 2])).fit(SWEEPS, LABELS, groups=GROUPS)
    assert one.fit_.about["conditions"] == ["position"]
    assert one.format_.shape == (2, 2)
