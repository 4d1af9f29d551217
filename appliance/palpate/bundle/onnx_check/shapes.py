"""Computes type and shape of an operator's outputs; inputs that do not fit raise a BundleError.

The rules are those of the ONNX operator documents (https://onnx.ai/onnx/operators/), within bounds
in which onnxruntime neither reads beside an array nor divides by zero. Every input that decides a
size must be a constant of the file. Each rule's docstring lists its operators.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from math import prod
from typing import Any

from numpy.typing import NDArray

from palpate.core.errors import BundleError

KINDS = {
    1: "float32",
    2: "uint8",
    3: "int8",
    4: "uint16",
    5: "int16",
    6: "int32",
    7: "int64",
    9: "bool",
}
"""Types of tensors in a bundle's model, by ONNX's code."""
MOST_RANK = 8
"""Most dimensions of a tensor; those of our models have up to five."""
MOST_WINDOW_RANK = 3
"""Most dimensions of a convolution or a pool, besides samples and channels."""
MOST_STEP = 1 << 16
"""Largest stride, dilation and kernel."""
INDEX = "index"
"""Type of an int64 output that is an index and never negative. onnxruntime does not check indices
everywhere."""

Shape = tuple[int, ...]
Out = tuple[str, Shape]


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """A tensor. kind: type, of KINDS. numbers: of a constant of the file. index: an int64 that is
    never negative."""

    kind: str
    shape: Shape
    numbers: NDArray[Any] | None = None
    depends_on_sweep: bool = False
    index: bool = False


@dataclass(frozen=True, slots=True)
class Call:
    """A node's inputs and settings, of the types that operators.OPERATORS allows."""

    inputs: Sequence[Value]
    given: Mapping[str, Any]

    def numbers(self, at: int, rank: int | None = 1) -> list[int]:
        """The numbers of an input, which must be a constant of `rank` dimensions (None: any)."""
        value = self.inputs[at]
        if value.numbers is None:
            raise BundleError(f"input {at + 1} decides a size, but is not a constant of the file")
        need(
            value.numbers.size <= MOST_RANK,
            f"input {at + 1} has {value.numbers.size} numbers (limit {MOST_RANK})",
        )
        need(
            rank in (None, len(value.shape)),
            f"input {at + 1} has {len(value.shape)} dimensions instead of {rank}",
        )
        found: list[int] = value.numbers.ravel().tolist()
        return found

    def axis(self, rank: int, usual: int | None = None) -> int:
        """The setting `axis`, counted from 0."""
        return axes([self.given.get("axis", usual)], rank)[0]

    def flag(self, name: str, usual: int) -> bool:
        """A setting that is 0 or 1."""
        value = self.given.get(name, usual)
        need(value in (0, 1), f"{name} = {value} must be 0 or 1")
        return bool(value)

    def steps(self, name: str, count: int, usual: int, least: int) -> list[int]:
        """A setting of `count` whole numbers."""
        values = list(self.given.get(name, [usual] * count))
        need(len(values) == count, f"{name} has {len(values)} numbers instead of {count}")
        need(
            all(least <= v <= MOST_STEP for v in values),
            f"{name} = {values} is out of {least} to {MOST_STEP}",
        )
        return values


def need(holds: bool, otherwise: str) -> None:
    """Raises BundleError with the message `otherwise` unless `holds`."""
    if not holds:
        raise BundleError(otherwise)


def axes(given: Iterable[Any], rank: int) -> list[int]:
    """Axes, counted from 0. Raises BundleError if an axis is repeated."""
    named = list(given)
    need(
        all(type(a) is int and -rank <= a < rank for a in named),
        f"axis {named} of {rank} dimensions",
    )
    found = [a % rank for a in named]
    need(0 < len(found) == len(set(found)), f"axes {named} must be some of {rank}, each once")
    return found


def together(*shapes: Shape) -> Shape:
    """The shape of tensors that are broadcast over each other."""
    found = []
    for sizes in zip_longest(*(reversed(s) for s in shapes), fillvalue=1):
        need(len(set(sizes) - {1}) < 2, f"shapes {[list(s) for s in shapes]} do not go together")
        found.append(max(sizes))
    return tuple(reversed(found))


def same(call: Call) -> Out:
    """Abs, Cos, Identity, Log, Neg, Not, Relu, Sin, Sqrt."""
    return call.inputs[0].kind, call.inputs[0].shape


def spread(call: Call) -> Out:
    """Add, Div, Max, Mul, Sub, with broadcasting."""
    kinds = {x.kind for x in call.inputs}
    need(len(kinds) == 1, f"types {sorted(kinds)} do not go together")
    return kinds.pop(), together(*(x.shape for x in call.inputs))


