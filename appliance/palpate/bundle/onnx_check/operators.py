"""The operators that a bundle's model may use, with the inputs and settings that are allowed.

They are the operators that the exporters of palpate-train write. Within these bounds the size of
every value is the same for every sweep, and onnxruntime neither divides by zero nor reads outside
an array: what the trial of a new bundle has shown holds for all sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from palpate.core.errors import BundleError

FLOAT, INT, TEXT, TENSOR, FLOATS, INTS = 1, 2, 3, 4, 6, 7
"""Types of settings by ONNX's code."""
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
INDEX = "index"
"""Type of an int64 output that is an index and never negative. onnxruntime does not check indices
everywhere."""
SAME = "same"
"""Type of an output that has the type of the first input."""
ANY, F, L, B, U8 = (*KINDS.values(), INDEX), ("float32",), ("int64", INDEX), ("bool",), ("uint8",)
MOST_STEP = 1 << 16
"""Largest stride, padding, dilation and kernel, and most support vectors of a class."""


@dataclass(frozen=True, slots=True)
class Operator:
    """Allowed use of one operator.

    gives: types of its outputs. kinds: allowed types of its inputs in order; the last entry applies
    to all further inputs. least, most: number of inputs. fixed: from this input on, inputs decide a
    size, so they must not depend on the sweep. settings: code of the type of each setting.
    """

    gives: tuple[str, ...]
    kinds: tuple[tuple[str, ...], ...]
    least: int
    most: int
    fixed: int
    settings: Mapping[str, int]


def _op(
    gives: str,
    *kinds: tuple[str, ...],
    least: int = 0,
    most: int = 0,
    fixed: int = 1000,
    **settings: int,
) -> Operator:
    count = len(kinds)
    return Operator(tuple(gives.split()), kinds, least or count, most or count, fixed, settings)


_NUMBER = (*F, *L, *U8, "int32")
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
    **{("", name): _op(SAME, F) for name in ("Abs", "Cos", "Log", "Neg", "Relu", "Sin", "Sqrt")},
    **{("", name): _op(SAME, F, F) for name in ("Add", "Div", "Max", "Sub")},
    **{("", name): _op("bool", _NUMBER, _NUMBER) for name in ("Equal", "Greater", "Less")},
    **{
        ("", f"Reduce{name}"): _op(SAME, F, L, least=1, fixed=1, axes=INTS, keepdims=INT)
        for name in ("Max", "Mean", "Min", "SumSquare")
    },
    ("", "And"): _op("bool", B, B),
    ("", "ArgMax"): _op(INDEX, F, axis=INT, keepdims=INT),
    ("", "Cast"): _op(SAME, ANY, to=INT),
    ("", "Clip"): _op(SAME, (*F, *U8), (*F, *U8), (*F, *U8)),
    ("", "Concat"): _op(SAME, _NUMBER, most=1000, axis=INT),
    ("", "ConstantOfShape"): _op("float32", L, fixed=0, value=TENSOR),
    ("", "Conv"): _op(SAME, F, F, F, least=2, strides=INTS, pads=INTS, dilations=INTS, group=INT),
    ("", "DequantizeLinear"): _op("float32", _STEPPED, F, _STEPPED, axis=INT),
    ("", "Expand"): _op(SAME, (*F, *U8), L, fixed=1),
    ("", "Flatten"): _op(SAME, ANY, axis=INT),
    ("", "GRU"): _op(SAME, F, F, F, F, hidden_size=INT, linear_before_reset=INT),
    ("", "Gather"): _op(SAME, (*F, *L), L, axis=INT),
    ("", "GatherElements"): _op(SAME, F, L, axis=INT),
    ("", "Gemm"): _op(SAME, F, F, F, least=2, alpha=FLOAT, beta=FLOAT, transA=INT, transB=INT),
    ("", "Identity"): _op(SAME, ANY),
    ("", "LogSoftmax"): _op(SAME, F, axis=INT),
    ("", "MatMul"): _op(SAME, F, F),
    ("", "MatMulInteger"): _op("int32", U8, U8),
    ("", "MaxPool"): _op(SAME, F, kernel_shape=INTS, strides=INTS, pads=INTS),
    ("", "Mod"): _op(SAME, L, L, fixed=1),
    ("", "Mul"): _op(SAME, (*F, *L), (*F, *L)),
    ("", "Not"): _op("bool", B),
    ("", "QuantizeLinear"): _op("uint8", F, F, U8),
    ("", "Range"): _op(SAME, (*L, "int32"), (*L, "int32"), (*L, "int32"), fixed=0),
    ("", "ReduceSum"): _op(SAME, F, L, least=1, fixed=1, keepdims=INT),
    ("", "Reshape"): _op(SAME, ANY, L, fixed=1, allowzero=INT),
    ("", "ScatterElements"): _op(SAME, F, L, F, axis=INT, reduction=TEXT),
    ("", "Slice"): _op(SAME, ANY, L, L, L, L, least=3, fixed=1),
    ("", "TopK"): _op(f"{SAME} {INDEX}", F, L, fixed=1, axis=INT, largest=INT, sorted=INT),
    ("", "Transpose"): _op(SAME, ANY, perm=INTS),
    ("", "Unsqueeze"): _op(SAME, ANY, L, fixed=1),
    ("", "Where"): _op("float32", B, F, F),
    ("ai.onnx.ml", "ArrayFeatureExtractor"): _op(SAME, L, (INDEX,)),
    ("ai.onnx.ml", "SVMClassifier"): _op("int64 float32", F, **_MACHINE),
    ("ai.onnx.ml", "Scaler"): _op(SAME, F, offset=FLOATS, scale=FLOATS),
    ("com.microsoft", "CDist"): _op("float32", F, F, metric=TEXT),
}
"""Operators by domain and name. Inputs that only decide shapes or indices are int64."""


