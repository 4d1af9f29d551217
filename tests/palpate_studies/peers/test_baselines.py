"""Every method on features, the paper's and its neighbours': learning, graph against estimator,
bundle."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import log_softmax
from scipy.stats import multivariate_normal
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.inference.classifier import Classifier, softmax
from palpate_studies.peers import baselines, prior_work
from palpate_studies.peers.baselines import ABSENT, FeatureModel, Gauss, knn, svm, to_onnx
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.models import methods
from palpate_train.models.methods import Method

METHODS = (*baselines.METHODS, *prior_work.METHODS)
by_name = pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)


class HeldOutSet:
    """A set, its features by kind, and the held-out sweeps."""

    def __init__(self, sweeps: Dataset, held: np.ndarray) -> None:
        self.sweeps, self.held, self.kinds = sweeps, held, {}
        self.models: dict[str, FeatureModel] = {}

    def given(self, kind: str) -> np.ndarray:
        """Features of all sweeps."""
        if kind not in self.kinds:
            self.kinds[kind] = methods.model_inputs(kind, self.sweeps)
        return self.kinds[kind]

    def model(self, method: Method) -> FeatureModel:
        """The method trained on the other sweeps."""
        if method.name not in self.models:
            train = self.sweeps.take(~self.held)
            self.models[method.name] = method.train(train, self.given(method.input)[~self.held], 0)
        return self.models[method.name]

    def accuracy(self, method: Method) -> float:
        """Accuracy on held-out sweeps; all logits must be finite."""
        logits = self.model(method).logits(self.given(method.input)[self.held])
        assert logits.dtype == np.float32
        assert logits.shape == (self.held.sum(), len(self.sweeps.materials))
        assert np.isfinite(logits).all()
        return float(np.mean(logits.argmax(1) == self.sweeps.labels[self.held]))


@pytest.fixture(scope="module")
def tubes() -> HeldOutSet:
    """Two sweeps of each tube at each of nine positions; three positions are held out."""
    sweeps = sets.load("sim:T-REAL:1001:2")
    return HeldOutSet(
        sweeps, np.isin(sweeps.groups["position"], np.unique(sweeps.groups["position"])[::3])
    )


def ripples(frames: int, rows: int, cols: int, rate_hz: float, dtype: str) -> Dataset:
    """Three materials of another skin: ripples that differ in frequency, strength and level, in
    noise; 24 sweeps."""
    rng, labels = np.random.default_rng(5), np.arange(24) % 3
    t = np.arange(frames)[:, None, None] / rate_hz
    phase = np.arange(rows * cols).reshape(rows, cols)
    samples = [
        500
        + 90 * k
        + rng.normal(0, 9, (frames, rows, cols))
        + 40 * (k + 1) * np.sin(2 * np.pi * rate_hz * (0.12 + 0.1 * k) * t + k * phase)
        for k in labels
    ]
    return Dataset(np.array(samples).astype(dtype), labels, ("a", "b", "c"), rate_hz)


@by_name
def test_every_method_learns(method: Method, tubes: HeldOutSet):
    """At unseen positions the accuracy is far above the chance of one in six."""
    assert tubes.accuracy(method) > 0.4


@pytest.mark.slow
@by_name
@pytest.mark.parametrize("removed", [False, True])
def test_every_method_takes_another_skin(method: Method, removed: bool):
    """3x3 taxels at 100 Hz in int16, and 16x1 at 120 Hz in float32 without means: three materials
    are separated."""
    sweeps = (
        ripples(128, 16, 1, 120.0, "float32").without_means()
        if removed
        else ripples(200, 3, 3, 100.0, "int16")
    )
    held = np.arange(len(sweeps)) >= 15
    assert HeldOutSet(sweeps, held).accuracy(method) > 0.8


@by_name
def test_broken_readings_get_finite_logits(method: Method, tubes: HeldOutSet):
    """Silent and saturated sweeps, and features as large as float32 holds."""
    still = [np.full_like(tubes.sweeps.samples[0], level) for level in (0, 255)]
    rows = [methods.kinds.compute(method.input, x, tubes.sweeps.rate_hz) for x in still]
    rows += [np.full_like(rows[0], value) for value in (0, 3e38, -3e38)]
    assert np.isfinite(tubes.model(method).logits(np.array(rows))).all()


@by_name
def test_training_twice_gives_the_same_bytes(method: Method, tubes: HeldOutSet):
    """The same arguments give the same model; so does another seed, because nothing is random."""
    train = tubes.sweeps.take(~tubes.held)
    given = tubes.given(method.input)[~tubes.held]
    again = method.train(train, given.copy(), 1).graph()
    assert again.SerializeToString() == tubes.model(method).graph().SerializeToString()


@pytest.mark.parametrize("method", [m for m in METHODS if m.runs_on_the_box], ids=lambda m: m.name)
def test_a_bundle_of_it_runs_on_the_box(method: Method, tubes: HeldOutSet, tmp_path: Path):
    """Manifest, graph and golden sweeps in a folder: the box's classifier gives the model's logits
    from raw counts."""
    model, held = tubes.model(method), np.flatnonzero(tubes.held)[:4]
    golden, packed = io.BytesIO(), tubes.sweeps.samples[held]
    logits = model.logits(tubes.given(method.input)[held])
    np.savez_compressed(golden, samples=packed, logits=logits)
    files = {bundle.MODEL: model.graph().SerializeToString(), bundle.GOLDEN: golden.getvalue()}
    manifest = bundle.Manifest(
        "test",
        "1",
        tubes.sweeps.format,
        method.input,
        tubes.sweeps.materials,
        bundle.Thresholds(1, 255),
        {name: bundle.file_entry(content) for name, content in files.items()},
    )
    for name, content in (files | {bundle.MANIFEST: manifest.json()}).items():
        (tmp_path / name).write_bytes(content)
    box = Classifier(bundle.load(tmp_path), SystemClock())
    assert box.self_test() < 1e-6
    np.testing.assert_allclose(np.stack([box.logits(x) for x in packed]), logits, atol=1e-6)


ESTIMATORS = {
    "gauss": Gauss,
    "naive": lambda: Gauss(independent=True, first=2),
    "knn": knn,
    "svm": svm,
    "scaled knn": lambda: make_pipeline(StandardScaler(), knn()),
    "linear svm": lambda: svm(kernel="linear"),
}


@pytest.mark.parametrize("present", [(0, 1), (1, 3), (0, 2, 4), (0, 1, 2, 3, 4, 5)])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_graph_is_the_estimator(name: str, present: tuple[int, ...]):
    """The graph gives scikit-learn's scores over the temperature, as log probabilities; a class
    without a sweep has ABSENT."""
    rng = np.random.default_rng(3)
    y = np.array(present)[rng.integers(0, len(present), 90)]
    x = (
        rng.normal(0, 1, (90, 5)) * [1, 10, 0.1, 5, 1]
        + 0.7 * y[:, None] * rng.normal(1, 0.2, 5)
        + [0, 100, 0, 0, 9]
    )
    estimator = ESTIMATORS[name]().fit(x[:60], y[:60])
    model = FeatureModel(to_onnx(estimator, 6, 1.7))
    unseen = x[60:].astype(np.float32)
    if "knn" in name:
        scores = np.log(4 * estimator.predict_proba(unseen) + 0.1)
    else:
        scores = estimator.decision_function(unseen.astype(float))
        scores = np.stack([-scores, scores], axis=1) if scores.ndim == 1 else scores
    want = np.full((30, 6), ABSENT)
    want[:, present] = log_softmax(scores / 1.7, axis=1)
    got = model.logits(unseen)
    np.testing.assert_allclose(got, want, atol=1e-3)
    assert (got.argmax(1) == estimator.predict(unseen)).all()


def test_gauss_is_a_normal_distribution():
    """Log likelihoods are scipy's, with one pseudo-sweep of the whole set's spread; `independent`
    drops covariances.

    With `first`, features after the first ones change nothing.
    """
    rng = np.random.default_rng(1)
    y = np.repeat([0, 1, 2], 20)
    x = rng.normal(0, 1, (60, 3)) @ rng.normal(0, 1, (3, 3)) * [1, 30, 5] + y[:, None] + [5, 100, 9]
    for independent in (False, True):
        want = []
        for k in range(3):
            mine = x[y == k]
            covariance = (np.cov(mine.T, ddof=0) * 20 + np.diag(x.var(0))) / 21
            covariance = np.diag(np.diag(covariance)) if independent else covariance
            want.append(multivariate_normal(mine.mean(0), covariance).logpdf(x))
        got = Gauss(independent).fit(x, y).decision_function(x)
        np.testing.assert_allclose(
            got - got[:, :1], np.array(want).T - np.array(want).T[:, :1], atol=1e-8
        )
        some = Gauss(independent, first=2)
        np.testing.assert_allclose(
            some.fit(x, y).decision_function(x),
            Gauss(independent).fit(x[:, :2], y).decision_function(x[:, :2]),
        )


def test_gauss_bears_little_and_collinear():
    """With one sweep of a class, a copy of a feature and a constant feature, the nearest mean wins
    and everything is finite."""
    x = np.array([[0.0, 0, 7], [1, 1, 7], [5, 5, 7]])
    gauss = Gauss().fit(x, np.arange(3))
    assert gauss.predict(x + 0.1).tolist() == [0, 1, 2]
    assert np.isfinite(FeatureModel(to_onnx(gauss, 3)).logits(x)).all()


def test_a_material_that_training_lacks_is_never_named(tubes: HeldOutSet):
    """Five of six materials in training: the sixth has the lowest finite logit, and its sweeps get
    another label."""
    known, given = np.flatnonzero(tubes.sweeps.labels != 2), tubes.given("L")
    for make in (Gauss, knn, svm):
        logits = baselines.learn(make, tubes.sweeps.take(known), given[known], 0).logits(given)
        assert logits.shape[1] == 6
        np.testing.assert_allclose(logits[:, 2], ABSENT, rtol=1e-6)
        assert not (logits.argmax(1) == 2).any()


def folds_of(sweeps: Dataset) -> list[tuple[np.ndarray, np.ndarray]]:
    """The folds that the temperature is found on; a warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return list(baselines._folds(sweeps))


