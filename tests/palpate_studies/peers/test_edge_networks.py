"""DS-CNN and the recipe of the edge tools: layers, features by definition, int8."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.bundle.onnx_check import reader
from palpate.core.types import SweepFormat
from palpate_studies import cost
from palpate_train.onnx_tools import graph_builder
from palpate_train.onnx_tools.quantize import quantize
from tests.factories.later import Later
from tests.factories.sweep_sets import easy

torch = Later("torch")
ds_cnn = Later("palpate_studies.peers.ds_cnn")
edge_spectral = Later("palpate_studies.peers.edge_spectral")


@pytest.mark.parametrize(
    ("window", "stride", "kernel"),
    [(1500, 30, 60), (128, 2, 10), (80, 1, 10), (24, 1, 10), (7, 1, 7)],
)
def test_the_first_convolution_leaves_about_fifty_steps(window: int, stride: int, kernel: int):
    """Its kernel has ten frames, or two strides of a long window; a shorter window is one step."""
    net = ds_cnn.DepthwiseSeparable(SweepFormat(2, 2, 100.0, window, "float32"), 3, 1.0)
    assert (net.stride, tuple(net.convs[0].weight.shape)) == (stride, (64, 4, kernel))
    assert net.eval().features(torch.zeros(1, 4, window)).shape == (1, 64)


def test_its_weights_and_work_are_those_of_depthwise_separable_layers():
    """Four blocks of 64 kernels of nine frames and 64 x 64 products, norms folded in."""
    form = SweepFormat(2, 2, 100.0, 128, "int16")
    graph = ds_cnn.DepthwiseSeparable(form, 3, 1.0).eval().graph()
    first, block, head, steps = 64 * 4 * 10 + 64, 64 * (9 + 1) + 64 * 65, 3 * 65, 60
    assert cost.weights(graph) == first + 4 * block + head
    # beside the layers: sums and means of the taxels
    layers = steps * (64 * 40 + 4 * 64 * (9 + 64)) + 64 * 3
    assert 0 <= cost.macs(graph) - layers <= 4 * 128 * 2


@pytest.mark.parametrize("classes", [3, 26])
def test_the_box_reads_its_int8_form(classes: int):
    """A head of more than a kilobyte was once marked as lying in another file."""
    form = SweepFormat(2, 2, 100.0, 128, "int16")
    sweeps = np.random.default_rng(1).integers(-99, 99, (8, 128, 2, 2), np.int16)
    network = ds_cnn.build(form, classes, sweeps).eval()
    model = quantize(network.graph(), sweeps, ds_cnn.INT8_NODES)
    assert reader.read(model.SerializeToString()).graph is not None
    np.testing.assert_allclose(
        graph_builder.run(model, sweeps), graph_builder.run(network.graph(), sweeps), atol=0.1
    )


@pytest.mark.parametrize(
    ("window", "length"),
    [(1500, 256), (600, 256), (427, 128), (128, 64), (80, 64), (24, 64), (1, 64)],
)
def test_the_transform_is_as_long_as_the_window_allows(window: int, length: int):
    """Its length is a power of two within half the window, from 64 to 256."""
    assert edge_spectral.transform_length(window) == length


@pytest.mark.parametrize("window", [1500, 128, 80, 24])
def test_the_features_are_the_definition(window: int):
    """numpy's FFT of half-overlapping Hann frames, zeros at the end; moments of each taxel."""
    rng = np.random.default_rng(2)
    x = rng.standard_normal((3, window)) * [[0.1], [1], [5]]
    x -= x.mean(1, keepdims=True)
    net = edge_spectral.SpectralNetwork(SweepFormat(3, 1, 100.0, window, "float32"), 2, 1.0)
    got = net.spectral(torch.from_numpy(x[None].astype(np.float32))).numpy()[0]
    length = edge_spectral.transform_length(window)
    padded = np.pad(x, ((0, 0), (0, max(length - window, 0))))
    hann = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
    starts = range(0, padded.shape[1] - length + 1, length // 2)
    power = np.mean(
        [np.abs(np.fft.rfft(padded[:, s : s + length] * hann)) ** 2 for s in starts], axis=0
    )[:, 1:]
    variance = (x**2).mean(1) + edge_spectral.FLOOR
    moments = [np.sqrt(variance), (x**3).mean(1) / variance**1.5, (x**4).mean(1) / variance**2 - 3]
    want = np.concatenate([*moments, np.log(power / (hann**2).sum() + edge_spectral.FLOOR).ravel()])
    np.testing.assert_allclose(got, want, atol=5e-3)


def test_features_are_standardised_on_the_training_sweeps():
    """Mean 0 and deviation 1 over the training sweeps; a constant feature stays finite."""
    s = easy(10)
    net = edge_spectral.build(s.format, 3, s.samples)
    with torch.no_grad():
        x = net.spectral(net.prepare(torch.from_numpy(s.samples.astype(np.float32))))
    z = ((x - net.centre) / net.spread).numpy()
    np.testing.assert_allclose(z.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(z.std(0), 1, atol=1e-3)
    flat = edge_spectral.build(s.format, 3, np.full_like(s.samples, 7))
    assert np.isfinite(graph_builder.run(flat.graph(), s.samples[:2])).all()
