"""Nodes that stages and filter bank share. In: tensors of a graph. Out: the same in integers, or
summed over time.

Integers go up to the sums over time, so that all machines give the same bits there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto

from train.models.recipe import spectrum
from train.models.recipe.architectures import Stage
from train.onnx_tools.graph_builder import GraphBuilder

Array = NDArray[Any]
FLOAT = TensorProto.FLOAT
TENTHS = spectrum.SEGMENTS
"""Into how many parts a window is cut for early decisions."""
MAX_TAP = 64
"""Largest integer tap, seven bits: two products of eight bits overflow the 16-bit sums of an x86
without VNNI, and the answer there would differ from that on Arm."""
MIDDLE = 128
"""The byte that stands for 0 where bytes have a sign."""


def quantized(g: GraphBuilder, x: str, step: float, zero: int = 0) -> str:
    """`x` as bytes, in units of `step`."""
    return g("QuantizeLinear", x, g.constant(step), g.constant(zero, "uint8"))


def counts_of(g: GraphBuilder, x: str, step: float, zero: int = 0) -> str:
    """The values that bytes stand for, in units of `step`."""
    return g("DequantizeLinear", x, g.constant(step), g.constant(zero, "uint8"))


def channels_first(g: GraphBuilder, x: str, step: float, zero: int) -> str:
    """Bytes [n, T, R * C] -> the values they stand for [n, R * C, T]."""
    return counts_of(g, g("Transpose", x, perm=[0, 2, 1]), step, zero)


def int8_weights(
    g: GraphBuilder, weight: Array, bias: Array, step: float, zero_sum: bool
) -> tuple[str, str]:
    """Weight [filters, inputs, kernel] in seven bits, a step for each filter; bias in 32 bits, in
    the product of both steps."""
    least = np.abs(bias) / (step * 2**30)  # a silent filter's bias must fit as well
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


def zero_sum_taps(taps: Array) -> Array:
    """Taps [filters, taxels, kernel] rounded so that each kernel sums to zero, as it did before
    rounding.

    The sum after rounding is the surplus. As many taps, those nearest to being rounded the other
    way, are rounded that way instead. None leaves the range: a tap at its end is whole and was not
    rounded, and there are enough others.
    """
    taps = taps - taps.mean(axis=2, keepdims=True)
    rounded = np.rint(taps)
    surplus = rounded.sum(axis=2, keepdims=True)
    moved = (rounded - taps) * np.sign(surplus)  # how far each was moved towards the surplus
    rank = np.argsort(np.argsort(-moved, axis=2, kind="stable"), axis=2, kind="stable")
    zero_sum: Array = rounded - np.sign(surplus) * (rank < np.abs(surplus))
    return zero_sum


def frames(window: int) -> Stage:
    """The frames themselves, as if they were responses."""
    return Stage(1, 1, window, 1, 1)


def known_steps(stage: Stage, window: int, prefixes: bool) -> list[int]:
    """How many responses of a stage are known by the end of each tenth, or of the window."""
    if not prefixes:
        return [stage.steps]
    ends = [window * (d + 1) // TENTHS for d in range(TENTHS)]
    return [max((end - stage.reach) // stage.hop + 1, 0) for end in ends]


def sums(
    g: GraphBuilder,
    x: str,
    steps: int,
    counts: ArrayLike,
    integers: bool = False,
    rowwise: bool = False,
    time_last: bool = False,
) -> str:
    """[1, steps, C] -> sums over the first `counts` of them, of integers or floats: [1, number of
    counts, C].

    rowwise: [m, steps, C], `counts` of m rows -> [m, counts in a row, C]. time_last: of [..., C,
    steps]. The matrix of ones and zeros is computed from a few numbers when the box loads the
    graph; as a constant it would be large.
    """
    at = g(
        "Reshape",
        g("Range", *(g.constant(n, "int32") for n in (0, steps, 1))),
        g.constant([1, steps], "int64"),
    )
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
    """What makes means of sums over `counts`, in the shape that `_sums` gives."""
    factors = np.array(
        [step / max(n, 1) for n in counts]
    )  # where nothing is known the sum is 0 as well
    lead = (len(counts), 1) if rowwise else (1, len(counts))
    factors = factors.reshape(*lead, 1) if len(counts) > 1 else factors[0]
    return g("Expand", g.constant(factors), g.constant([*lead, size], "int64"))


def side_by_side(g: GraphBuilder, parts: Sequence[str]) -> str:
    """Values [n, m, C], their C one after another."""
    return g("Concat", *parts, axis=2) if len(parts) > 1 else parts[0]