def test_the_temperature_sees_whole_positions_or_recordings(tubes: HeldOutSet):
    """Every sweep is held out once, with its position; if each material has its own position, with
    its recording. A material of two sweeps works as well."""
    sweeps = tubes.sweeps
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


def test_without_anything_to_hold_out_the_temperature_is_one(tubes: HeldOutSet):
    """With one recording of each material there are no folds, and the model's logits are those of
    the plain estimator."""
    sweeps = replace(tubes.sweeps, groups={"recording": tubes.sweeps.labels})
    assert not folds_of(sweeps)
    given = tubes.given("L")
    want = FeatureModel(to_onnx(Gauss().fit(given.astype(float), sweeps.labels), 6)).logits(given)
    np.testing.assert_array_equal(baselines.learn(Gauss, sweeps, given, 0).logits(given), want)


@pytest.mark.slow
@pytest.mark.parametrize(("strength", "most"), [(0.0, 0.62), (0.75, 0.8), (9.0, 1.0)])
@pytest.mark.parametrize("make", [Gauss, knn, svm])
def test_probabilities_are_honest(
    make: Callable[[], baselines.Estimator], strength: float, most: float
):
    """For two materials that are equal, overlap or are far apart, the mean probability of the label
    is its accuracy within a tenth."""
    rng = np.random.default_rng(2)
    labels, truth = np.arange(80) % 2, np.arange(2000) % 2
    some = Dataset(np.zeros((80, 1, 1, 1), np.uint8), labels, ("a", "b"), 1.0)
    x, new = (
        (rng.normal(0, 1, (len(y), 3)) + strength * y[:, None]).astype(np.float32)
        for y in (labels, truth)
    )
    p = softmax(baselines.learn(make, some, x, 0).logits(new))
    assert p.max(1).mean() == pytest.approx(np.mean(p.argmax(1) == truth), abs=0.1)
    assert p.max(1).mean() <= most
    if strength == 9:
        assert p.max(1).mean() > 0.95


@pytest.mark.parametrize(
    ("index", "hint"), [([0, 0, 0, 0], "only one class"), ([0, -1], "2 sweeps are too few")]
)
def test_too_little_to_learn_from_is_refused(tubes: HeldOutSet, index: list[int], hint: str):
    """One material, and fewer sweeps than neighbours, are refused."""
    with pytest.raises(FormatError, match=hint):
        METHODS[0].train(tubes.sweeps.take(np.array(index)), tubes.given("L")[index], 0)
