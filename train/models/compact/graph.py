"""The room of the compact network's graphs. In: its weights and, for int8, ranges. Out: `sweep` -> its features.

The same nodes in float and in int8. In int8 everything is whole numbers up to the mean responses: the first
convolution takes bytes as they come from the sensor, for its integer taps sum to zero and no offset can move it, and
the means are integer sums. So all machines give the same bits there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper

from appliance.core.types import SweepFormat
from train.models.compact import spectrum
from train.models.compact.architectures import CAP, FLOOR, Architecture, Stage
from train.onnx_tools.graph_builder import IR, OPSET, TENSOR, GraphBuilder

Array = NDArray[Any]
FLOAT = TensorProto.FLOAT
TENTHS = spectrum.SEGMENTS
"""Into how many parts a window is cut for early decisions."""
SEVEN_BITS = 64
"""Largest integer tap: two products of eight bits overflow the 16-bit sums of an x86 without VNNI, and then the answer
there is another than on Arm."""
MIDDLE = 128
"""The byte that stands for 0 where digits are no bytes themselves."""


@dataclass(frozen=True)
class Ranges:
    """How far int8 reaches. digits: of a digit either side of its level; bytes that are taken as they come do not need
    it. responses: of each stage, in the scaled units of the network."""

    digits: float
    responses: tuple[float, ...]


def level_frames(window: int, shape: Architecture) -> int:
    """Of how many frames the mean is taken away from digits that are no bytes: the first tenth, or the whole window.

    Kernels that sum to zero need no level, but int8 does. The first tenth is known by the time of every early answer.
    """
    return max(window // TENTHS, 1) if shape.zero_sum(window) else window


def trunk(
    form: SweepFormat,
    scale: float,
    weights: Mapping[str, Array],
    shape: Architecture,
    reach: Ranges | None = None,
    tenths: bool = False,
    keep_means: bool = False,
) -> onnx.ModelProto:
    """A fused Compact up to its features: `sweep` -> `features` float32 [1, F]; in int8 where `reach` is given.

    tenths: `tenths` float32 [1, TENTHS, F] instead, features of the first tenth, two tenths ... of the window. Row d
    depends on no frame after (d + 1) / TENTHS of it, as long as later frames repeat the newest one (what has not come
    yet does not tremble) or none is capped. A stage that has seen too little by then counts as silent.
    The bands of the spectrum are the last features, in float.
    """
    g, seen, sizes = GraphBuilder(), [], []
    raw = g("Reshape", "sweep", g.constant([1, form.window, form.rows * form.cols], "int64"))
    turned = _capping(g, raw, form)
    if shape.channels:
        front = _front(g, form, scale, shape, raw, turned, reach, tenths)
        seen.append(_log_means(g, form, shape, weights, *front, reach, tenths))
        sizes.append(sum(shape.channels))
    if keep_means:
        counts = _counts(_frames(form.window), form.window, tenths)
        seen.append(g("Mul", _levels(g, g("Cast", raw, to=FLOAT), form, counts), g.constant(scale)))
        sizes.append(form.rows * form.cols)
    if shape.spectrum:
        seen.append(spectrum.nodes(g, raw, turned, form, scale, tenths))
        sizes.append(spectrum.count(form))
    all_of_them = g("Concat", *seen, axis=2) if len(seen) > 1 else seen[0]
    out = [1, TENTHS, sum(sizes)] if tenths else [1, sum(sizes)]
    return _model(g, form, all_of_them, "tenths" if tenths else "features", out)


def _log_means(
    g: GraphBuilder, form: SweepFormat, shape: Architecture, weights: Mapping[str, Array], x: str, step: float,
    reach: Ranges | None, tenths: bool,
) -> str:  # fmt: skip
    """The stages on [n, R * C, T], which `step` makes the network's unit: [1, 1 or TENTHS, sum of channels]."""
    zero_sum, sums, factors = shape.zero_sum(form.window), [], []
    apart = tenths and not zero_sum
    for i, (stage, size) in enumerate(zip(shape.stages(form.window), shape.channels, strict=True)):
        w, b = weights[f"convs.{i}.weight"], weights[f"convs.{i}.bias"]
        if reach is None:
            x = seen = g("Relu", g("Conv", x, g.constant(w * step), g.constant(b), strides=[stage.stride]))
            step = 1.0
        else:
            y = g("Conv", x, *_bytes(g, w, b, step, zero_sum and not i), strides=[stage.stride])
            step = reach.responses[i] / 255
            seen = _quantized(g, y, step)
            if i < len(shape.channels) - 1:  # onnxruntime would run it for nobody
                x = g("DequantizeLinear", seen, g.constant(step), g.constant(0, "uint8"))
        counts = _counts(stage, form.window, tenths)
        sums.append(_sums(g, g("Transpose", seen, perm=[0, 2, 1]), stage.steps, counts, reach is not None, apart))
        factors.append(_factors(g, step, counts, size, apart))
    total = g("Concat", *sums, axis=2)
    total = g("Cast", total, to=FLOAT) if reach else total
    log = g("Log", g("Add", g("Mul", total, g("Concat", *factors, axis=2)), g.constant(FLOOR)))
    return g("Reshape", log, g.constant([1, TENTHS, sum(shape.channels)], "int64")) if apart else log


