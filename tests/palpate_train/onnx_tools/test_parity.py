"""Float against int8: the loss of accuracy with its interval, the range of each tensor, and its
saturation."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx import numpy_helper

from palpate.core.errors import FormatError
from palpate_train.export import quantized_bundle
from palpate_train.models.recipe import stages
from palpate_train.models.recipe.fitted import Fit
from palpate_train.onnx_tools import parity
from palpate_train.onnx_tools.parity import Layer
from palpate_train.onnx_tools.quantize import quantize
from tests.factories.parity import close
from tests.factories.sweep_sets import easy
from tests.factories.trained_stages import with_stages

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit with trained stages."""
    return with_stages(close(), steps=60)


def measured(fitted: Fit) -> parity.Parity:
    """The comparison of its two precisions on its held-out sweeps."""
    reference, int8 = quantized_bundle.graphs(fitted)
    return parity.measure(int8, fitted.held.samples, fitted.held.labels, reference)


def activations(found: parity.Parity) -> list[Layer]:
    """Its rounded tensors after convolutions, in order."""
    return [
        layer for layer in found.layers if layer.kind == "activations" and layer.against == "float"
    ]


def booleans(n: int, wrong: list[int]) -> np.ndarray:
    """All right except those in `wrong`."""
    right = np.ones(n, bool)
    right[wrong] = False
    return right


def test_what_is_lost_is_counted_in_pairs():
    """Three sweeps lost, one won, checked by hand with the halves of Agresti and Min; no loss in a
    hundred does not prove that there is none."""
    lost = parity.loss(booleans(50, [7]), booleans(50, [1, 2, 3]))
    assert (lost.total, lost.float_right, lost.int8_right, lost.lost) == (
        50,
        49,
        47,
        pytest.approx(0.04),
    )
    middle = (3.5 - 1.5) / 52
    reach = 1.96 * np.sqrt((5 / 52 - middle**2) / 52)
    assert (lost.low, lost.high) == (pytest.approx(middle - reach), pytest.approx(middle + reach))
    none = parity.loss(booleans(100, [4]), booleans(100, [4]))
    assert (none.lost, none.low) == (0, pytest.approx(-none.high))
    assert 0.01 < none.high < 0.03