def compare(call: Call) -> Out:
    """And, Equal, Greater, Less."""
    return "bool", spread(call)[1]


def choose(call: Call) -> Out:
    """Where."""
    return "float32", together(*(x.shape for x in call.inputs))


def rest(call: Call) -> Out:
    """Mod. On some processors dividing by zero, or the least number by -1, ends the program."""
    need(all(n > 0 for n in call.numbers(1, None)), "divisors must be above 0")
    return spread(call)


def cast(call: Call) -> Out:
    """Cast."""
    to = call.given.get("to", 0)
    need(to in (1, 2, 3, 7), f"type {to} is none to cast to")
    return KINDS[to], call.inputs[0].shape


def clip(call: Call) -> Out:
    """Clip."""
    need(all(x.shape == () for x in call.inputs[1:]), "limits must be single numbers")
    return same(call)


def along(call: Call) -> Out:
    """LogSoftmax."""
    call.axis(len(call.inputs[0].shape), -1)
    return same(call)


def reduce(call: Call) -> Out:
    """ReduceMax and similar operators. Up to opset 17 the axes are a setting for most of them."""
    x = call.inputs[0]
    need(len(call.inputs) == 1 or "axes" not in call.given, "axes are given twice")
    named = (
        call.numbers(1) if len(call.inputs) == 2 else call.given.get("axes", range(len(x.shape)))
    )
    return x.kind, _without(x.shape, axes(named, len(x.shape)), call.flag("keepdims", 1))


def _without(shape: Shape, gone: Sequence[int], kept: bool) -> Shape:
    return tuple(1 if i in gone else n for i, n in enumerate(shape) if kept or i not in gone)


def highest(call: Call) -> Out:
    """ArgMax."""
    shape = call.inputs[0].shape
    return INDEX, _without(shape, [call.axis(len(shape), 0)], call.flag("keepdims", 1))


def top(call: Call) -> list[Out]:
    """TopK."""
    shape, k = list(call.inputs[0].shape), call.numbers(1)
    axis = call.axis(len(shape), -1)
    call.flag("largest", 1), call.flag("sorted", 1)
    need(len(k) == 1 and 1 <= k[0] <= shape[axis], f"{k} of {shape[axis]} cannot be chosen")
    shape[axis] = k[0]
    return [("float32", tuple(shape)), (INDEX, tuple(shape))]


def concat(call: Call) -> Out:
    """Concat."""
    first, shapes = call.inputs[0], [list(x.shape) for x in call.inputs]
    axis = call.axis(len(first.shape))
    alike = {(x.kind, len(x.shape), x.shape[:axis], x.shape[axis + 1 :]) for x in call.inputs}
    need(
        len(alike) == 1,
        f"{sorted({x.kind for x in call.inputs})} of {shapes} cannot be joined along axis {axis}",
    )
    return first.kind, (*first.shape[:axis], sum(s[axis] for s in shapes), *first.shape[axis + 1 :])


def cut(call: Call) -> Out:
    """Slice."""
    x, n = call.inputs[0], len(call.inputs)
    starts, ends = call.numbers(1), call.numbers(2)
    along = axes(call.numbers(3) if n > 3 else range(len(starts)), len(x.shape))
    steps = call.numbers(4) if n > 4 else [1] * len(starts)
    need(
        len(starts) == len(ends) == len(along) == len(steps),
        "starts, ends, axes and steps differ in number",
    )
    need(all(s >= 1 for s in steps), f"steps {steps} must be above 0")
    shape = list(x.shape)
    for axis, start, end, step in zip(along, starts, ends, steps, strict=True):
        shape[axis] = len(range(*slice(start, end, step).indices(shape[axis])))
    return x.kind, tuple(shape)


def gather(call: Call) -> Out:
    """Gather."""
    x, at = call.inputs
    axis = call.axis(len(x.shape), 0)
    _within(at, x.shape[axis])
    return x.kind, x.shape[:axis] + at.shape + x.shape[axis + 1 :]


def _within(at: Value, size: int) -> None:
    """Raises BundleError for a constant index out of range. onnxruntime checks all others."""
    n = at.numbers
    need(n is None or bool(-size <= n.min() and n.max() < size), f"an index is out of {size}")


def gather_each(call: Call) -> Out:
    """GatherElements."""
    x, at = call.inputs
    _beside(call, x, at)
    return x.kind, at.shape


def scatter(call: Call) -> Out:
    """ScatterElements."""
    x, at, new = call.inputs
    _beside(call, x, at)
    need(
        new.shape == at.shape and new.kind == x.kind,
        "indices and updates differ in shape or type",
    )
    need(call.given.get("reduction", b"none") in (b"none", b"add"), "reduction must be none or add")
    return x.kind, x.shape


