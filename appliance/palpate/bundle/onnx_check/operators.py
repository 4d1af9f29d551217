"""The operators that a bundle's model may use, with the settings and types that are allowed.

They are the operators that the exporters of train/ write. shapes.py has the rules for their
outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import prod

from palpate.bundle.onnx_check import shapes
from palpate.bundle.onnx_check.shapes import KINDS, Call, Out, Shape

FLOAT, INT, TEXT, TENSOR, FLOATS, INTS = 1, 2, 3, 4, 6, 7
"""Types of settings by ONNX's code."""
Rule = Callable[[Call], Out | list[Out]]
ANY, F, L, B, U8 = tuple(KINDS.values()), ("float32",), ("int64",), ("bool",), ("uint8",)


@dataclass(frozen=True, slots=True)
class Operator:
    """Allowed use of one operator.

    rule: computes the type and shape of its outputs. kinds: allowed types of its inputs in order;
    the last entry applies to all further inputs. least, most: number of inputs. settings: code of
    the type of each setting.
    """

    rule: Rule
    kinds: tuple[tuple[str, ...], ...]
    least: int
    most: int
    settings: Mapping[str, int]


def _op(
    rule: Rule, *kinds: tuple[str, ...], least: int = 0, most: int = 0, **settings: int
) -> Operator:
    return Operator(rule, kinds, least or len(kinds), most or len(kinds), settings)


def work(name: str, call: Call, out: Shape) -> tuple[int, int]:
    """Number of products and bytes of workspace of a node with the output `out`."""
    first, given = call.inputs[0].shape, call.given
    if name == "Conv":  # onnxruntime copies each window before it multiplies
        taps = prod(call.inputs[1].shape[1:])
        return prod(out) * taps, 4 * taps * prod(out[2:])
    if name == "GRU":
        return 3 * prod(out) * (first[2] + out[3]), 48 * prod(out)
    if name == "MaxPool":
        return prod(out) * prod(given["kernel_shape"]), 0
    if name == "Gemm":
        return prod(out) * first[0 if given.get("transA") else 1], 0
    if name in ("MatMul", "MatMulInteger", "CDist"):
        return prod(out) * first[-1], 0
    if name in ("TopK", "ScatterElements"):  # an index of eight bytes for each number
        return 0, 8 * prod(call.inputs[0].shape)
    if name == "SVMClassifier":  # its tables are settings and are copied
        numbers = len(given["support_vectors"]) + len(given["coefficients"])
        return numbers, 16 * numbers
    return 0, 0


_ONE, _TWO = _op(shapes.same, F), _op(shapes.spread, F, F)
_COMPARED = _op(shapes.compare, (*F, *L, *U8, "int32"), (*F, *L, *U8, "int32"))
_REDUCED = _op(shapes.reduce, F, L, least=1, axes=INTS, keepdims=INT)
_STEPPED = ("uint8", "int8", "int32")
_MACHINE = {
    "classlabels_ints": INTS,
    "vectors_per_class": INTS,
    "kernel_type": TEXT,
    "post_transform": TEXT,
    "coefficients": FLOATS,
    "kernel_params": FLOATS,
    "rho": FLOATS,
    "support_vectors": FLOATS,
}
OPERATORS: dict[tuple[str, str], Operator] = {
    **dict.fromkeys(
        [("", name) for name in ("Abs", "Cos", "Log", "Neg", "Relu", "Sin", "Sqrt")], _ONE
    ),
    **dict.fromkeys([("", name) for name in ("Add", "Div", "Max", "Sub")], _TWO),
    **dict.fromkeys([("", name) for name in ("Equal", "Greater", "Less")], _COMPARED),
    **dict.fromkeys(
        [("", f"Reduce{name}") for name in ("Max", "Mean", "Min", "SumSquare")], _REDUCED
    ),
    ("", "And"): _op(shapes.compare, B, B),
    ("", "ArgMax"): _op(shapes.highest, F, axis=INT, keepdims=INT),
    ("", "Cast"): _op(shapes.cast, ANY, to=INT),
    ("", "Clip"): _op(shapes.clip, (*F, *U8), (*F, *U8), (*F, *U8)),
    ("", "Concat"): _op(shapes.concat, (*F, *L, *U8, "int32"), most=1000, axis=INT),
    ("", "ConstantOfShape"): _op(shapes.filled, L, value=TENSOR),
    ("", "Conv"): _op(
        shapes.conv, F, F, F, least=2, strides=INTS, pads=INTS, dilations=INTS, group=INT
    ),
    ("", "DequantizeLinear"): _op(shapes.dequantize, _STEPPED, F, _STEPPED, axis=INT),
    ("", "Expand"): _op(shapes.expand, (*F, *U8), L),
    ("", "Flatten"): _op(shapes.flatten, ANY, axis=INT),
    ("", "GRU"): _op(shapes.recurrent, F, F, F, F, hidden_size=INT, linear_before_reset=INT),
    ("", "Gather"): _op(shapes.gather, (*F, *L), L, axis=INT),
    ("", "GatherElements"): _op(shapes.gather_each, F, L, axis=INT),
    ("", "Gemm"): _op(
        shapes.gemm, F, F, F, least=2, alpha=FLOAT, beta=FLOAT, transA=INT, transB=INT
    ),
    ("", "Identity"): _op(shapes.same, ANY),
    ("", "LogSoftmax"): _op(shapes.along, F, axis=INT),
    ("", "MatMul"): _op(shapes.product, F, F),
    ("", "MatMulInteger"): _op(shapes.product, U8, U8),
    ("", "MaxPool"): _op(shapes.pool, F, kernel_shape=INTS, strides=INTS, pads=INTS),
    ("", "Mod"): _op(shapes.rest, L, L),
    ("", "Mul"): _op(shapes.spread, (*F, *L), (*F, *L)),
    ("", "Not"): _op(shapes.same, B),
    ("", "QuantizeLinear"): _op(shapes.quantize, F, F, U8),
    ("", "Range"): _op(shapes.count, (*L, "int32"), (*L, "int32"), (*L, "int32")),
    ("", "ReduceSum"): _op(shapes.reduce, F, L, least=1, keepdims=INT),
    ("", "Reshape"): _op(shapes.reshape, ANY, L, allowzero=INT),
    ("", "ScatterElements"): _op(shapes.scatter, F, L, F, axis=INT, reduction=TEXT),
    ("", "Slice"): _op(shapes.cut, ANY, L, L, L, L, least=3),
    ("", "TopK"): _op(shapes.top, F, L, axis=INT, largest=INT, sorted=INT),
    ("", "Transpose"): _op(shapes.transpose, ANY, perm=INTS),
    ("", "Unsqueeze"): _op(shapes.unsqueeze, ANY, L),
    ("", "Where"): _op(shapes.choose, B, F, F),
    ("ai.onnx.ml", "ArrayFeatureExtractor"): _op(shapes.extract, L, L),
    ("ai.onnx.ml", "SVMClassifier"): _op(shapes.machine, F, **_MACHINE),
    ("ai.onnx.ml", "Scaler"): _op(shapes.scale, F, offset=FLOATS, scale=FLOATS),
    ("com.microsoft", "CDist"): _op(shapes.distances, F, F, metric=TEXT),
}
"""Operators by domain and name. Inputs that only decide shapes or indices are int64."""
