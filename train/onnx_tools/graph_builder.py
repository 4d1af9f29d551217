"""The room of graphs. In: operators and weights, node by node. Out: checked ONNX models that the box runs.

What runs on the box is what stands in this package: fixed shapes, no tracer's surprises. The graphs take the sensor's
own digits, or features; all scaling is inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from appliance.core.types import SweepFormat
from appliance.inference.session import session

TENSOR = {
    "uint8": TensorProto.UINT8,
    "int16": TensorProto.INT16,
    "uint16": TensorProto.UINT16,
    "float32": TensorProto.FLOAT,
}
OPSET, IR = 17, 8


class GraphBuilder:
    """An ONNX graph in the making."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: Any, dtype: str = "float32") -> str:
        """The name of a new constant."""
        name = f"constant{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(value, dtype, order="C"), name))
        return name

    def __call__(self, op: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        """Add one node; the name of its output."""
        output = output or f"{op.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, inputs, [output], name=output, **attributes))
        return output

    def model(self, form: SweepFormat, output: str, size: int) -> onnx.ModelProto:
        """The finished, checked model: `sweep` [1, T, R, C] -> `output` float32 [1, size]."""
        sweep = helper.make_tensor_value_info("sweep", TENSOR[form.dtype], [1, form.window, form.rows, form.cols])
        out = helper.make_tensor_value_info(output, TensorProto.FLOAT, [1, size])
        graph = helper.make_graph(self.nodes, "palpate", [sweep], [out], self.constants)
        made = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR, producer_name="palpate"
        )
        onnx.checker.check_model(made, full_check=True)
        return made


def centred(g: GraphBuilder, form: SweepFormat) -> tuple[str, str]:
    """Nodes that take each taxel's mean away: `sweep` -> ([1, R * C, T], sums over time [1, R * C]), float32.

    Matrix products do it, five times as fast in onnxruntime as ReduceMean and Sub along time, and exact for whole
    digits in whatever order a processor adds them up.
    """
    taxels = form.rows * form.cols
    one = helper.make_tensor("one", TensorProto.FLOAT, [1], [1.0])
    ones = g("ConstantOfShape", g.constant([form.window, 1], "int64"), value=one)
    x = g("Cast", g("Reshape", "sweep", g.constant([form.window, taxels], "int64")), to=TensorProto.FLOAT)
    sums = g("Gemm", ones, x, transA=1)
    x = g("Gemm", ones, sums, x, alpha=-1 / form.window)
    return g("Transpose", g("Reshape", x, g.constant([1, form.window, taxels], "int64")), perm=[0, 2, 1]), sums


def with_head(trunk: onnx.ModelProto, weight: NDArray[Any], bias: NDArray[Any]) -> onnx.ModelProto:
    """A trunk (float or int8) and a linear head, weight [K, F] and bias [K]: `sweep` -> `logits` float32 [1, K]."""
    whole = onnx.ModelProto()
    whole.CopyFrom(trunk)
    graph = whole.graph
    for name, value in (("head.weight", weight), ("head.bias", bias)):
        graph.initializer.append(numpy_helper.from_array(np.ascontiguousarray(value, np.float32), name))
    inputs = [graph.output[0].name, "head.weight", "head.bias"]
    graph.node.append(helper.make_node("Gemm", inputs, ["logits"], name="logits", transB=1))
    graph.output.pop()
    graph.output.append(helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, len(bias)]))
    onnx.checker.check_model(whole, full_check=True)
    return whole


@dataclass(frozen=True)
class GraphModel:
    """A methods.Model that is nothing but its graph."""

    model: onnx.ModelProto

    def logits(self, given: NDArray[Any]) -> NDArray[Any]:
        """Digits or features of n sweeps -> float32 [n, K]."""
        return run(self.model, given)

    def graph(self) -> onnx.ModelProto:
        """The graph itself."""
        return self.model


def weight_count(model: onnx.ModelProto) -> int:
    """How many trained numbers a float graph holds: what is left of its constants without shapes and scalars."""
    return sum(int(np.prod(c.dims)) for c in model.graph.initializer if c.data_type == TensorProto.FLOAT and c.dims)


def run(model: onnx.ModelProto, inputs: NDArray[Any]) -> NDArray[Any]:
    """What `model` gives for each of `inputs` (digits or features), float32 [n, size], in the box's kind of session."""
    of_the_box, name = session(model.SerializeToString()), model.graph.input[0].name
    return np.concatenate([of_the_box.run(None, {name: one[None]})[0] for one in inputs])