def _beside(call: Call, x: Value, at: Value) -> None:
    """Raises BundleError unless `at` has as many dimensions as `x`, and none is larger than in `x`
    except along the axis."""
    axis = call.axis(len(x.shape), 0)
    fits = len(x.shape) == len(at.shape) and all(
        i == axis or a <= n for i, (a, n) in enumerate(zip(at.shape, x.shape, strict=True))
    )
    need(fits, f"indices of {list(at.shape)} do not fit {list(x.shape)}")
    _within(at, x.shape[axis])


def extract(call: Call) -> Out:
    """ArrayFeatureExtractor. For a negative index onnxruntime reads before the array."""
    x, at = call.inputs
    need(at.index, "indices must come from TopK or ArgMax")
    need(x.shape != (), "nothing to choose from")
    return x.kind, (*(x.shape[:-1] or (1,)), prod(at.shape))


def reshape(call: Call) -> Out:
    """Reshape."""
    x, wanted = call.inputs[0], call.numbers(1)
    need(call.given.get("allowzero", 0) == 0, "allowzero must be 0")
    need(
        all(n > 0 or n == -1 or (n == 0 and i < len(x.shape)) for i, n in enumerate(wanted)),
        f"{wanted} is not a shape",
    )
    shape = [n or x.shape[i] for i, n in enumerate(wanted)]
    if -1 in shape:
        others = prod(n for n in shape if n > 0)
        shape[shape.index(-1)] = prod(x.shape) // others
    need(
        -1 not in shape and prod(shape) == prod(x.shape), f"{list(x.shape)} cannot become {wanted}"
    )
    return _as(x), tuple(shape)


def flatten(call: Call) -> Out:
    """Flatten."""
    x, axis = call.inputs[0], call.given.get("axis", 1)
    need(0 <= axis <= len(x.shape), f"axis {axis} of {len(x.shape)} dimensions")
    return _as(x), (prod(x.shape[:axis]), prod(x.shape[axis:]))


def _as(x: Value) -> str:
    return INDEX if x.index else x.kind


def unsqueeze(call: Call) -> Out:
    """Unsqueeze."""
    x, new = call.inputs[0], call.numbers(1)
    left = iter(x.shape)
    rank = len(x.shape) + len(new)
    at = axes(new, rank)
    return x.kind, tuple(1 if i in at else next(left) for i in range(rank))


def transpose(call: Call) -> Out:
    """Transpose."""
    x = call.inputs[0]
    order = call.given.get("perm", list(range(len(x.shape)))[::-1])
    need(
        sorted(order) == list(range(len(x.shape))),
        f"perm {order} is not an order of {len(x.shape)} dimensions",
    )
    return x.kind, tuple(x.shape[i] for i in order)


def expand(call: Call) -> Out:
    """Expand."""
    wanted = call.numbers(1)
    need(all(n > 0 for n in wanted), f"{wanted} is not a shape")
    return call.inputs[0].kind, together(call.inputs[0].shape, tuple(wanted))


def filled(call: Call) -> Out:
    """ConstantOfShape."""
    value = call.given.get("value", Value("float32", (1,)))
    need(value.shape == (1,) and value.kind == "float32", "value must be one float")
    return "float32", tuple(call.numbers(0))