def _front(
    g: GraphBuilder,
    form: SweepFormat,
    scale: float,
    shape: Architecture,
    raw: str,
    turned: str,
    reach: Ranges | None,
    tenths: bool,
) -> tuple[str, float]:
    """Digits [1, T, R * C], `turned` down -> ([1, R * C, T], the step that is left to the first convolution's weights).

    Bytes go on as bytes where the kernels sum to zero. Of other digits the level is taken away; where that is the mean
    of all, and tenths are wanted, each of them has a level and a row of its own, [TENTHS, R * C, T].
    """
    zero_sum = shape.zero_sum(form.window)
    if form.dtype == "uint8" and zero_sum and reach:
        return _turned(g, _turned_down(g, raw, turned, form, scale), scale, 0), scale
    x = g("Cast", raw, to=FLOAT)
    if form.dtype == "uint8" and zero_sum:
        return g("Transpose", g("Mul", x, turned), perm=[0, 2, 1]), scale
    apart = tenths and not zero_sum
    counts = _counts(_frames(form.window), form.window, tenths) if apart else [level_frames(form.window, shape)]
    x = g("Sub", x, _levels(g, x, form, counts, apart))
    x = g("Mul", x, g("Mul", turned, g.constant(scale)))
    if reach is None:
        return g("Transpose", x, perm=[0, 2, 1]), 1.0
    step = reach.digits * scale / (MIDDLE - 1)
    return _turned(g, _quantized(g, x, step, MIDDLE), step, MIDDLE), step


def _capping(g: GraphBuilder, raw: str, form: SweepFormat) -> str:
    """Digits [1, T, R * C] -> what each taxel is multiplied with, [1, 1, R * C]; see ladder.Cap."""
    step, most = CAP.step(form.window), CAP.place(form.rows * form.cols) + 1
    older, newer = (
        g("Cast", g("Slice", raw, *(g.constant([n], "int64") for n in (at, form.window - 1 + at, 1, step))), to=FLOAT)
        for at in (0, 1)
    )
    trembling = g("ReduceMean", g("Abs", g("Sub", newer, older)), axes=[1])
    g.nodes.append(helper.make_node("TopK", [trembling, g.constant([most], "int64")], ["strongest", "who"], axis=2))
    limit = g("Mul", g("ReduceMin", "strongest", axes=[2]), g.constant(CAP.times))
    limit = g("Where", g("Greater", limit, g.constant(0)), limit, g.constant(np.finfo(np.float32).max))
    return g("Div", limit, g("Max", trembling, limit))


def _turned_down(g: GraphBuilder, raw: str, turned: str, form: SweepFormat, scale: float) -> str:
    """Bytes [1, T, R * C] times `turned` [1, 1, R * C], as bytes; exact where that is 1."""
    whole = g("Expand", _quantized(g, turned, 1 / 255), g.constant([1, form.window, form.rows * form.cols], "int64"))
    factors = g("DequantizeLinear", whole, g.constant(1 / 255), g.constant(0, "uint8"))
    digits = g("DequantizeLinear", raw, g.constant(scale), g.constant(0, "uint8"))
    return _quantized(g, g("Mul", digits, factors), scale)


def _quantized(g: GraphBuilder, x: str, step: float, zero: int = 0) -> str:
    return g("QuantizeLinear", x, g.constant(step), g.constant(zero, "uint8"))


def _turned(g: GraphBuilder, x: str, step: float, zero: int) -> str:
    """Bytes [n, T, R * C] as what they mean [n, R * C, T]."""
    return g("DequantizeLinear", g("Transpose", x, perm=[0, 2, 1]), g.constant(step), g.constant(zero, "uint8"))