def need(holds: bool, otherwise: str) -> None:
    """Raises BundleError with the message `otherwise` unless `holds`."""
    if not holds:
        raise BundleError(otherwise)


def check_settings(name: str, given: Mapping[str, Any]) -> None:
    """Raises BundleError for settings of an operator that onnxruntime does not check itself."""
    for which, least in (("strides", 1), ("dilations", 1), ("kernel_shape", 1), ("pads", 0)):
        steps = list(given.get(which, ()))
        fits = all(least <= step <= MOST_STEP for step in steps)
        need(fits, f"{which} = {steps[:8]} is out of {least} to {MOST_STEP}")
    need(given.get("group", 1) > 0, f"group = {given.get('group')} must be above 0")
    if name == "SVMClassifier":
        _check_machine(given)


def _check_machine(given: Mapping[str, Any]) -> None:
    """Raises BundleError if the tables of SVMClassifier do not fit each other."""
    classes = list(given.get("classlabels_ints", ()))
    each = list(given.get("vectors_per_class", ()))
    need(
        len(classes) > 1 and len(set(classes)) == len(classes) == len(each),
        "classes and their vectors do not fit",
    )
    need(all(0 < n <= MOST_STEP for n in each), f"vectors_per_class = {each[:8]}")
    have = {name: len(given.get(name, ())) for name, code in _MACHINE.items() if code == FLOATS}
    wanted = {
        "coefficients": sum(each) * (len(classes) - 1),
        "rho": len(classes) * (len(classes) - 1) // 2,
        "kernel_params": 3,
    }
    for name, length in wanted.items():
        need(have[name] == length, f"{name} has {have[name]} numbers instead of {length}")
    vectors = have["support_vectors"]
    need(vectors > 0 and vectors % sum(each) == 0, f"support_vectors has {vectors} numbers")
    need(given.get("kernel_type") in (b"RBF", b"LINEAR"), "kernel_type must be RBF or LINEAR")
    need(given.get("post_transform") == b"NONE", "post_transform must be NONE")