def count(call: Call) -> Out:
    """Range."""
    (start,), (end,), (step,) = (call.numbers(i, 0) for i in range(3))
    need(
        all(abs(n) < 1 << 31 for n in (start, end, step)) and step != 0,
        f"{start} to {end} in steps of {step}",
    )
    return spread(call)[0], (max(0, -((start - end) // step)),)


def windows(call: Call, kernel: Shape) -> Shape:
    """Number of positions of a kernel along each of the last dimensions."""
    size, n = call.inputs[0].shape[2:], len(kernel)
    need(0 < n == len(size) <= MOST_WINDOW_RANK, f"a kernel of {list(kernel)} on {list(size)}")
    strides, dilations = call.steps("strides", n, 1, 1), call.steps("dilations", n, 1, 1)
    pads, reach = (
        call.steps("pads", 2 * n, 0, 0),
        [d * (k - 1) + 1 for d, k in zip(dilations, kernel, strict=True)],
    )
    need(
        all(p < r for p, r in zip(pads, reach * 2, strict=True)),
        f"pads {pads} beyond a kernel that reaches {reach}",
    )
    free = [s + p + q - r for s, p, q, r in zip(size, pads, pads[n:], reach, strict=False)]
    need(
        all(f >= 0 for f in free),
        f"a kernel that reaches {reach} is larger than {list(size)} with pads {pads}",
    )
    return tuple(f // s + 1 for f, s in zip(free, strides, strict=True))


def conv(call: Call) -> Out:
    """Conv."""
    x, w = (value.shape for value in call.inputs[:2])
    groups = call.given.get("group", 1)
    fit = len(x) == len(w) > 2 and x[1] == groups * w[1]
    need(fit, f"weights of {list(w)} on {list(x)} with group = {groups}")
    need(groups > 0 and w[0] % groups == 0, f"group = {groups} does not divide {w[0]} filters")
    need(
        len(call.inputs) == 2 or call.inputs[2].shape == w[:1], "one bias for each filter is wanted"
    )
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
    return kind, (*together(a[:-2], b[:-2]), a[-2], b[-1])


def gemm(call: Call) -> Out:
    """Gemm."""
    a, b = (
        value.shape[::-1] if call.flag(name, 0) else value.shape
        for value, name in zip(call.inputs, ("transA", "transB"), strict=False)
    )
    need(len(a) == len(b) == 2 and a[1] == b[0], f"{list(a)} times {list(b)}")
    out = (a[0], b[1])
    need(
        len(call.inputs) == 2 or together(call.inputs[2].shape, out) == out,
        "what is added is too large",
    )
    return "float32", out


def recurrent(call: Call) -> Out:
    """GRU, forward: [steps, samples, inputs] -> [steps, 1, samples, state]."""
    x, *weights = (value.shape for value in call.inputs)
    size = call.given.get("hidden_size", 0)
    call.flag("linear_before_reset", 0)
    need(len(x) == 3 and 0 < size <= MOST_STEP, f"a state of {size} on {list(x)}")
    need(
        weights == [(1, 3 * size, x[2]), (1, 3 * size, size), (1, 6 * size)],
        f"weights of {weights}",
    )
    return "float32", (x[0], 1, x[1], size)


def quantize(call: Call) -> Out:
    """QuantizeLinear, with one step."""
    need(
        all(prod(x.shape) == 1 and len(x.shape) < 2 for x in call.inputs[1:]),
        "step and zero must be single numbers",
    )
    return "uint8", call.inputs[0].shape


def dequantize(call: Call) -> Out:
    """DequantizeLinear, with one step or one step for each index along an axis."""
    x, step, zero = call.inputs
    each = (1,) if prod(step.shape) == 1 else (x.shape[call.axis(len(x.shape), 1)],)
    fits = step.shape in ((), each) and zero.shape == step.shape
    need(fits, f"steps and zeros of {list(step.shape)} do not fit {list(x.shape)}")
    need(zero.kind == x.kind, f"zeros of {zero.kind} for {x.kind}")
    return "float32", x.shape


def scale(call: Call) -> Out:
    """Scaler."""
    x = call.inputs[0].shape
    for name in ("offset", "scale"):
        need(
            len(x) == 2 and len(call.given.get(name, ())) == x[1],
            f"{name} must have a number for each of {list(x)}",
        )
    return "float32", x


def distances(call: Call) -> Out:
    """CDist."""
    a, b = (value.shape for value in call.inputs)
    need(call.given.get("metric") == b"euclidean", "metric must be euclidean")
    need(len(a) == len(b) == 2 and a[1] == b[1], f"distances of {list(a)} to {list(b)}")
    return "float32", (a[0], b[0])


def machine(call: Call) -> list[Out]:
    """SVMClassifier. onnxruntime does not check the lengths of its tables."""
    x, given = call.inputs[0].shape, call.given
    need(len(x) == 2 and x[0] == 1, f"one row of features is wanted, not {list(x)}")
    classes, each = (
        list(given.get("classlabels_ints", ())),
        list(given.get("vectors_per_class", ())),
    )
    pairs, vectors = len(classes) * (len(classes) - 1) // 2, sum(each)
    need(
        len(classes) > 1 and len(set(classes)) == len(classes) == len(each),
        "classes and their vectors do not fit",
    )
    need(all(0 < n <= MOST_STEP for n in each), f"vectors_per_class = {each}")
    lengths = {
        "support_vectors": vectors * x[1],
        "coefficients": vectors * (len(classes) - 1),
        "rho": pairs,
        "kernel_params": 3,
    }
    for name, length in lengths.items():
        have = len(given.get(name, ()))
        need(have == length, f"{name} has {have} numbers instead of {length}")
    need(given.get("kernel_type") in (b"RBF", b"LINEAR"), "kernel_type must be RBF or LINEAR")
    need(given.get("post_transform") == b"NONE", "post_transform must be NONE")
    return [("int64", (1,)), ("float32", (1, max(pairs, 2)))]
