"""Builds ONNX graphs node by node, and checks them.

Shapes are fixed and nothing is traced: a graph holds exactly the nodes that are written here.
Graphs take the skin's raw counts, or features; all scaling is inside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto, helper, numpy_helper

from palpate.core.types import SweepFormat
from palpate.inference import session

Array = NDArray[Any]
TENSOR = {
    "uint8": TensorProto.UINT8,
    "int16": TensorProto.INT16,
    "uint16": TensorProto.UINT16,
    "float32": TensorProto.FLOAT,
}
OPSET, IR = 17, 8
MULTIPLYING = ("Conv", "Gemm", "MatMul")
"""Operators whose outputs keep their names in `slim`, because people look at them."""
FLOAT = TensorProto.FLOAT
MAX_TAP = 64
"""Largest integer weight, seven bits. Two products of eight bits overflow the 16-bit sums of an x86
without VNNI, and the answer there would differ from the answer on Arm."""
MIDDLE = 128
"""The byte that stands for 0 if bytes are signed."""


class GraphBuilder:
    """An ONNX graph under construction."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: Any, dtype: str = "float32") -> str:
        """The name of a new constant."""
        name = f"constant{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(value, dtype, order="C"), name))
        return name

    def __call__(self, op: str, *inputs: Any, output: str = "", **attributes: Any) -> str:
        """Add one node; returns the name of its output. inputs: names, and whole numbers, lists or
        arrays of them, which become int64 constants."""
        output = output or f"{op.lower()}{len(self.nodes)}"
        names = [one if isinstance(one, str) else self.constant(one, "int64") for one in inputs]
        self.nodes.append(helper.make_node(op, names, [output], name=output, **attributes))
        return output

    def model(self, format: SweepFormat, output: str, *size: int) -> onnx.ModelProto:
        """The finished, checked model: `sweep` [1, T, R, C] or [1, T, R, C, A] -> `output` float32
        [1, *size]."""
        sweep = helper.make_tensor_value_info(
            "sweep", TENSOR[format.dtype], [1, format.window, *format.shape]
        )
        out = helper.make_tensor_value_info(output, TensorProto.FLOAT, [1, *size])
        graph = helper.make_graph(self.nodes, "palpate", [sweep], [out], self.constants)
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR,
            producer_name="palpate",
        )
        onnx.checker.check_model(model, full_check=True)
        return model


def centred(g: GraphBuilder, format: SweepFormat) -> tuple[str, str]:
    """Nodes that subtract the mean of each taxel and axis: `sweep` -> ([1, R * C * A, T], sums over
    time [1, R * C * A]), float32.

    They are matrix products, five times as fast in onnxruntime as ReduceMean and Sub along time.
    For whole counts whose sum is below 2^24 (all windows of uint8 up to 65,793 frames) they are
    exact, whatever the order in which a processor adds. Beyond, the mean of 8,800 frames at 50,000
    counts was off by 0.4 counts at most. ReduceMean along time stands only where no offset is left;
    there it is off by 3e-6 of its value, whose logarithm is taken.
    """
    taxels = format.channels
    one = helper.make_tensor("one", TensorProto.FLOAT, [1], [1.0])
    ones = g("ConstantOfShape", [format.window, 1], value=one)
    x = g("Cast", g("Reshape", "sweep", [format.window, taxels]), to=TensorProto.FLOAT)
    sums = g("Gemm", ones, x, transA=1)
    x = g("Gemm", ones, sums, x, alpha=-1 / format.window)
    return g("Transpose", g("Reshape", x, [1, format.window, taxels]), perm=[0, 2, 1]), sums


def quantized(g: GraphBuilder, x: str, step: float, zero: int = 0) -> str:
    """`x` as bytes, in units of `step`."""
    return g("QuantizeLinear", x, g.constant(step), g.constant(zero, "uint8"))


def counts_of(g: GraphBuilder, x: str, step: float, zero: int = 0) -> str:
    """The values that bytes stand for, in units of `step`."""
    return g("DequantizeLinear", x, g.constant(step), g.constant(zero, "uint8"))


def channels_first(g: GraphBuilder, x: str, step: float, zero: int) -> str:
    """Bytes [n, T, R * C] -> the values that they stand for, [n, R * C, T]."""
    return counts_of(g, g("Transpose", x, perm=[0, 2, 1]), step, zero)


def int8_weights(
    g: GraphBuilder, weight: Array, bias: Array, step: float, zero_sum: bool
) -> tuple[str, str]:
    """Weight [filters, inputs, kernel] in seven bits, with a step for each filter; bias in 32 bits,
    in units of the product of both steps."""
    least = np.abs(bias) / (step * 2**30)  # the bias of a silent filter must fit too
    steps = np.maximum(np.maximum(np.abs(weight).max(axis=(1, 2)) / MAX_TAP, least), 1e-12).astype(
        np.float32
    )
    taps = (zero_sum_taps if zero_sum else np.rint)(
        weight / steps[:, None, None].astype(np.float64)
    )
    zeros = np.zeros(len(weight))
    product = steps.astype(np.float64) * step
    return (
        g(
            "DequantizeLinear",
            g.constant(taps, "int8"),
            g.constant(steps),
            g.constant(zeros, "int8"),
            axis=0,
        ),
        g(
            "DequantizeLinear",
            g.constant(np.rint(bias / product), "int32"),
            g.constant(product),
            g.constant(zeros, "int32"),
            axis=0,
        ),
    )


