"""The rules of the operators refuse wrong inputs, and predict the type and shape of onnxruntime's
results."""

from __future__ import annotations

from random import Random
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
import onnx

from palpate.bundle.onnx_check.operators import OPERATORS
from palpate.bundle.onnx_check.shapes import Call, Value
from palpate.core.errors import BundleError
from palpate.inference.session import session
from tests.factories.grown_models import FORMAT, Sprout

TABLES = {
    "classlabels_ints": [0, 1],
    "vectors_per_class": [1, 1],
    "coefficients": [1.0] * 2,
    "rho": [0.0],
    "kernel_params": [1.0] * 3,
    "support_vectors": [1.0] * 6,
    "kernel_type": b"RBF",
    "post_transform": b"NONE",
}
IMAGE, SWEEP = (1, 3, 8, 8), (1, FORMAT.window, FORMAT.rows, FORMAT.cols)


def fixed(*numbers: int, shape: tuple[int, ...] | None = None) -> Value:
    """A constant of int64, by default in one row."""
    array = np.array(numbers, np.int64)
    return Value("int64", array.shape if shape is None else shape, array)


def of(*shape: int, kind: str = "float32") -> Value:
    """A tensor that depends on the sweep."""
    return Value(kind, shape, depends_on_sweep=True)


WRONG: list[tuple[str, str, list[Value], dict[str, Any]]] = [
    ("dimensions instead of 1", "Expand", [of(3), fixed(3, shape=())], {}),
    ("is not a shape", "Expand", [of(3), fixed(0, 3)], {}),
    ("must be 0 or 1", "ReduceMax", [of(3)], {"keepdims": 2}),
    ("axis .3. of 2", "ReduceMax", [of(3, 3)], {"axes": [3]}),
    ("each once", "ReduceMax", [of(3, 3)], {"axes": [0, -2]}),
    ("each once", "ReduceMax", [of(3, 3)], {"axes": []}),
    ("given twice", "ReduceMax", [of(3, 3), fixed(0)], {"axes": [0]}),
    ("do not go together", "Add", [of(3), of(4)], {}),
    ("do not go together", "Where", [of(3, kind="bool"), of(4), of(4)], {}),
    ("types .* do not go together", "Mul", [of(3), of(3, kind="int64")], {}),
    ("single numbers", "Clip", [of(3), of(1), of()], {}),
    ("cannot be joined", "Concat", [of(3, 2), of(3, 3)], {"axis": 0}),
    ("cannot be joined", "Concat", [of(3), of(3, kind="int64")], {"axis": 0}),
    ("axis .None.", "Concat", [of(3), of(3)], {}),
    ("differ in number", "Slice", [of(3, 3), fixed(0, 0), fixed(1), fixed(0)], {}),
    ("above 0", "Slice", [of(3), fixed(2), fixed(0), fixed(0), fixed(-1)], {}),
    ("shape or type", "ScatterElements", [of(3), fixed(0), of(2)], {}),
    ("none or add", "ScatterElements", [of(3), fixed(0), of(1)], {"reduction": b"mul"}),
    ("do not fit", "ScatterElements", [of(3, 3), fixed(0), of(1)], {}),
    ("do not fit", "GatherElements", [of(3, 3), of(3, 4, kind="int64")], {"axis": 0}),
    ("out of 3", "GatherElements", [of(3), fixed(-4)], {}),
    (
        "nothing to choose",
        "ArrayFeatureExtractor",
        [of(kind="int64"), Value("int64", (1,), None, True, True)],
        {},
    ),
    ("allowzero", "Reshape", [of(3), fixed(3)], {"allowzero": 1}),
    ("is not a shape", "Reshape", [of(3), fixed(-2, 3)], {}),
    ("cannot become", "Reshape", [of(3), fixed(2, -1)], {}),
    ("cannot become", "Reshape", [of(4), fixed(-1, -1)], {}),
    ("axis 2 of 1", "Flatten", [of(3)], {"axis": 2}),
    ("is not an order", "Transpose", [of(3, 3)], {"perm": [0, 0]}),
    ("one float", "ConstantOfShape", [fixed(3)], {"value": Value("float32", (2,))}),
    ("one float", "ConstantOfShape", [fixed(3)], {"value": Value("int64", (1,))}),
    (
        "steps of 1",
        "Range",
        [fixed(-(2**62), shape=()), fixed(2**62, shape=()), fixed(1, shape=())],
        {},
    ),
    ("a kernel of", "Conv", [of(1, 3, 8, 8, 8, 8), of(1, 3, 1, 1, 1, 1)], {}),
    ("weights of", "Conv", [of(*IMAGE), of(2, 4, 3, 3)], {}),
    ("weights of", "Conv", [of(1, 3), of(2, 3)], {}),
    ("weights of .* with group = 3", "Conv", [of(*IMAGE), of(3, 3, 3, 3)], {"group": 3}),
    ("group = 3 does not divide 2", "Conv", [of(*IMAGE), of(2, 1, 3, 3)], {"group": 3}),
    ("with group = -3", "Conv", [of(*IMAGE), of(3, 1, 3, 3)], {"group": -3}),
    ("group = 0 does not divide 3", "Conv", [of(1, 0, 8, 8), of(3, 1, 3, 3)], {"group": 0}),
    ("one bias", "Conv", [of(*IMAGE), of(2, 3, 3, 3), of(3)], {}),
    ("beyond a kernel", "Conv", [of(*IMAGE), of(2, 3, 3, 3)], {"pads": [0, 0, 3, 0]}),
    ("is larger than", "Conv", [of(*IMAGE), of(2, 3, 3, 3)], {"dilations": [4, 1]}),
    ("strides", "Conv", [of(*IMAGE), of(2, 3, 3, 3)], {"strides": [1 << 20, 1]}),
    ("nothing to pool", "MaxPool", [of(3, 3)], {"kernel_shape": []}),
    ("a kernel of", "MaxPool", [of(*IMAGE)], {"kernel_shape": [1]}),
    ("times", "MatMul", [of(2, 3), of(2, 3)], {}),
    ("times", "MatMul", [of(3), of(3)], {}),
    ("times", "Gemm", [of(2, 3), of(3, 2)], {"transB": 1}),
    ("too large", "Gemm", [of(2, 3), of(3, 2), of(3, 2, 2)], {}),
    ("a state of 0", "GRU", [of(4, 1, 2), of(1, 6, 2), of(1, 6, 2), of(1, 12)], {}),
    ("weights of", "GRU", [of(4, 1, 2), of(1, 6, 3), of(1, 6, 2), of(1, 12)], {"hidden_size": 2}),
    ("weights of", "GRU", [of(4, 1, 2), of(1, 6, 2), of(1, 6, 2), of(1, 11)], {"hidden_size": 2}),
    ("single numbers", "QuantizeLinear", [of(3), of(3), of(3, kind="uint8")], {}),
    (
        "steps and zeros of",
        "DequantizeLinear",
        [of(3, kind="int8"), of(2), of(2, kind="int8")],
        {"axis": 0},
    ),
    (
        "steps and zeros of",
        "DequantizeLinear",
        [of(3, kind="int8"), of(3), of(kind="int8")],
        {"axis": 0},
    ),
    (
        "zeros of uint8 for int8",
        "DequantizeLinear",
        [of(3, kind="int8"), of(), of(kind="uint8")],
        {},
    ),
    ("offset must have", "Scaler", [of(1, 3)], {"offset": [1.0], "scale": [1.0] * 3}),
    ("must have", "Scaler", [of(3)], {"offset": [1.0] * 3, "scale": [1.0] * 3}),
    ("metric", "CDist", [of(2, 3), of(2, 3)], {"metric": b"sqeuclidean"}),
    ("distances", "CDist", [of(2, 3), of(2, 4)], {"metric": b"euclidean"}),
    ("one row", "SVMClassifier", [of(2, 3)], TABLES),
    ("do not fit", "SVMClassifier", [of(1, 3)], TABLES | {"classlabels_ints": [1, 1]}),
    ("vectors_per_class", "SVMClassifier", [of(1, 3)], TABLES | {"vectors_per_class": [3, -1]}),
    ("support_vectors", "SVMClassifier", [of(1, 2)], TABLES),
    ("post_transform", "SVMClassifier", [of(1, 3)], TABLES | {"post_transform": b"PROBIT"}),
]


