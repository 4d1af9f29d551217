"""The graph of a bundle: a trunk, the heads of a calibration, and the embedding.

Large matrices are kept in 16 bits. No other output depends on the nodes of early answers, so that a
box without early answers can leave them out.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from palpate_train.answer.calibrate import Calibration
from palpate_train.answer.embedding import Embedding
from palpate_train.answer.fit_early import STEPS, Heads
from palpate_train.onnx_tools.graph_builder import joined, sixteen_bits

Array = NDArray[Any]
Add = Callable[..., str]
DIRECTIONS, TURN, OFFSET = "embedding.axes", "embedding.turn", "embedding.offset"
"""Names of a model's matrices; see novelty.Embedding."""


def bundle_graph(
    calibration: Calibration,
    trunk: onnx.ModelProto,
    prefixes: onnx.ModelProto | None = None,
) -> onnx.ModelProto:
    """The model of a bundle, from a trunk (float or int8): `sweep` -> `features` float32 [1, F].

    prefixes: the same trunk with the output `tenths` [1, D + 1, F]. Outputs: `logits` [1, K];
    `early` [1, D, K] if there are prefixes and a rule; `embedding` [1, r];
    `early_embedding` [1, D, r] with `early`.
    """
    model, steps = onnx.ModelProto(), None
    model.CopyFrom(trunk)
    if prefixes is not None and calibration.rule.early is not None:
        model, steps = joined(trunk, prefixes), calibration.steps
    embedding, add = calibration.embedding, partial(_add, model.graph)
    whole, *tenths = [output.name for output in model.graph.output]
    weight, bias = (np.asarray(part, np.float32) for part in (calibration.weight, calibration.bias))
    centred = _sixteen_bits(add, weight - weight.mean(1, keepdims=True), "head.weight")
    add("Gemm", whole, centred, bias - bias.mean(), output="logits")
    outputs: dict[str, list[int]] = {"logits": [1, len(bias)]}
    _sixteen_bits(add, embedding.directions, DIRECTIONS)
    if embedding.selected:
        _sixteen_bits(add, embedding.turn, TURN)
    model.graph.initializer.append(numpy_helper.from_array(embedding.offset, OFFSET))
    if steps is not None:
        _early(add, steps, _embedded(add, embedding, tenths[0], axis=2, output="head.each"))
        outputs["early"] = [1, len(steps.weight), len(bias)]
        outputs[STEPS] = [1, len(steps.weight), len(embedding.offset)]
    _embedded(add, embedding, whole, axis=1, output="embedding")
    outputs["embedding"] = [1, len(embedding.offset)]
    del model.graph.output[:]
    for name, shape in outputs.items():
        model.graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    onnx.checker.check_model(model, full_check=True)
    return model


def _early(add: Add, steps: Heads, z: str) -> None:
    """The output `early` [1, D, K] from embeddings z [1, D + 1, r]."""
    count = len(steps.weight)
    # [1, D, r] -> [D, 1, r]: a head for each row
    rows = add("Slice", z, np.array([0]), np.array([count]), np.array([1]), output=STEPS)
    rows = add("Transpose", rows, output="head.rows", perm=[1, 0, 2])
    weight = _sixteen_bits(add, steps.weight, "early.weight")
    rows = add("MatMul", rows, weight, output="head.steps")
    rows = add("Add", rows, steps.bias[:, None], output="head.said")
    add("Transpose", rows, output="early", perm=[1, 0, 2])


def _embedded(add: Add, embedding: Embedding, x: str, axis: int, output: str) -> str:
    """Features [..., F] -> embeddings [..., r]; F is the axis `axis`. The constants of `embedding`
    are in the graph already."""
    z, size = add("MatMul", x, DIRECTIONS, output=f"{output}.known"), len(embedding.directions)
    if embedding.selected:
        ends = (np.array([n]) for n in (size - embedding.selected, size, axis))
        selected = add("Slice", x, *ends, output=f"{output}.selected")
        z = add("Concat", z, selected, output=f"{output}.both", axis=axis)
        z = add("MatMul", z, TURN, output=f"{output}.whole")
    return add("Add", z, OFFSET, output=output)


def _sixteen_bits(add: Add, matrix: Array, name: str) -> str:
    """A matrix [F, n] or [D, F, n] in 16 bits (graph_builder.sixteen_bits), which halves the
    largest parts of a bundle. onnxruntime converts it to floats once, when it opens the model."""
    whole, steps = sixteen_bits(matrix)
    floats = add("Cast", whole, output=f"{name}.whole", to=TensorProto.FLOAT)
    return add("Mul", floats, steps, output=name)


def _add(
    graph: onnx.GraphProto, op: str, *inputs: str | Array, output: str, **attributes: Any
) -> str:
    """Add one node and return the name of its output; arrays become constants."""
    names = []
    for i, value in enumerate(inputs):
        names.append(value if isinstance(value, str) else f"{output}.{i}")
        if not isinstance(value, str):
            graph.initializer.append(numpy_helper.from_array(np.array(value, order="C"), names[-1]))
    graph.node.append(helper.make_node(op, names, [output], name=output, **attributes))
    return output