def sixteen_bits(matrix: Array) -> tuple[Array, Array]:
    """(int16 [F, ...], steps float32 [...]) of a matrix [F, ...]; a step is shared along the first
    axis. Their product is the matrix, rounded."""
    steps = np.maximum(
        np.abs(matrix).max(axis=0) / np.iinfo(np.int16).max, np.finfo(np.float32).tiny
    ).astype(np.float32)
    return np.rint(matrix / steps).astype(np.int16), steps


def zero_sum_taps(taps: Array) -> Array:
    """Taps [filters, taxels, kernel] rounded so that each kernel sums to zero, as it did before
    rounding.

    The surplus is the sum after rounding. It is removed by rounding as many taps the other way,
    the nearest taps first. No tap leaves the range: a tap at the end of the range is whole,
    so it was not rounded, and there are enough others.
    """
    taps = taps - taps.mean(axis=2, keepdims=True)
    rounded = np.rint(taps)
    surplus = rounded.sum(axis=2, keepdims=True)
    shift = (rounded - taps) * np.sign(surplus)  # how far each tap was rounded towards the surplus
    rank = np.argsort(np.argsort(-shift, axis=2, kind="stable"), axis=2, kind="stable")
    zero_sum: Array = rounded - np.sign(surplus) * (rank < np.abs(surplus))
    return zero_sum


def sums(
    g: GraphBuilder,
    x: str,
    steps: int,
    counts: ArrayLike,
    integers: bool = False,
    rowwise: bool = False,
    time_last: bool = False,
) -> str:
    """[1, steps, C] -> sums over the first `counts` steps, of integers or floats: [1, number of
    counts, C].

    rowwise: [m, steps, C] with `counts` for each of m rows -> [m, counts in a row, C]. time_last:
    for [..., C, steps]. The box computes the matrix of ones and zeros from a few numbers when it
    loads the graph; as a constant it would be large.
    """
    at = g("Reshape", g("Range", *(g.constant(n, "int32") for n in (0, steps, 1))), [1, steps])
    counts = np.asarray(counts)
    known = g(
        "Less",
        at,
        g.constant(counts.reshape((len(counts), -1, 1) if rowwise else (-1, 1)), "int32"),
    )
    ones = g("Cast", known, to=TensorProto.UINT8 if integers else FLOAT)
    product = "MatMulInteger" if integers else "MatMul"
    if not time_last:
        return g(product, ones, x)
    ones = g("Transpose", ones, perm=[0, 2, 1] if rowwise else [1, 0])
    return g("Transpose", g(product, x, ones), perm=[0, 2, 1])


def mean_factors(
    g: GraphBuilder, step: float, counts: list[int], size: int, rowwise: bool = False
) -> str:
    """Factors that turn sums over `counts` into means, in the shape that `sums` returns."""
    factors = np.array(
        [step / max(n, 1) for n in counts]
    )  # the sum of no steps is 0, so its mean is 0
    lead = (len(counts), 1) if rowwise else (1, len(counts))
    factors = factors.reshape(*lead, 1) if len(counts) > 1 else factors[0]
    return g("Expand", g.constant(factors), [*lead, size])


def side_by_side(g: GraphBuilder, parts: Sequence[str]) -> str:
    """The values [n, m, C] of all parts, joined along C."""
    return g("Concat", *parts, axis=2) if len(parts) > 1 else parts[0]


def with_head(trunk: onnx.ModelProto, weight: Array, bias: Array) -> onnx.ModelProto:
    """A trunk (float or int8) with a linear head, weight [K, F] and bias [K]: `sweep` -> `logits`
    float32 [1, K]."""
    model = onnx.ModelProto()
    model.CopyFrom(trunk)
    graph = model.graph
    for name, value in (("head.weight", weight), ("head.bias", bias)):
        graph.initializer.append(
            numpy_helper.from_array(np.ascontiguousarray(value, np.float32), name)
        )
    inputs = [graph.output[0].name, "head.weight", "head.bias"]
    graph.node.append(helper.make_node("Gemm", inputs, ["logits"], name="logits", transB=1))
    graph.output.pop()
    graph.output.append(helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, len(bias)]))
    onnx.checker.check_model(model, full_check=True)
    return model


