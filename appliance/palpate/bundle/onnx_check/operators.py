"""The operators that a bundle's model may use: those that the exporters of palpate-train write.

Within these bounds the size of every value is the same for every sweep, and onnxruntime neither
divides by zero nor reads beside an array: what the trial of a new bundle has shown holds for all
sweeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
INDEX = "index"
"""Type of an int64 output that is an index and never negative. onnxruntime does not check indices
everywhere."""
FIRST, SECOND = "first", "second"
"""Type of an output that has the type of an input."""


@dataclass(frozen=True, slots=True)
class Operator:
    """Allowed use of one operator.

    gives: types of its outputs. fixed: from this input on, inputs decide a size or divide, so they
    must not depend on the sweep.
    """

    gives: tuple[str, ...]
    fixed: int


def _each(
    names: str, gives: str = FIRST, fixed: int = 1000, domain: str = ""
) -> dict[tuple[str, str], Operator]:
    return {(domain, name): Operator(tuple(gives.split()), fixed) for name in names.split()}


OPERATORS: dict[tuple[str, str], Operator] = {
    **_each("Abs Add Clip Concat Conv Cos Div Flatten GRU Gather GatherElements Gemm Identity Log"),
    **_each("LogSoftmax MatMul Max MaxPool Mul Neg Relu ScatterElements Sin Sqrt Sub Transpose"),
    **_each("Expand Mod Reshape Slice Unsqueeze", fixed=1),
    **_each("ReduceMax ReduceMean ReduceMin ReduceSum ReduceSumSquare", fixed=1),
    **_each("ConstantOfShape", "float32", fixed=0),
    **_each("Range", fixed=0),
    **_each("And Equal Greater Less Not", "bool"),
    **_each("ArgMax", INDEX),
    **_each("TopK", f"{FIRST} {INDEX}", fixed=1),
    **_each("Cast Where", SECOND),
    **_each("DequantizeLinear", "float32"),
    **_each("MatMulInteger", "int32"),
    **_each("QuantizeLinear", "uint8"),
    **_each("ArrayFeatureExtractor Scaler", domain="ai.onnx.ml"),
    **_each("SVMClassifier", "int64 float32", domain="ai.onnx.ml"),
    **_each("CDist", domain="com.microsoft"),
}
"""Operators by domain and name. onnxruntime itself checks number and types of their inputs."""


def need(holds: bool, otherwise: str) -> None:
    """Raises BundleError with the message `otherwise` unless `holds`."""
    if not holds:
        raise BundleError(otherwise)


def check_tables(settings: dict[str, Any]) -> None:
    """Raises BundleError if the tables of SVMClassifier do not fit each other; onnxruntime would
    read beside them."""
    classes, each = (
        list(settings[name].ints) for name in ("classlabels_ints", "vectors_per_class")
    )
    need(
        1 < len(classes) == len(set(classes)) == len(each) and min(each) > 0,
        "classes and their vectors do not fit",
    )
    wanted = {
        "coefficients": sum(each) * (len(classes) - 1),
        "rho": len(classes) * (len(classes) - 1) // 2,
        "kernel_params": 3,
    }
    for name, length in wanted.items():
        have = len(settings[name].floats)
        need(have == length, f"{name} has {have} numbers instead of {length}")
    vectors = len(settings["support_vectors"].floats)
    need(vectors > 0 and vectors % sum(each) == 0, f"support_vectors has {vectors} numbers")
    need(settings["kernel_type"].s in (b"RBF", b"LINEAR"), "kernel_type must be RBF or LINEAR")
    need(settings["post_transform"].s == b"NONE", "post_transform must be NONE")
