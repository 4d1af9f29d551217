"""Costs that are counted in an ONNX graph: weights and multiply-accumulates.

They are the same on every machine. palpate_train.export.measure measures time and memory.
"""

from __future__ import annotations

from math import log2, prod
from typing import Any
from unittest import mock

import numpy as np
import onnx
from onnx import TensorProto

from palpate.answer import features
from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat

NUMBERS = {TensorProto.FLOAT, TensorProto.INT8, TensorProto.UINT8, TensorProto.INT32}
"""Data types of trained constants. Shapes and indices are int64."""
SCALED = {"QuantizeLinear", "DequantizeLinear"}
GATES = 3
"""Number of gates of a GRU."""


def precision(model: onnx.ModelProto) -> str:
    """ "int8" if the graph has quantized nodes, else "float"."""
    return "int8" if any(node.op_type in SCALED for node in model.graph.node) else "float"


def weights(model: onnx.ModelProto) -> int:
    """The number of trained numbers in the graph, float or int8: its constants and the tables of
    its classifiers.

    Scalars and the scales and zero points of int8 are not counted.
    """
    graph = model.graph
    scales = {name for node in graph.node if node.op_type in SCALED for name in node.input[1:]}
    held = [
        c
        for c in graph.initializer
        if prod(c.dims) > 1 and c.data_type in NUMBERS and c.name not in scales
    ]
    tables = [len(a.floats) for node in graph.node for a in node.attribute if len(a.floats) > 1]
    return int(sum(prod(c.dims) for c in held) + sum(tables))


def macs(model: onnx.ModelProto) -> int:
    """Multiply-accumulates for one sweep: convolutions, matrix products, GRU, kernels of an SVM,
    distances to neighbours.

    Shapes are inferred. Raises FormatError with the name of a node whose shape is unknown.
    """
    graph = onnx.shape_inference.infer_shapes(model).graph
    known = {
        v.name: [d.dim_value for d in v.type.tensor_type.shape.dim]
        for v in (*graph.value_info, *graph.output)
    }
    known |= {v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in graph.input}
    known |= {c.name: list(c.dims) for c in graph.initializer}
    # nodes that do not depend on the sweep are computed once, when the box loads the graph
    dependent = {v.name for v in graph.input}
    for node in graph.node:
        dependent |= set(node.output) if dependent & set(node.input) else set()
    return sum(_macs(node, known) for node in graph.node if dependent & set(node.output))


def _macs(node: onnx.NodeProto, known: dict[str, list[int]]) -> int:
    attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}

    def shape(name: str) -> list[int]:
        if not all(found := known.get(name, [0])):
            raise FormatError(
                f"node {node.name!r} ({node.op_type}): the shape of {name!r} is not known; "
                "infer the shapes first"
            )
        return found

    if node.op_type == "Conv":
        return prod(shape(node.output[0])) * prod(shape(node.input[1])[1:])
    if node.op_type in ("MatMul", "MatMulInteger"):
        return prod(shape(node.input[0])) * shape(node.input[1])[-1]
    if node.op_type == "Gemm":
        return (
            prod(shape(node.input[0])) * shape(node.input[1])[0 if attributes.get("transB") else -1]
        )
    if node.op_type == "GRU":
        steps, _, inputs = shape(node.input[0])
        hidden = int(attributes["hidden_size"])
        return steps * shape(node.input[1])[0] * GATES * hidden * (inputs + hidden)
    if node.op_type == "SVMClassifier":
        return len(attributes["support_vectors"]) + len(attributes["coefficients"])
    return prod(shape(node.input[1])) if node.op_type == "CDist" else 0


def feature_macs(kind: str, format: SweepFormat) -> int:
    """Multiply-accumulates of the Fourier transforms in the features `kind`: n log2 n for a
    transform of n real numbers.

    Such a transform takes n/4 log2 n complex products of four multiplications each. Everything else
    is not counted.
    """
    if kind == "raw":
        return 0
    transforms: list[int] = []
    power = features.power_spectrum

    def counted(x: Any, frames: int) -> Any:
        transforms.append(round(x.size * log2(max(x.shape[-1], 1))))
        return power(x, frames)

    rng = np.random.default_rng(0)  # noise, because a transform of a silent sweep might be skipped
    counts = rng.integers(0, 100, (format.window, *format.shape)).astype(format.numpy_type)
    with mock.patch.object(features, "power_spectrum", counted):
        features.compute(kind, counts, format.rate_hz)
    return sum(transforms)
