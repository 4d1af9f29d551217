"""MiniRocket, its augmented form, and LITE."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from palpate.answer.objects import softmax
from palpate.core.types import SweepFormat
from palpate_train.data.augment import copies
from palpate_train.data.sets import Dataset
from palpate_train.onnx_tools import graph_builder
from tests.factories.later import Later
from tests.factories.sweep_sets import easy

minirocket = Later("palpate_studies.peers.minirocket")

KINDS = {"uint8": (2, 2, 64), "int16": (3, 3, 40), "uint16": (1, 1, 9), "float32": (16, 1, 33)}


def raw_counts(dtype: str, n: int = 3) -> np.ndarray:
    """Random walks [n, T, R, C] as KINDS says for the type; float32 without their means."""
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
    """A transform made up: all dilations that fit, one to three taxels a kernel."""
    rng = np.random.default_rng(3)
    dilations = np.arange(1, (window - 1) // 8 + 1)
    per_kernel = rng.integers(1, 4, len(dilations))
    counts = rng.integers(1, min(taxels, 3) + 1, 84 * len(dilations))
    chosen = np.concatenate([rng.choice(taxels, n, replace=False) for n in counts])
    return counts, chosen, dilations, per_kernel, rng.integers(-40, 40, 84 * per_kernel.sum()) + 0.5


@pytest.mark.parametrize("dtype", KINDS)
def test_the_graph_is_the_definition(dtype: str):
    """Kernels, dilations, sums, alternating padding, shares: any grid, type and length."""

    def by_definition(sweep: np.ndarray, found: tuple[np.ndarray, ...]) -> np.ndarray:
        """Dempster et al. 2021, frame by frame: shares above each bias, of counts [T, R, C]."""
        counts, chosen, dilations, per_kernel, biases = found
        x = sweep.reshape(len(sweep), -1).astype(np.float64)
        taxels, left, shares = iter(np.split(chosen, np.cumsum(counts)[:-1])), iter(biases), []
        for i, (dilation, n) in enumerate(zip(dilations, per_kernel, strict=True)):
            for k, two in enumerate(combinations(range(9), 3)):
                series = np.pad(x[:, next(taxels)].sum(axis=1), 4 * dilation)
                out = sum(
                    (2 if tap in two else -1) * series[tap * dilation :][: len(x)]
                    for tap in range(9)
                )
                out = out if (i + k) % 2 == 0 else out[4 * dilation : len(x) - 4 * dilation]
                shares += [np.mean(out > next(left)) for _ in range(n)]
        return np.array(shares)

    sweep, (rows, cols, window) = raw_counts(dtype)[0], KINDS[dtype]
    found = parameters(window, rows * cols)
    graph = minirocket.transform(SweepFormat(rows, cols, 50.0, window, dtype), found)
    np.testing.assert_allclose(
        graph_builder.run(graph, sweep[None])[0], by_definition(sweep, found), rtol=0, atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_the_features_are_aeons(monkeypatch: pytest.MonkeyPatch, dtype: str):
    """aeon's shares in its order, exact for integers, close for floats."""
    aeon = pytest.importorskip("aeon.transformations.collection.convolution_based")
    monkeypatch.setattr("palpate_studies.peers.minirocket.FEATURES", 1000)
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
    """The whole method answers as aeon's own classifier, also on hard sweeps."""
    aeon = pytest.importorskip("aeon.classification.convolution_based")
    monkeypatch.setattr("palpate_studies.peers.minirocket.FEATURES", 500)
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


def test_the_temperature_comes_from_held_out_groups():
    """The first head misses recordings, the second none; random labels are uncertain."""
    linear_head = Later("palpate_studies.peers.linear_head")

    def head(sweeps: Dataset) -> graph_builder.GraphModel:
        """A ridge on made-up features, which need no aeon."""
        graph = minirocket.transform(sweeps.format, parameters(sweeps.format.window, 4))
        return linear_head.train_linear_head(graph, minirocket._ridge, sweeps, sweeps.samples, 0)

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