def test_the_interval_holds_what_it_promises():
    """In 400 draws of 80 sweeps, where int8 loses 4 % and wins 2 %, at least 93 % of the intervals
    hold the truth."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(400):
        kind = rng.choice(4, 80, p=[0.04, 0.02, 0.84, 0.1])  # lost, won, both right, both wrong
        lost = parity.loss(np.isin(kind, (0, 2)), np.isin(kind, (1, 2)))
        held += lost.low <= 0.02 <= lost.high
    assert held >= 0.93 * 400


def test_sweeps_that_fail_together_count_together():
    """If all losses are in one of five recordings, the interval is wider than if they are
    spread."""
    wrong = booleans(50, list(range(5)))
    alone, together = (
        parity.loss(np.ones(50, bool), wrong, of) for of in (None, np.arange(50) // 10)
    )
    assert together.low <= alone.low
    assert together.high > alone.high
    assert parity.loss(np.ones(50, bool), wrong, np.arange(50) // 10) == together


def test_differences_by_hand():
    """The common part of logits does not count; maximum and mean of the probability differences are
    over sweeps."""
    want = np.float32([[1, 0], [0, 0.1]])
    have = np.float32([[6, 5], [0.3, 0]])
    apart = parity.compare(want, have)
    moved = 1 / (1 + np.exp(-0.3)) - 1 / (1 + np.exp(0.1))
    assert apart.agreement == 0.5
    assert apart.probability_difference == pytest.approx(moved, abs=1e-6)
    assert apart.probability_mean == pytest.approx(moved / 2, abs=1e-6)
    assert (apart.logit_difference, apart.logit_mean) == (
        pytest.approx(0.2, abs=1e-6),
        pytest.approx(0.1, abs=1e-6),
    )


def test_tensors_are_reported_as_pytorch_has_them(fitted: Fit):
    """Percentiles and the share out of range of each stage, compared with its responses in PyTorch;
    weights of seven bits."""
    found = measured(fitted)
    model = stages.network_of(fitted)
    with torch.no_grad():
        counts = torch.from_numpy(fitted.held.samples.astype(np.float32))
        responses = [x.numpy() for x in model.responses(model.prepare(counts))]
    layers = activations(found)
    assert len(layers) == len(responses)
    for layer, x in zip(layers, responses, strict=True):
        np.testing.assert_allclose(
            layer.percentiles, np.percentile(x, parity.PERCENTILES), atol=1e-4
        )
        assert layer.low == 0
        assert layer.high == pytest.approx(255 * layer.step)
        assert layer.saturated == pytest.approx(np.mean(x > layer.high + layer.step / 2), abs=2e-4)
        assert 20 < layer.sqnr_db < 50
    weights = [layer for layer in found.layers if layer.kind == "weights"]
    assert len(weights) == len(responses)
    assert all(35 < layer.sqnr_db < 50 for layer in weights)


def test_a_layer_that_saturates_is_the_one_that_is_named(fitted: Fit):
    """A stage whose range is a fifth: its values are cut off and its signal is lost in noise;
    earlier stages are unchanged."""
    *before, last = fitted.ranges.responses
    broken = replace(fitted, ranges=replace(fitted.ranges, responses=(*before, last / 5)))
    whole, cut = (activations(measured(one)) for one in (fitted, broken))
    assert cut[:-1] == whole[:-1]
    assert whole[-1].saturated < 0.005 < 0.1 < cut[-1].saturated
    assert cut[-1].sqnr_db < 12 < whole[-1].sqnr_db


def test_a_tap_that_was_moved_is_found(fitted: Fit):
    """Taps that sum to zero, then one of them increased: an offset can now change the first
    convolution."""
    _, int8 = quantized_bundle.graphs(fitted)
    conv = next(n for n in int8.graph.node if n.op_type == "Conv")
    maker = next(n for n in int8.graph.node if conv.input[1] in n.output)
    held = next(c for c in int8.graph.initializer if c.name == maker.input[0])
    taps = np.random.default_rng(0).integers(-4, 5, held.dims).astype(np.int8)
    taps[..., -1] -= taps.sum(axis=2).astype(np.int8)
    held.CopyFrom(numpy_helper.from_array(taps, held.name))
    assert parity.tap_sum(int8) == 0
    taps[2, 1, 0] += 1
    held.CopyFrom(numpy_helper.from_array(taps, held.name))
    assert parity.tap_sum(int8) == 1


def test_any_quantized_graph_can_be_compared(fitted: Fit):
    """Tensors that onnxruntime quantizes are matched to the float graph too, after the ReLU."""
    reference, _ = quantized_bundle.graphs(fitted)
    int8 = quantize(reference, fitted.train.samples)
    found = parity.measure(int8, fitted.held.samples, fitted.held.labels, reference)
    assert len(activations(found)) == len(fitted.architecture.channels)
    assert all(layer.sqnr_db > 15 for layer in activations(found))
    assert found.tap_sum > 0


def test_a_bundle_is_compared_without_float(fitted: Fit):
    """Each tensor against its value before rounding; a graph without int8 is refused by name."""
    reference, int8 = quantized_bundle.graphs(fitted)
    found = parity.measure(int8, fitted.held.samples, fitted.held.labels)
    assert (found.answers, found.accuracy, {layer.against for layer in found.layers}) == (
        None,
        None,
        {"itself"},
    )
    assert len(found.layers) >= len(fitted.architecture.channels)
    assert "holds no float model" in parity.table(found)
    with pytest.raises(FormatError, match="no int8 tensors"):
        parity.measure(reference, fitted.held.samples, fitted.held.labels)


def test_the_command_reports_fits_and_bundles(fitted: Fit, tmp_path: Path):
    """Table and JSON of both; a set of another format is refused by name."""
    fitted.save(tmp_path / "fit.npz")
    quantized_bundle.export(fitted, tmp_path / "bundle", "close", "1", "")
    table = quantized_bundle.compared(tmp_path / "fit.npz", fitted.held, tmp_path / "parity.json")
    figures = json.loads((tmp_path / "parity.json").read_bytes())
    assert figures["accuracy"]["total"] == len(fitted.held)
    assert len(figures["layers"]) == len(measured(fitted).layers)
    assert figures["set"] == "close"
    assert [line.split()[0] for line in table.splitlines()[:3]] == ["labels", "float", "first"]
    assert "holds no float model" in quantized_bundle.compared(tmp_path / "bundle", fitted.held)
    with pytest.raises(
        FormatError, match=r"fit.npz is of 2x2 uint8 .* name a set of the same kind"
    ):
        quantized_bundle.compared(tmp_path / "fit.npz", easy(dtype="int16"))
