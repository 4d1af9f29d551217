"""The room of shapes. In: a node's inputs and settings. Out: type and shape of what it gives.

These are the rules of the operators that work number by number or along an axis, and what all rules share; moves.py and
operators.py have the others. They are those of the ONNX operator documents, with the bounds under which onnxruntime neither
reads beside an array nor divides by zero. What decides a size must be a constant of the file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

from numpy.typing import NDArray

from appliance.core.errors import BundleError

KINDS = {1: "float32", 2: "uint8", 3: "int8", 4: "uint16", 5: "int16", 6: "int32", 7: "int64", 9: "bool"}
"""Types of tensors by ONNX's code; there are no others in a bundle's model."""
MOST_RANK = 8
"""Dimensions of a tensor. Our own have up to five; onnxruntime reserves room for few."""
MOST_STEP = 1 << 16
"""Largest stride, dilation and kernel."""
PLACE = "place"
"""Of an int64 that numbers a place, and so is never negative: onnxruntime does not check that everywhere."""

Shape = tuple[int, ...]
Out = tuple[str, Shape]


@dataclass(frozen=True, slots=True)
class Value:
    """A tensor: its type, its shape, its numbers where they stand in the file. moved: whether a sweep changes it.

    place: an int64 that is never negative.
    """

    kind: str
    shape: Shape
    numbers: NDArray[Any] | None = None
    moved: bool = False
    place: bool = False


@dataclass(frozen=True, slots=True)
class Call:
    """A node's inputs and settings, as the table allows them."""

    inputs: Sequence[Value]
    given: Mapping[str, Any]

    def numbers(self, at: int, rank: int | None = None) -> list[int]:
        """The numbers of an input that must be a constant, and of so many dimensions."""
        value = self.inputs[at]
        if value.numbers is None:
            raise BundleError(f"input {at + 1} decides a size, but is no constant of the file")
        need(value.numbers.size <= MOST_RANK, f"input {at + 1} has {value.numbers.size} numbers (limit {MOST_RANK})")
        need(rank in (None, len(value.shape)), f"input {at + 1} has {len(value.shape)} dimensions instead of {rank}")
        found: list[int] = value.numbers.ravel().tolist()
        return found

    def constant(self, at: int) -> list[int]:
        """The numbers of an input that must be a constant in a row."""
        return self.numbers(at, 1)

    def axis(self, rank: int, usual: int | None = None) -> int:
        """The setting `axis` as a number from 0 on."""
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
        need(all(least <= v <= MOST_STEP for v in values), f"{name} = {values} is out of {least} to {MOST_STEP}")
        return values


def need(holds: bool, otherwise: str) -> None:
    """Raises BundleError where something does not hold."""
    if not holds:
        raise BundleError(otherwise)


def axes(given: Iterable[Any], rank: int) -> list[int]:
    """Axes as numbers from 0 on, each of them once."""
    named = list(given)
    need(all(type(a) is int and -rank <= a < rank for a in named), f"axis {named} of {rank} dimensions")
    found = [a % rank for a in named]
    need(0 < len(found) == len(set(found)), f"axes {named} must be some of {rank}, each once")
    return found


def together(*shapes: Shape) -> Shape:
    """The shape of tensors that are spread over each other."""
    found = []
    for sizes in zip_longest(*(reversed(s) for s in shapes), fillvalue=1):
        need(len(set(sizes) - {1}) < 2, f"shapes {[list(s) for s in shapes]} do not go together")
        found.append(max(sizes))
    return tuple(reversed(found))


def same(call: Call) -> Out:
    """Abs, Cos, Identity, Log, Neg, Not, Relu, Sin, Sqrt."""
    return call.inputs[0].kind, call.inputs[0].shape


def spread(call: Call) -> Out:
    """Add, Div, Max, Mul, Sub: number by number of tensors that are spread over each other."""
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
    """Mod: on some processors a division by zero, or of the least number by -1, ends the program."""
    need(all(n > 0 for n in call.numbers(1)), "divisors must be above 0")
    return spread(call)


def cast(call: Call) -> Out:
    """Cast."""
    to = call.given.get("to", 0)
    need(to in (1, 2, 7), f"type {to} is none to cast to")
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
    """ReduceMax and its like; up to opset 17 most have the axes as a setting."""
    x = call.inputs[0]
    need(len(call.inputs) == 1 or "axes" not in call.given, "axes are given twice")
    named = call.constant(1) if len(call.inputs) == 2 else call.given.get("axes", range(len(x.shape)))
    return x.kind, _without(x.shape, axes(named, len(x.shape)), call.flag("keepdims", 1))


def _without(shape: Shape, gone: Sequence[int], kept: bool) -> Shape:
    return tuple(1 if i in gone else n for i, n in enumerate(shape) if kept or i not in gone)


def highest(call: Call) -> Out:
    """ArgMax."""
    shape = call.inputs[0].shape
    return PLACE, _without(shape, [call.axis(len(shape), 0)], call.flag("keepdims", 1))


def top(call: Call) -> list[Out]:
    """TopK."""
    shape, k = list(call.inputs[0].shape), call.constant(1)
    axis = call.axis(len(shape), -1)
    call.flag("largest", 1), call.flag("sorted", 1)
    need(len(k) == 1 and 1 <= k[0] <= shape[axis], f"{k} of {shape[axis]} cannot be chosen")
    shape[axis] = k[0]
    return [("float32", tuple(shape)), (PLACE, tuple(shape))]