def _bytes(g: GraphBuilder, weight: Array, bias: Array, step: float, zero_sum: bool) -> tuple[str, str]:
    """Weight [filters, inputs, kernel] in seven bits, a step for each filter; bias in 32 bits of both steps."""
    least = np.abs(bias) / (step * 2**30)  # a silent filter's bias must fit as well
    steps = np.maximum(np.maximum(np.abs(weight).max(axis=(1, 2)) / SEVEN_BITS, least), 1e-12).astype(np.float32)
    taps = (zero_sum_taps if zero_sum else np.rint)(weight / steps[:, None, None].astype(np.float64))
    zeros = np.zeros(len(weight))
    in_both = steps.astype(np.float64) * step
    return (
        g("DequantizeLinear", g.constant(taps, "int8"), g.constant(steps), g.constant(zeros, "int8"), axis=0),
        g("DequantizeLinear", g.constant(np.rint(bias / in_both), "int32"), g.constant(in_both),
          g.constant(zeros, "int32"), axis=0),
    )  # fmt: skip


def zero_sum_taps(taps: Array) -> Array:
    """Taps [filters, taxels, kernel] rounded so that each kernel sums to zero, as theirs does before.

    The sum of the roundings is what is over; as many taps, those nearest to the other rounding, take that one instead.
    None leaves the range of all: a tap at its end is whole and was not rounded, and of the others there are enough.
    """
    taps = taps - taps.mean(axis=2, keepdims=True)
    rounded = np.rint(taps)
    over = rounded.sum(axis=2, keepdims=True)
    far = (rounded - taps) * np.sign(over)  # how far each was moved towards the surplus
    rank = np.argsort(np.argsort(-far, axis=2, kind="stable"), axis=2, kind="stable")
    return rounded - np.sign(over) * (rank < np.abs(over))


def _frames(window: int) -> Stage:
    """The frames themselves, as if they were responses."""
    return Stage(1, 1, window, 1, 1)


def _counts(stage: Stage, window: int, tenths: bool) -> list[int]:
    """How many responses of a stage are known by the end of each tenth, or of the window."""
    if not tenths:
        return [stage.steps]
    ends = [window * (d + 1) // TENTHS for d in range(TENTHS)]
    return [max((end - stage.reach) // stage.hop + 1, 0) for end in ends]


def _sums(g: GraphBuilder, x: str, steps: int, counts: list[int], whole: bool = False, apart: bool = False) -> str:
    """[1, steps, C] -> sums over the first `counts` of them, of whole numbers or not, [1, len(counts), C].

    apart: [len(counts), steps, C] -> [len(counts), 1, C], each over a row of its own.
    The matrix of ones and zeros is made of two numbers when the box loads the graph; as a constant it would be large.
    """
    places = g("Reshape", g("Range", *(g.constant(n, "int32") for n in (0, steps, 1))), g.constant([1, steps], "int64"))
    known = g("Less", places, g.constant(np.array(counts)[:, None], "int32"))
    if apart:
        known = g("Reshape", known, g.constant([len(counts), 1, steps], "int64"))
    ones = g("Cast", known, to=TensorProto.UINT8 if whole else FLOAT)
    return g("MatMulInteger" if whole else "MatMul", ones, x)


def _factors(g: GraphBuilder, step: float, counts: list[int], size: int, apart: bool = False) -> str:
    """What makes sums over `counts` their means, as `_sums` gives them."""
    each = np.array([step / max(n, 1) for n in counts])  # nothing known: its sum is 0 as well
    lead = (len(counts), 1) if apart else (1, len(counts))
    each = each.reshape(*lead, 1) if len(counts) > 1 else each[0]
    return g("Expand", g.constant(each), g.constant([*lead, size], "int64"))


def _levels(g: GraphBuilder, x: str, form: SweepFormat, counts: list[int], apart: bool = False) -> str:
    """Digits [1, T, R * C] -> means over the first `counts` frames, [1, len(counts), R * C] or apart."""
    taxels = form.rows * form.cols
    return g("Mul", _sums(g, x, form.window, counts, apart=apart), _factors(g, 1.0, counts, taxels, apart))


def _model(g: GraphBuilder, form: SweepFormat, x: str, output: str, size: list[int]) -> onnx.ModelProto:
    """The finished, checked model: `sweep` -> `output` float32 of `size`."""
    g("Reshape", x, g.constant(size, "int64"), output=output)
    sweep = helper.make_tensor_value_info("sweep", TENSOR[form.dtype], [1, form.window, form.rows, form.cols])
    out = helper.make_tensor_value_info(output, FLOAT, size)
    graph = helper.make_graph(g.nodes, "palpate", [sweep], [out], g.constants)
    made = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR, producer_name="palpate"
    )
    onnx.checker.check_model(made, full_check=True)
    return made