def joined(first: onnx.ModelProto, second: onnx.ModelProto) -> onnx.ModelProto:
    """One model with the outputs of both, which take the same input. Nodes that both have in common
    occur once, named as in `first`.

    Each output still depends on the same nodes as before, so it has the same bits if the box leaves
    out the other outputs.
    """
    model = onnx.ModelProto()
    model.CopyFrom(first)
    graph, suffix = model.graph, second.graph.output[0].name
    # the content of a node or constant -> the names of its outputs in `model`
    known: dict[bytes, list[str]] = {}
    # names in the graph that is being added -> the first name of this value in `model`
    renamed: dict[str, str] = {}
    taken: set[str] = set()
    for item in (*graph.initializer, *graph.node):
        names = known.setdefault(_content(item, renamed), _outputs_of(item))
        renamed |= zip(_outputs_of(item), names, strict=True)
        taken.update(_outputs_of(item))
    renamed = {}
    for item in (*second.graph.initializer, *second.graph.node):
        key = _content(item, renamed)
        if key not in known:
            known[key] = [
                f"{name}.{suffix}" if name in taken else name for name in _outputs_of(item)
            ]
            _append(graph, key, item, known[key])
        renamed |= zip(_outputs_of(item), known[key], strict=True)
    graph.output.extend(second.graph.output)
    onnx.checker.check_model(model, full_check=True)
    return model


def slim(model: onnx.ModelProto) -> onnx.ModelProto:
    """The same model in fewer bytes: equal constants are merged, and only multiplying nodes keep
    the names of their outputs."""
    small = onnx.ModelProto()
    small.CopyFrom(model)
    graph = small.graph
    kept = {value.name for value in (*graph.input, *graph.output)}
    kept |= {name for node in graph.node if node.op_type in MULTIPLYING for name in node.output}
    fresh = (name for name in (np.base_repr(i, 36).lower() for i in count()) if name not in kept)
    renamed: dict[str, str] = {}
    known: dict[bytes, onnx.TensorProto] = {}
    for constant in graph.initializer:
        key = _content(constant, {})
        if key not in known:
            known[key] = onnx.TensorProto.FromString(key)
            known[key].name = next(fresh)
        renamed[constant.name] = known[key].name
    for node in graph.node:
        renamed |= {name: next(fresh) for name in node.output if name and name not in kept}
        inputs, outputs = (
            [renamed.get(name, name) for name in names] for names in (node.input, node.output)
        )
        del node.input[:], node.output[:]
        node.input.extend(inputs)
        node.output.extend(outputs)
        node.ClearField("name")
    for field in ("initializer", "value_info"):
        graph.ClearField(field)
    graph.initializer.extend(known.values())
    onnx.checker.check_model(small, full_check=True)
    return small


def _append(
    graph: onnx.GraphProto,
    content: bytes,
    item: onnx.NodeProto | onnx.TensorProto,
    names: list[str],
) -> None:
    """Add `item` with the new `names`; content: as `_content` returns it."""
    new = type(item).FromString(content)
    new.name = names[0]
    if isinstance(new, onnx.NodeProto):
        new.output.extend(names)
        graph.node.append(new)
    else:
        graph.initializer.append(new)


def _outputs_of(item: onnx.NodeProto | onnx.TensorProto) -> list[str]:
    """The names that a node or a constant defines."""
    return list(item.output) if isinstance(item, onnx.NodeProto) else [item.name]


def _content(item: onnx.NodeProto | onnx.TensorProto, renamed: Mapping[str, str]) -> bytes:
    """A node or a constant without its own names, and with its inputs renamed. It is equal for two
    items that compute the same values."""
    bare = type(item)()
    bare.CopyFrom(item)
    bare.ClearField("name")
    if isinstance(bare, onnx.NodeProto):
        inputs = [renamed.get(name, name) for name in bare.input]
        del bare.input[:], bare.output[:]
        bare.input.extend(inputs)
    return bytes(bare.SerializeToString(deterministic=True))


@dataclass(frozen=True)
class GraphModel:
    """A methods.Model that consists of its graph alone."""

    model: onnx.ModelProto

    def logits(self, inputs: Array) -> Array:
        """Raw counts or features of n sweeps -> float32 [n, K]."""
        return run(self.model, inputs)

    def graph(self) -> onnx.ModelProto:
        """The graph itself."""
        return self.model


def run_output(model: onnx.ModelProto, name: str, inputs: Array) -> Array:
    """As `run`, for one of several outputs of `model`: float32 [n, ...]."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    kept = [output for output in made.graph.output if output.name == name]
    del made.graph.output[:]
    made.graph.output.extend(kept)
    return run(made, inputs)


def run(model: onnx.ModelProto, inputs: Array) -> Array:
    """The output of `model`, float32 [n, size], for each of `inputs` (raw counts or features), in
    the same kind of session as on the box."""
    on_the_box, name = _session(model.SerializeToString()), model.graph.input[0].name
    outputs: Array | None = None
    for i, one in enumerate(inputs):
        output = session.run(on_the_box, None, {name: one[None]})[0]
        if outputs is None:  # a list to join at the end would hold everything twice
            outputs = np.empty((len(inputs), *output.shape[1:]), output.dtype)
        outputs[i] = output[0]
    if outputs is None:
        raise ValueError("no inputs; give at least one sweep")
    return outputs


@lru_cache(maxsize=4)
def _session(model: bytes) -> Any:
    """The session of a serialized model. Making one takes as long as tens of sweeps, and an export
    runs the same model on many altered copies."""
    return session.session(model)
