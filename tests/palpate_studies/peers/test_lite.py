"""LITE: weights and filters are the published ones; the graph answers as the network."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.answer.objects import softmax
from palpate.bundle.onnx_check import reader
from palpate.core.types import SweepFormat
from palpate_studies import cost
from palpate_train.models import methods
from palpate_train.onnx_tools import graph_builder
from tests.factories.later import Later
from tests.factories.sweep_sets import easy

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


@pytest.mark.slow
@pytest.mark.thorough  # trains for seconds
def test_lite_has_an_int8_form_that_the_box_reads():
    """The int8 model has integer weights and answers nearly as the float model."""
    s = easy(12)
    (method,) = methods.find(["lite"], methods.Effort(0.05))
    model = method.train(s, s.samples, 1)
    assert (model.logits(s.samples).argmax(1) == s.labels).mean() > 0.8
    int8 = model.precisions["int8"]
    assert cost.precision(int8.graph()) == "int8"
    reader.read(int8.graph().SerializeToString())
    np.testing.assert_allclose(
        softmax(int8.logits(s.samples)), softmax(model.logits(s.samples)), atol=0.25
    )
