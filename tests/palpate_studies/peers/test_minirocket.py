"""MiniRocket: its graph against the definition and against aeon, and its head."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate.inference.classifier import softmax
from palpate.inference.session import session
from palpate_studies.peers import minirocket
from palpate_train.data.sets import Dataset
from palpate_train.models import linear_head
from palpate_train.onnx_tools import graph_builder
from tests.factories.sweep_sets import easy

KINDS = {"uint8": (2, 2, 64), "int16": (3, 3, 40), "uint16": (1, 1, 9), "float32": (16, 1, 33)}


def raw_counts(dtype: str, n: int = 3) -> np.ndarray:
    """Random walks [n, T, R, C] with the grid and length of the type in KINDS; float32 without
    their means."""
    rows, cols, window = KINDS[dtype]
    rng = np.random.default_rng(7)
    walk = 100 + rng.integers(-3, 4, (n, window, rows, cols)).cumsum(axis=1)
    walk = (
        walk + rng.standard_normal(walk.shape) - walk.mean(axis=1, keepdims=True)
        if dtype == "float32"
        else walk
    )
    return walk.astype(dtype)


def parameters(window: int, taxels: int) -> tuple[np.ndarray, ...]:
    """A transform made up: all dilations that fit, one to three taxels a kernel, biases between
    integer counts."""
    rng = np.random.default_rng(3)
    dilations = np.arange(1, (window - 1) // 8 + 1)
    per_kernel = rng.integers(1, 4, len(dilations))
    counts = rng.integers(1, min(taxels, 3) + 1, 84 * len(dilations))
    chosen = np.concatenate([rng.choice(taxels, n, replace=False) for n in counts])
    return counts, chosen, dilations, per_kernel, rng.integers(-40, 40, 84 * per_kernel.sum()) + 0.5


def by_definition(sweep: np.ndarray, found: tuple[np.ndarray, ...]) -> np.ndarray:
    """Dempster et al. 2021, frame by frame: shares above each bias, of counts [T, R, C]."""
    counts, chosen, dilations, per_kernel, biases = found
    x = sweep.reshape(len(sweep), -1).astype(np.float64)
    taxels, left, shares = iter(np.split(chosen, np.cumsum(counts)[:-1])), iter(biases), []
    for i, (dilation, n) in enumerate(zip(dilations, per_kernel, strict=True)):
        for k, two in enumerate(combinations(range(9), 3)):
            series = np.pad(x[:, next(taxels)].sum(axis=1), 4 * dilation)
            out = sum(
                (2 if tap in two else -1) * series[tap * dilation :][: len(x)] for tap in range(9)
            )
            out = out if (i + k) % 2 == 0 else out[4 * dilation : len(x) - 4 * dilation]
            shares += [np.mean(out > next(left)) for _ in range(n)]
    return np.array(shares)


@pytest.mark.parametrize("dtype", KINDS)
def test_the_graph_is_the_definition(dtype: str):
    """Kernels, dilations, sums over taxels, alternating padding, shares above biases: any grid,
    data type and length."""
    sweep, (rows, cols, window) = raw_counts(dtype)[0], KINDS[dtype]
    found = parameters(window, rows * cols)
    graph = minirocket.transform(SweepFormat(rows, cols, 50.0, window, dtype), found)
    np.testing.assert_allclose(
        graph_builder.run(graph, sweep[None])[0], by_definition(sweep, found), rtol=0, atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_the_features_are_aeons(monkeypatch: pytest.MonkeyPatch, dtype: str):
    """The shares are aeon's, in its order: exactly for integer counts, else unless a frame equals a
    bias within rounding."""
    aeon = pytest.importorskip("aeon.transformations.collection.convolution_based")
    monkeypatch.setattr(minirocket, "FEATURES", 1000)
    given, (rows, cols, window) = raw_counts(dtype), KINDS[dtype]
    graph = minirocket.transform(
        SweepFormat(rows, cols, 50.0, window, dtype), minirocket.fitted(given, 5)
    )
    series = np.ascontiguousarray(
        given.reshape(len(given), window, -1).transpose(0, 2, 1), np.float32
    )
    want = aeon.MiniRocket(1000, random_state=5).fit(series).transform(series)
    off = np.abs(graph_builder.run(graph, given) - want)
    assert want.shape[1] == 924
    assert np.mean(off > 1e-6) < (0.01 if dtype == "float32" else 1e-9)
    assert off.max() <= 2 / (window - 8 * ((window - 1) // 8))


@pytest.mark.slow
def test_the_labels_are_aeons(monkeypatch: pytest.MonkeyPatch):
    """The whole method answers as aeon's own classifier, also for sweeps that are hard to
    separate."""
    aeon = pytest.importorskip("aeon.classification.convolution_based")
    monkeypatch.setattr(minirocket, "FEATURES", 500)
    sweeps = easy(20)
    noise = np.random.default_rng(1).normal(0, 40, sweeps.samples.shape)
    sweeps = replace(sweeps, samples=np.clip(sweeps.samples + noise, 0, 255).astype(np.uint8))
    train, test = sweeps.split("recording", 0.5, 0)
    series = [
        np.ascontiguousarray(s.samples.reshape(len(s), 64, -1).transpose(0, 2, 1), np.float32)
        for s in (train, test)
    ]
    want = (
        aeon.MiniRocketClassifier(500, random_state=2)
        .fit(series[0], train.labels)
        .predict(series[1])
    )
    logits = minirocket.train(train, train.samples, 2).logits(test.samples)
    assert 0.4 < np.mean(want == test.labels) < 1
    np.testing.assert_array_equal(logits.argmax(1), want)


def head(sweeps: Dataset) -> linear_head.LinearHeadModel:
    """A ridge on made-up features, which need no aeon."""
    graph = minirocket.transform(sweeps.format, parameters(sweeps.format.window, 4))
    return linear_head.train_linear_head(graph, minirocket._ridge, sweeps, sweeps.samples, 0)


def test_the_box_gives_the_logits():
    """The graph in the box's session names an easy set with high probability, and is finite for
    constant sweeps."""
    sweeps, other = easy(20), easy(20, seed=1)
    model = head(sweeps)
    run = session(model.graph().SerializeToString())
    box = np.concatenate([run.run(None, {"sweep": sweep[None]})[0] for sweep in other.samples])
    np.testing.assert_array_equal(box, model.logits(other.samples))
    assert np.mean(box.argmax(1) == other.labels) > 0.95
    assert softmax(box).max(1).mean() > 0.9
    assert np.isfinite(model.logits(np.full((1, 64, 2, 2), 255, np.uint8))).all()


def test_a_material_not_trained_on_is_never_said():
    """Its logit is far below the others. The two trained materials are separated, although
    scikit-learn gives one row for them."""
    sweeps = easy(20)
    two = sweeps.take(sweeps.labels != 1)
    logits = head(two).logits(sweeps.samples)
    assert logits.shape == (60, 3)
    assert softmax(logits)[:, 1].max() < 1e-12
    assert np.mean(logits[sweeps.labels != 1].argmax(1) == two.labels) > 0.95


def test_the_temperature_comes_from_held_out_groups():
    """The first head misses whole recordings, the second none; random labels give uncertain
    probabilities."""
    seen: list[np.ndarray] = []

    def spy(features: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen.append(features)
        return minirocket._ridge(features, labels)

    sweeps = easy(20, pieces=4)
    graph = minirocket.transform(sweeps.format, parameters(64, 4))
    linear_head.train_linear_head(graph, spy, sweeps, sweeps.samples, 0)
    every = graph_builder.run(graph, sweeps.samples)
    there = np.array([(row == seen[0]).all(axis=1).any() for row in every])
    assert all(np.ptp(there[sweeps.group("recording") == r].astype(int)) == 0 for r in range(15))
    assert there.sum() == 48
    np.testing.assert_array_equal(seen[1], every)
    blind = replace(
        sweeps, labels=np.random.default_rng(0).permutation(np.repeat(np.arange(3), 5)).repeat(4)
    )
    assert softmax(head(blind).logits(easy(20, seed=1).samples)).max(1).mean() < 0.6


@pytest.mark.slow
def test_a_seed_gives_one_model_and_leaves_numpy_alone(monkeypatch: pytest.MonkeyPatch):
    """The same seed gives the same bytes, another seed others; numpy's global stream goes on
    unchanged."""
    pytest.importorskip("aeon")
    monkeypatch.setattr(minirocket, "FEATURES", 168)
    sweeps = easy(8)
    np.random.seed(4)
    want = np.random.random(3)
    np.random.seed(4)
    graphs = [
        minirocket.train(sweeps, sweeps.samples, seed).graph().SerializeToString()
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(np.random.random(3), want)
    assert graphs[0] == graphs[1] != graphs[2]


def test_what_cannot_be_trained_is_named(monkeypatch: pytest.MonkeyPatch):
    """A window that is too short, a missing aeon, and one material are refused."""
    sweeps = easy(8)
    short = replace(sweeps, samples=sweeps.samples[:, :8])
    with pytest.raises(FormatError, match="a window of 8 frames is too short for minirocket"):
        minirocket.train(short, short.samples, 0)
    one = sweeps.take(sweeps.labels == 2)
    with pytest.raises(FormatError, match="only one class, 'high'"):
        minirocket.train(one, one.samples, 0)
    monkeypatch.setitem(sys.modules, "aeon.transformations.collection.convolution_based", None)
    with pytest.raises(FormatError, match=r"pip install 'palpate-train\[peers\]'"):
        minirocket.train(sweeps, sweeps.samples, 0)
