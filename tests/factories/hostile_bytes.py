"""Malformed models: invalid protobuf, files that two readers read differently, foreign types.

Each comes as (name, model, regular expression that its refusal must match). The tools of
hostile_models.py are here, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import AttributeProto, TensorProto, helper, numpy_helper

from palpate.core.types import SweepFormat

FORMAT = SweepFormat(2, 2, 100.0, 24, "uint8")
"""Of the sweep that all hostile models declare as their input."""
TRIED = ""
"""In place of words: the check lets the model pass, and its trial refuses it."""
Models = Iterator[tuple[str, onnx.ModelProto | bytes, str]]
node, info = helper.make_node, helper.make_tensor_value_info
SWEEP = [1, FORMAT.window, FORMAT.rows, FORMAT.cols]
OPSETS = (("", 17), ("ai.onnx.ml", 3), ("com.microsoft", 1))
FLOATS = node("Cast", ["sweep"], ["x"], to=TensorProto.FLOAT)


def model(
    nodes: Sequence[onnx.NodeProto],
    constants: Mapping[str, Any] = {},
    last: str = "y",
    opsets: Any = OPSETS,
) -> onnx.ModelProto:
    """A model of these nodes. It reads `sweep` as `x`; the largest number of `last`, twice, is
    `logits`.
    """
    held = {"flat": [1, -1]} | constants
    ends = [
        node("Reshape", [last, "flat"], ["row"]),
        node("ReduceMax", ["row"], ["most"], axes=[1]),
        node("Concat", ["most", "most"], ["logits"], axis=1),
    ]
    graph = helper.make_graph(
        [FLOATS, *nodes, *ends],
        "hostile",
        [info("sweep", TensorProto.UINT8, SWEEP)],
        [info("logits", 1, [1, 2])],
        [
            v if isinstance(v, TensorProto) else numpy_helper.from_array(np.array(v), k)
            for k, v in held.items()
        ],
    )
    return helper.make_model(
        graph, opset_imports=[helper.make_opsetid(*o) for o in opsets], ir_version=8
    )


def number(n: int) -> bytes:
    """Encode a varint."""
    n %= 1 << 64
    return (bytes([n & 127 | 128]) + number(n >> 7)) if n > 127 else bytes([n])


def part(field: int, content: bytes | int) -> bytes:
    """A field of a message: bytes with their length, or a number."""
    if isinstance(content, int):
        return number(field << 3) + number(content)
    return number(field << 3 | 2) + number(len(content)) + content


def declared(name: bytes, kind: int, sizes: Sequence[int]) -> bytes:
    """A value with its type, encoded by hand."""
    shape = b"".join(part(1, part(1, size)) for size in sizes)
    return part(1, name) + part(2, part(1, part(1, kind) + part(2, shape)))


def misfits() -> Models:
    """Models whose inputs or outputs differ from the manifest, or whose types are foreign."""
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.input[0].type.tensor_type.shape.dim[0].dim_param = "n"
    yield "named size", made, "a name instead of a number"
    made = model([node("Relu", ["x"], ["y"])])
    del made.graph.input[0].type.tensor_type.shape.dim[0]
    yield "other sweep", made, "the manifest has uint8"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.input.append(info("more", 1, [1]))
    yield "two inputs", made, "2 inputs"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.output[0].type.tensor_type.shape.dim[1].dim_value = 3
    yield "other logits than declared", made, r"\[1, 3\] instead of"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.output.append(info("x", 1, SWEEP))
    yield "another output", made, "allows logits"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.input[0].type.sequence_type.elem_type.tensor_type.elem_type = 1
    yield "sequence", made, "a sequence"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.input[0].type.optional_type.elem_type.tensor_type.elem_type = 1
    yield "optional", made, "an optional type"
    texts = helper.make_tensor("w", TensorProto.STRING, [1], [b"a"])
    yield "texts", model([node("Add", ["x", "w"], ["y"])], {"w": texts}), "tensor: texts"
    yield "64 bits", model([node("Add", ["x", "w"], ["y"])], {"w": np.ones(1)}), "type 11"
    yield "cast to texts", model([node("Cast", ["x"], ["y"], to=8)]), "type 8"
    off = TensorProto(name="w", data_type=1, dims=[4], float_data=[1.0, 2.0])
    yield "too few floats", model([node("Add", ["x", "w"], ["y"])], {"w": off}), TRIED
    short = TensorProto(name="w", data_type=1, dims=[4], raw_data=bytes(4))
    yield "too few numbers", model([node("Add", ["x", "w"], ["y"])], {"w": short}), TRIED
    made = model([node("Relu", ["x"], ["y"])])
    made.ir_version = 3
    yield "old file", made, "IR version 3"
    made = model([node("LogSoftmax", ["x"], ["y"], axis=1)])
    made.graph.node[1].attribute[0].type = AttributeProto.FLOAT
    yield "setting of another type", made, "setting 'axis'"
    made = model([node("LogSoftmax", ["x"], ["y"], axis=1)])
    made.graph.node[1].attribute[0].f = 1.0
    yield "setting of two types", made, "not as its type has it"
    made = model([node("LogSoftmax", ["x"], ["y"], axis=1)])
    made.graph.node[1].attribute.add().CopyFrom(made.graph.node[1].attribute[0])
    yield "setting twice", made, "'axis' is set twice"
    flat = {"w": np.ones((96, 2), np.float32)}
    yield (
        "setting without end",
        model([node("Gemm", ["x", "w"], ["y"], alpha=float("inf"))], flat),
        "alpha = inf",
    )
    yield "an input too many", model([node("Relu", ["x", "x"], ["y"])]), "it has 2 inputs"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.input[0].type.Clear()
    yield "no type", made, "no type and shape"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.input[0].type.tensor_type.shape.dim[0].Clear()
    yield "no size", made, "every size must be a number"
    made = model([node("Relu", ["x"], ["y"])])
    made.graph.output[0].type.tensor_type.shape.dim.add(dim_value=1)
    made.graph.node[-1].op_type = "Unsqueeze"
    del made.graph.node[-1].attribute[:]
    made.graph.node[-1].input[1] = "two"
    made.graph.initializer.append(numpy_helper.from_array(np.array([2]), "two"))
    made.graph.output[0].type.tensor_type.shape.dim[1].dim_value = 1
    yield "logits of three dimensions", made, r"\[1, 1, 1\] instead of"


def broken() -> Models:
    """Files that are not protobuf, or that two readers understand differently."""
    good = model([node("Relu", ["x"], ["y"])]).SerializeToString()
    graph = model([node("Abs", ["x"], ["y"])]).graph.SerializeToString()
    yield "two graphs", good + part(7, graph), "graph is there twice"
    yield "something behind it", good + b"\x00", "field 0"
    yield "text behind it", good + b"palpate", "field"
    yield "a group", good[:2] + number(2 << 3 | 3) + number(2 << 3 | 4) + good[2:], "wire type 3"
    yield "wire type 7", number(1 << 3 | 7) + good, "wire type 7"
    yield "a number that ends early", b"\x08", "a number is cut off"
    yield (
        "a length without end",
        part(1, 8) + number(7 << 3 | 2) + b"\xff" * 9 + b"\x01",
        "bytes are announced",
    )
    yield "a number without end", part(1, 8) + b"\xff" * 100, "more bytes than it needs"
    yield "a number in two bytes", b"\x08\x88\x00" + good[2:], "more bytes than it needs"
    yield (
        "a float that ends early",
        part(7, part(1, part(5, number(2 << 3 | 5) + b"\0"))),
        "a number is cut off",
    )
    yield "floats that are none", part(7, part(5, part(4, b"\0" * 5))), "5 bytes are no floats"
    yield "a version of 64 bits", part(1, 8 + 2**32) + good[2:], "not a code or version"
    deep = b""
    for _ in range(1000):  # a graph in an attribute of a node of a graph, and so on
        deep = part(1, part(5, part(6, deep)))
    yield "a thousand deep", part(7, deep), "a graph in the graph"
    yield "brackets", b"[" * 5000, "model: field 11"
    yield "a name of no letters", good.replace(b"Relu", b"\xff\xfe\xfd\xfc"), "UTF-8"