minirocket_augmented = Later("palpate_studies.peers.minirocket_augmented")


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_copies_keep_label_and_recording_of_their_sweep(
    dtype: str, monkeypatch: pytest.MonkeyPatch
):
    """There are two copies of each sweep, after the sweeps themselves; no two copies are equal."""
    seen: list[tuple[Dataset, np.ndarray]] = []
    monkeypatch.setattr(
        "palpate_studies.peers.minirocket.train",
        lambda sweeps, inputs, seed: seen.append((sweeps, inputs)),
    )
    sweeps = easy(6, pieces=2, dtype=dtype)
    minirocket_augmented.train(sweeps, sweeps.samples, 1)
    minirocket_augmented.train(replace(sweeps, groups={}), sweeps.samples, 1)
    changed = copies(sweeps, minirocket_augmented.augmentation(64), 1, 2)
    for copy, start in zip(changed, (18, 36), strict=True):
        np.testing.assert_array_equal(seen[0][1][start : start + 18], copy.samples)
    for several, inputs in seen:
        np.testing.assert_array_equal(several.labels, np.tile(sweeps.labels, 3))
        np.testing.assert_array_equal(inputs[:18], sweeps.samples)
        assert inputs.dtype == dtype
        assert not np.array_equal(inputs[18:36], inputs[36:])
    np.testing.assert_array_equal(
        seen[0][0].group("recording"), np.tile(sweeps.group("recording"), 3)
    )
    np.testing.assert_array_equal(seen[1][0].group("recording"), np.tile(np.arange(18), 3))


torch = Later("torch")
lite = Later("palpate_studies.peers.lite")


def test_it_has_as_many_weights_as_published():
    """9,814 below the head for one series, as in the paper; detectors are not trained."""
    network = lite.Lite(SweepFormat(1, 1, 100.0, 200, "int16"), 3, 1.0)
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) == 9814 + 3 * 33
    assert not any(p.requires_grad for p in network.detectors.parameters())


def test_the_detectors_find_what_they_are_named_after():
    """Two opposite rises for each length; a peak's weights sum to zero around its hump."""
    np.testing.assert_array_equal(lite.rise_and_fall(4), [[-1, 1, -1, 1], [1, -1, 1, -1]])
    np.testing.assert_allclose(
        lite.peak(8), [[-0.25, -1, -1, -0.25, 0.5, 2, 2, 0.5, -0.25, -1, -1, -0.25]]
    )


@pytest.mark.parametrize(
    ("steps", "stride", "taps", "dilation"), [(20, 1, 6, 2), (23, 4, 5, 1), (7, 1, 64, 1)]
)
def test_a_same_convolution_keeps_the_steps(steps: int, stride: int, taps: int, dilation: int):
    """For any kernel length, one step in each stride is left."""
    conv = lite.SameConv(1, 1, taps, stride, dilation)
    assert conv(torch.zeros(1, 1, steps)).shape == (1, 1, -(-steps // stride))
    before, after = conv.ends(steps)
    assert 0 <= after - before <= 1


@pytest.mark.parametrize(("rows", "window"), [(1, 90), (3, 600), (2, 7)])
def test_the_graph_answers_as_the_network(rows: int, window: int):
    """Norms folded in; one taxel and several, a window with a stride and a short one."""
    form = SweepFormat(rows, 1, 100.0, window, "int16")
    sweeps = np.random.default_rng(1).integers(-99, 99, (8, window, rows, 1), np.int16)
    network, counts = lite.build(form, 5, sweeps), torch.from_numpy(sweeps.astype(np.float32))
    for norm in (
        module for module in network.modules() if isinstance(module, torch.nn.BatchNorm1d)
    ):
        torch.nn.init.normal_(norm.weight, 1, 0.3)
        torch.nn.init.normal_(norm.bias, 0, 0.3)
    with torch.no_grad():
        network.train()(counts)  # moves the means of the norms
        want = network.eval()(counts).numpy()
    np.testing.assert_allclose(graph_builder.run(network.graph(), sweeps), want, atol=1e-5)
