"""The costs that are counted in a graph: weights and multiply-accumulates."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from palpate.core.errors import FormatError
from palpate.sim import skin
from palpate_studies import cost
from palpate_train.onnx_tools.quantize import quantize
from tests.factories.loud_model import loudness, sweeps


def test_weights_products_and_transforms_are_counted():
    """By hand; int8 the same, without scales; L and H have their transforms."""
    plain, whole = loudness(), quantize(loudness(), sweeps().samples)
    assert cost.precision(plain) == "float"
    assert cost.precision(whole) == "int8"
    assert cost.macs(plain) == cost.macs(whole) == 39 * 3 * 4 * 2 + 3 * 2
    assert cost.weights(plain) == cost.weights(whole) == 3 * 4 * 2 + 3 + 3 * 2 + 2
    assert cost.feature_macs("L", skin.FORMAT) == pytest.approx(16 * 1500 * np.log2(1500), abs=1)
    assert cost.feature_macs("H", skin.FORMAT) == pytest.approx(16 * 40 * 75 * np.log2(75), abs=1)
    assert cost.feature_macs("raw", skin.FORMAT) == 0


def test_a_gru_a_kernel_and_neighbours_are_counted():
    """One node each, with costs computed by hand."""
    svm = {"support_vectors": [0.0] * 15, "coefficients": [0.0] * 3, "domain": "ai.onnx.ml"}
    for kind, given, shape, w, expected, more in (
        ("GRU", "xwr", [7, 1, 5], [1, 12, 5], 7 * 3 * 4 * (5 + 4), {"hidden_size": 4}),
        ("CDist", "xw", [1, 5], [12, 5], 1 * 12 * 5, {"domain": "com.microsoft"}),
        ("SVMClassifier", "x", [1, 5], [12, 5], 18, svm),
    ):
        node = helper.make_node(kind, [*given], ["y"], **more)
        weights = [
            onnx.numpy_helper.from_array(np.zeros(of, np.float32), name)
            for name, of in (("w", w), ("r", [1, 12, 4]))
        ]
        x = helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)
        y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
        graph = helper.make_graph([node], "one", [x], [y], weights)
        domains = [
            helper.make_opsetid(name, v)
            for name, v in (("", 17), ("ai.onnx.ml", 3), ("com.microsoft", 1))
        ]
        assert cost.macs(helper.make_model(graph, opset_imports=domains)) == expected


def test_a_graph_of_unknown_shapes_is_refused():
    """A product with an unknown shape is reported by name instead of counted as nothing."""
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 3])
    w = onnx.numpy_helper.from_array(np.zeros((3, 2), np.float32), "w")
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    node = helper.make_node("MatMul", ["x", "w"], ["y"], "product")
    model = helper.make_model(helper.make_graph([node], "g", [x], [y], [w]))
    with pytest.raises(FormatError, match=r"'product'.*'x' is not"):
        cost.macs(model)
