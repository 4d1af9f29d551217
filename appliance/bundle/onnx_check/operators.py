"""The room of operators. In: a node with its inputs. Out: what it gives, how many products it takes, how much workspace.

The table at the end is all that a bundle's model may use: the operators that the exporters of train/ write, with the
settings and types that they write. Above it stand the rules of those that add up products.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import prod

from appliance.bundle.onnx_check import moves, shapes
from appliance.bundle.onnx_check.shapes import KINDS, Call, Out, Shape, need

FLOAT, INT, TEXT, TENSOR, FLOATS, INTS = 1, 2, 3, 4, 6, 7
"""Types of settings by ONNX's code."""
ANY, F, L, B, U8 = tuple(KINDS.values()), ("float32",), ("int64",), ("bool",), ("uint8",)
MOST_DIMENSIONS = 3
"""Of a convolution, besides samples and channels."""


def windows(call: Call, kernel: Shape) -> Shape:
    """How often a kernel fits along each of the last dimensions."""
    size, n = call.inputs[0].shape[2:], len(kernel)
    need(0 < n == len(size) <= MOST_DIMENSIONS, f"a kernel of {list(kernel)} on {list(size)}")
    strides, dilations = call.steps("strides", n, 1, 1), call.steps("dilations", n, 1, 1)
    pads, reach = call.steps("pads", 2 * n, 0, 0), [d * (k - 1) + 1 for d, k in zip(dilations, kernel, strict=True)]
    need(all(p < r for p, r in zip(pads, reach * 2, strict=True)), f"pads {pads} beyond a kernel that reaches {reach}")
    room = [s + p + q - r for s, p, q, r in zip(size, pads, pads[n:], reach, strict=False)]
    need(all(r >= 0 for r in room), f"a kernel that reaches {reach} is larger than {list(size)} with pads {pads}")
    return tuple(r // s + 1 for r, s in zip(room, strides, strict=True))


def conv(call: Call) -> Out:
    """Conv, of one group."""
    x, w = (value.shape for value in call.inputs[:2])
    need(len(x) == len(w) > 2 and x[1] == w[1], f"weights of {list(w)} on {list(x)}")
    need(len(call.inputs) == 2 or call.inputs[2].shape == w[:1], "one bias for each filter is wanted")
    return "float32", (x[0], w[0], *windows(call, w[2:]))


def pool(call: Call) -> Out:
    """MaxPool."""
    x, kernel = call.inputs[0].shape, call.given.get("kernel_shape", [])
    call.steps("kernel_shape", len(kernel), 1, 1)
    need(len(x) > 2, f"nothing to pool in {list(x)}")
    return "float32", (*x[:2], *windows(call, tuple(kernel)))


def product(call: Call) -> Out:
    """MatMul, MatMulInteger."""
    a, b = (value.shape for value in call.inputs)
    need(len(a) > 1 and len(b) > 1 and a[-1] == b[-2], f"{list(a)} times {list(b)}")
    kind = "float32" if call.inputs[0].kind == "float32" else "int32"
    return kind, (*shapes.together(a[:-2], b[:-2]), a[-2], b[-1])


def gemm(call: Call) -> Out:
    """Gemm."""
    a, b = (value.shape[::-1] if call.flag(name, 0) else value.shape
            for value, name in zip(call.inputs, ("transA", "transB"), strict=False))  # fmt: skip
    need(len(a) == len(b) == 2 and a[1] == b[0], f"{list(a)} times {list(b)}")
    out = (a[0], b[1])
    need(len(call.inputs) == 2 or shapes.together(call.inputs[2].shape, out) == out, "what is added is too large")
    return "float32", out


def recurrent(call: Call) -> Out:
    """GRU, forward: [steps, samples, inputs] -> [steps, 1, samples, state]."""
    x, *weights = (value.shape for value in call.inputs)
    size = call.given.get("hidden_size", 0)
    call.flag("linear_before_reset", 0)
    need(len(x) == 3 and 0 < size <= shapes.MOST_STEP, f"a state of {size} on {list(x)}")
    need(weights == [(1, 3 * size, x[2]), (1, 3 * size, size), (1, 6 * size)], f"weights of {weights}")
    return "float32", (x[0], 1, x[1], size)


def quantize(call: Call) -> Out:
    """QuantizeLinear, with one step."""
    need(all(prod(x.shape) == 1 and len(x.shape) < 2 for x in call.inputs[1:]), "step and zero must be single numbers")
    return "uint8", call.inputs[0].shape


def dequantize(call: Call) -> Out:
    """DequantizeLinear, with one step or one for each place along an axis."""
    x, step, zero = call.inputs
    each = (1,) if prod(step.shape) == 1 else (x.shape[call.axis(len(x.shape), 1)],)
    need(
        step.shape in ((), each) and zero.shape == step.shape, "as many steps and zeros are wanted as there are places"
    )
    need(zero.kind == x.kind, f"zeros of {zero.kind} for {x.kind}")
    return "float32", x.shape


def scale(call: Call) -> Out:
    """Scaler."""
    x = call.inputs[0].shape
    for name in ("offset", "scale"):
        need(len(x) == 2 and len(call.given.get(name, ())) == x[1], f"{name} must have a number for each of {list(x)}")
    return "float32", x


def distances(call: Call) -> Out:
    """CDist."""
    a, b = (value.shape for value in call.inputs)
    need(call.given.get("metric") == b"euclidean", "metric must be euclidean")
    need(len(a) == len(b) == 2 and a[1] == b[1], f"distances of {list(a)} to {list(b)}")
    return "float32", (a[0], b[0])


def machine(call: Call) -> list[Out]:
    """SVMClassifier: onnxruntime takes the lengths of its tables for granted."""
    x, given = call.inputs[0].shape, call.given
    need(len(x) == 2 and x[0] == 1, f"one row of features is wanted, not {list(x)}")
    classes, each = list(given.get("classlabels_ints", ())), list(given.get("vectors_per_class", ()))
    pairs, vectors = len(classes) * (len(classes) - 1) // 2, sum(each)
    need(len(classes) > 1 and len(set(classes)) == len(classes) == len(each), "classes and their vectors do not fit")
    need(all(0 < n <= shapes.MOST_STEP for n in each), f"vectors_per_class = {each}")
    lengths = {"support_vectors": vectors * x[1], "coefficients": vectors * (len(classes) - 1), "rho": pairs,
               "kernel_params": 3}  # fmt: skip
    for name, length in lengths.items():
        have = len(given.get(name, ()))
        need(have == length, f"{name} has {have} numbers instead of {length}")
    need(given.get("kernel_type") in (b"RBF", b"LINEAR"), "kernel_type must be RBF or LINEAR")
    need(given.get("post_transform") == b"NONE", "post_transform must be NONE")
    return [("int64", (1,)), ("float32", (1, max(pairs, 2)))]


@dataclass(frozen=True, slots=True)
class Operator:
    """What a bundle's model may do with one operator.

    rule: what it gives. kinds: types of its inputs in their order, the last of them for all that follow. least, most:
    how many inputs. settings: code of the type of each.
    """

    rule: Callable[[Call], Out | list[Out]]
    kinds: tuple[tuple[str, ...], ...]
    least: int
    most: int
    settings: Mapping[str, int]


def _op(
    rule: Callable[[Call], Out | list[Out]], *kinds: tuple[str, ...], least: int = 0, most: int = 0, **settings: int
) -> Operator:
    return Operator(rule, kinds, least or len(kinds), most or len(kinds), settings)


def work(name: str, call: Call, out: Shape) -> tuple[int, int]:
    """How many products a node takes that gives `out`, and how many bytes of workspace."""
    first, given = call.inputs[0].shape, call.given
    if name == "Conv":  # a window is laid out for each place before it is multiplied
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
    if name in ("TopK", "ScatterElements"):  # a place of eight bytes for each number
        return 0, 8 * prod(call.inputs[0].shape)
    if name == "SVMClassifier":  # its tables are copied, unlike constants, from settings
        numbers = len(given["support_vectors"]) + len(given["coefficients"])
        return numbers, 16 * numbers
    return 0, 0


_ONE, _TWO = _op(shapes.same, F), _op(shapes.spread, F, F)
_COMPARED = _op(shapes.compare, (*F, *L, "int32"), (*F, *L, "int32"))
_REDUCED = _op(shapes.reduce, F, L, least=1, axes=INTS, keepdims=INT)
_STEPPED = ("uint8", "int8", "int32")
_TABLES = {name: FLOATS for name in ("coefficients", "kernel_params", "rho", "support_vectors")}
OPERATORS: dict[tuple[str, str], Operator] = {
    **dict.fromkeys([("", name) for name in ("Abs", "Cos", "Log", "Neg", "Relu", "Sin", "Sqrt")], _ONE),
    **dict.fromkeys([("", name) for name in ("Add", "Div", "Max", "Sub")], _TWO),
    **dict.fromkeys([("", name) for name in ("Equal", "Greater", "Less")], _COMPARED),
    **dict.fromkeys([("", f"Reduce{name}") for name in ("Max", "Mean", "Min", "SumSquare")], _REDUCED),
    ("", "And"): _op(shapes.compare, B, B),
    ("", "ArgMax"): _op(shapes.highest, F, axis=INT, keepdims=INT),
    ("", "Cast"): _op(shapes.cast, ANY, to=INT),
    ("", "Clip"): _op(shapes.clip, F, F, F),
    ("", "Concat"): _op(moves.concat, (*F, *L, "int32"), most=1000, axis=INT),
    ("", "ConstantOfShape"): _op(moves.filled, L, value=TENSOR),
    ("", "Conv"): _op(conv, F, F, F, least=2, strides=INTS, pads=INTS, dilations=INTS),
    ("", "DequantizeLinear"): _op(dequantize, _STEPPED, F, _STEPPED, axis=INT),
    ("", "Expand"): _op(moves.expand, (*F, *U8), L),
    ("", "Flatten"): _op(moves.flatten, ANY, axis=INT),
    ("", "GRU"): _op(recurrent, F, F, F, F, hidden_size=INT, linear_before_reset=INT),
    ("", "Gather"): _op(moves.gather, (*F, *L), L, axis=INT),
    ("", "GatherElements"): _op(moves.gather_each, F, L, axis=INT),
    ("", "Gemm"): _op(gemm, F, F, F, least=2, alpha=FLOAT, beta=FLOAT, transA=INT, transB=INT),
    ("", "Identity"): _op(shapes.same, ANY),
    ("", "LogSoftmax"): _op(shapes.along, F, axis=INT),
    ("", "MatMul"): _op(product, F, F),
    ("", "MatMulInteger"): _op(product, U8, U8),
    ("", "MaxPool"): _op(pool, F, kernel_shape=INTS, strides=INTS, pads=INTS),
    ("", "Mod"): _op(shapes.rest, L, L),
    ("", "Mul"): _op(shapes.spread, (*F, *L), (*F, *L)),
    ("", "Not"): _op(shapes.same, B),
    ("", "QuantizeLinear"): _op(quantize, F, F, U8),
    ("", "Range"): _op(moves.count, (*L, "int32"), (*L, "int32"), (*L, "int32")),
    ("", "ReduceSum"): _op(shapes.reduce, F, L, least=1, keepdims=INT),
    ("", "Reshape"): _op(moves.reshape, ANY, L, allowzero=INT),
    ("", "ScatterElements"): _op(moves.scatter, F, L, F, axis=INT, reduction=TEXT),
    ("", "Slice"): _op(moves.cut, ANY, L, L, L, L, least=3),
    ("", "TopK"): _op(shapes.top, F, L, axis=INT, largest=INT, sorted=INT),
    ("", "Transpose"): _op(moves.transpose, ANY, perm=INTS),
    ("", "Unsqueeze"): _op(moves.unsqueeze, ANY, L),
    ("", "Where"): _op(shapes.choose, B, F, F),
    ("ai.onnx.ml", "ArrayFeatureExtractor"): _op(moves.extract, L, L),
    ("ai.onnx.ml", "SVMClassifier"): _op(
        machine, F, classlabels_ints=INTS, vectors_per_class=INTS, kernel_type=TEXT, post_transform=TEXT, **_TABLES
    ),
    ("ai.onnx.ml", "Scaler"): _op(scale, F, offset=FLOATS, scale=FLOATS),
    ("com.microsoft", "CDist"): _op(distances, F, F, metric=TEXT),
}
"""By domain and name. Constants that only decide shapes and places are int64, and so are those here."""