@pytest.mark.parametrize(("words", "name", "inputs", "given"), WRONG, ids=range(len(WRONG)))
def test_a_rule_refuses(words: str, name: str, inputs: list[Value], given: dict[str, Any]):
    """Inputs and settings that do not fit, with the error."""
    (operator,) = (o for (_, op), o in OPERATORS.items() if op == name)
    with pytest.raises(BundleError, match=words):
        operator.rule(Call(inputs, given))


@pytest.mark.slow
def test_all_rules_say_what_onnxruntime_gives():
    """In models of random operators the rules and onnxruntime give the same type and shape for all
    values that depend on the sweep."""
    seen: set[str] = set()
    compared = 0
    for seed in range(60):
        sprout = Sprout(Random(seed))
        sprout.add("", "Cast", ["sweep"], {"to": 1})
        for _ in range(15):
            sprout.grow()
        dependent = {
            name: value
            for name, value in sprout.known.items()
            if value.depends_on_sweep and name != "sweep"
        }
        nodes = list(sprout.nodes)
        model = onnx.load_from_string(sprout.model())
        del model.graph.output[:], model.graph.node[:]
        model.graph.node.extend(nodes)
        types = {
            name: onnx.helper.np_dtype_to_tensor_dtype(np.dtype(value.kind))
            for name, value in dependent.items()
        }
        model.graph.output.extend(
            onnx.helper.make_tensor_value_info(name, types[name], None) for name in dependent
        )
        try:
            gives = session(model.SerializeToString()).run(
                None, {"sweep": np.ones(SWEEP, np.uint8)}
            )
        except Exception:  # an index out of range, which onnxruntime checks for each sweep
            continue
        for (name, value), have in zip(dependent.items(), gives, strict=True):
            assert (value.kind, value.shape) == (have.dtype.name, have.shape), f"{seed}: {name}"
        seen |= {node.op_type for node in nodes}
        compared += 1
    assert compared > 45
    assert len(seen) > 45
