"""Methods on features: graph against estimator, normal distributions, and the temperature."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.objects import softmax
from palpate.core.errors import FormatError
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.models import methods
from palpate_train.onnx_tools.graph_builder import GraphModel
from tests.factories.later import Later

baselines = Later("palpate_studies.peers.baselines")
pipeline = Later("sklearn.pipeline")
preprocessing = Later("sklearn.preprocessing")
special = Later("scipy.special")


@pytest.fixture(scope="module")
def tubes() -> Dataset:
    """Two sweeps of each tube at each of nine positions."""
    return sets.load("sim:T-REAL:1001:2")


@pytest.fixture(scope="module")
def given(tubes: Dataset) -> np.ndarray:
    """The features L of these sweeps."""
    return methods.model_inputs("L", tubes)


ESTIMATORS = {
    "gauss": lambda: baselines.Gauss(),
    "naive": lambda: baselines.Gauss(independent=True, first=2),
    "knn": lambda: baselines.knn(),
    "svm": lambda: baselines.svm(),
    "scaled knn": lambda: pipeline.make_pipeline(preprocessing.StandardScaler(), baselines.knn()),
    "linear svm": lambda: baselines.svm(kernel="linear"),
}


@pytest.mark.parametrize("present", [(0, 1), (1, 3), (0, 2, 4), (0, 1, 2, 3, 4, 5)])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_graph_is_the_estimator(name: str, present: tuple[int, ...]):
    """scikit-learn's scores over the temperature, as log probabilities; ABSENT without sweeps."""
    rng = np.random.default_rng(3)
    y = np.array(present)[rng.integers(0, len(present), 90)]
    x = (
        rng.normal(0, 1, (90, 5)) * [1, 10, 0.1, 5, 1]
        + 0.7 * y[:, None] * rng.normal(1, 0.2, 5)
        + [0, 100, 0, 0, 9]
    )
    estimator = ESTIMATORS[name]().fit(x[:60], y[:60])
    model = GraphModel(baselines.to_onnx(estimator, 6, 1.7))
    unseen = x[60:].astype(np.float32)
    if "knn" in name:
        scores = np.log(4 * estimator.predict_proba(unseen) + 0.1)
    else:
        scores = estimator.decision_function(unseen.astype(float))
        scores = np.stack([-scores, scores], axis=1) if scores.ndim == 1 else scores
    want = np.full((30, 6), baselines.ABSENT)
    want[:, present] = special.log_softmax(scores / 1.7, axis=1)
    got = model.logits(unseen)
    np.testing.assert_allclose(got, want, atol=1e-3)
    assert (got.argmax(1) == estimator.predict(unseen)).all()


def test_gauss_is_a_normal_distribution():
    """scipy's likelihoods, without covariances or features; finite with one sweep."""
    stats = Later("scipy.stats")
    rng = np.random.default_rng(1)
    y = np.repeat([0, 1, 2], 20)
    x = rng.normal(0, 1, (60, 3)) @ rng.normal(0, 1, (3, 3)) * [1, 30, 5] + y[:, None] + [5, 100, 9]
    for independent in (False, True):
        want = []
        for k in range(3):
            mine = x[y == k]
            covariance = (np.cov(mine.T, ddof=0) * 20 + np.diag(x.var(0))) / 21
            covariance = np.diag(np.diag(covariance)) if independent else covariance
            want.append(stats.multivariate_normal(mine.mean(0), covariance).logpdf(x))
        got = baselines.Gauss(independent).fit(x, y).decision_function(x)
        np.testing.assert_allclose(
            got - got[:, :1], np.array(want).T - np.array(want).T[:, :1], atol=1e-8
        )
        some = baselines.Gauss(independent, first=2)
        np.testing.assert_allclose(
            some.fit(x, y).decision_function(x),
            baselines.Gauss(independent).fit(x[:, :2], y).decision_function(x[:, :2]),
        )
    x = np.array([[0.0, 0, 7], [1, 1, 7], [5, 5, 7]])
    gauss = baselines.Gauss().fit(x, np.arange(3))
    assert gauss.predict(x + 0.1).tolist() == [0, 1, 2]
    assert np.isfinite(GraphModel(baselines.to_onnx(gauss, 3)).logits(x.astype(np.float32))).all()


def folds_of(sweeps: Dataset) -> list[tuple[np.ndarray, np.ndarray]]:
    """The folds that the temperature is found on; a warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return list(baselines._folds(sweeps))


def test_the_temperature_sees_whole_positions_or_recordings(tubes: Dataset):
    """Every sweep is held out once, with its position, or with its recording."""
    sweeps = tubes
    own = replace(
        sweeps, groups={"position": sweeps.labels, "recording": np.arange(len(sweeps)) // 2}
    )
    for some, name in ((sweeps, "position"), (own, "recording")):
        folds, group = folds_of(some), some.group(name)
        assert len(folds) == baselines.FOLDS
        assert sorted(np.concatenate([test for _, test in folds])) == list(range(len(sweeps)))
        assert not any(set(group[train]) & set(group[test]) for train, test in folds)
    rare = replace(sweeps, groups={}).take(
        (sweeps.labels > 0) | (np.cumsum(sweeps.labels == 0) < 3)
    )
    assert len(folds_of(rare)) == baselines.FOLDS


def test_without_anything_to_hold_out_the_temperature_is_one(tubes: Dataset, given: np.ndarray):
    """One recording of each material: no folds, and the plain estimator's logits."""
    sweeps = replace(tubes, groups={"recording": tubes.labels})
    assert not folds_of(sweeps)
    want = GraphModel(
        baselines.to_onnx(baselines.Gauss().fit(given.astype(float), sweeps.labels), 6)
    ).logits(given)
    np.testing.assert_array_equal(
        baselines.learn(baselines.Gauss, sweeps, given, 0).logits(given), want
    )


@pytest.mark.slow
@pytest.mark.parametrize(("strength", "most"), [(0.0, 0.62), (0.75, 0.8), (9.0, 1.0)])
@pytest.mark.parametrize("name", ["gauss", "knn", "svm"])
def test_probabilities_are_honest(name: str, strength: float, most: float):
    """Equal, overlapping or far apart: the label's probability is the accuracy within a tenth."""
    rng = np.random.default_rng(2)
    labels, truth = np.arange(80) % 2, np.arange(2000) % 2
    some = Dataset(np.zeros((80, 1, 1, 1), np.uint8), labels, ("a", "b"), 1.0)
    x, new = (
        (rng.normal(0, 1, (len(y), 3)) + strength * y[:, None]).astype(np.float32)
        for y in (labels, truth)
    )
    p = softmax(baselines.learn(ESTIMATORS[name], some, x, 0).logits(new))
    assert p.max(1).mean() == pytest.approx(np.mean(p.argmax(1) == truth), abs=0.1)
    assert p.max(1).mean() <= most
    if strength == 9:
        assert p.max(1).mean() > 0.95


@pytest.mark.parametrize(("index", "hint"), [([0, 0, 0, 0], "class"), ([0, -1], "2 sweeps")])
def test_too_little_to_learn_from_is_refused(
    tubes: Dataset, given: np.ndarray, index: list[int], hint: str
):
    """One material, and fewer sweeps than neighbours."""
    with pytest.raises(FormatError, match=hint):
        baselines.learn(baselines.Gauss, tubes.take(np.array(index)), given[index], 0)
