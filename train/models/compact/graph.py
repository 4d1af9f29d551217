"""The graphs of the compact network. In: its weights and, for int8, ranges. Out: the model `sweep` -> its features.

Float and int8 have the same nodes. In int8 everything is an integer up to the mean responses: the first convolution takes
bytes as they come from the sensor, for its integer taps sum to zero and no offset matters, and the means are integer
sums. So all machines give the same bits there.
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
from train.models.compact.architectures import FLOOR, NOISE_LIMIT, Architecture, Stage
from train.onnx_tools.graph_builder import GraphBuilder

Array = NDArray[Any]
FLOAT = TensorProto.FLOAT
TENTHS = spectrum.SEGMENTS
"""Into how many parts a window is cut for early decisions."""
MAX_TAP = 64
"""Largest integer tap, seven bits: two products of eight bits overflow the 16-bit sums of an x86 without VNNI, and the
answer there would differ from that on Arm."""
MIDDLE = 128
"""The byte that stands for 0 where raw counts are not bytes themselves."""


@dataclass(frozen=True)
class Ranges:
    """The ranges of int8. digits: of a raw count on either side of its level; raw counts that are bytes do not need it.
    responses: of each stage, in the scaled units of the network."""

    digits: float
    responses: tuple[float, ...]


def level_frames(window: int, architecture: Architecture) -> int:
    """Over how many frames the level of raw counts that are not bytes is averaged: the first tenth, or the whole window.

    Kernels that sum to zero need no level, but int8 does. The first tenth is known by the time of every early answer.
    """
    return max(window // TENTHS, 1) if architecture.zero_sum(window) else window


def trunk_graph(
    form: SweepFormat,
    scale: float,
    weights: Mapping[str, Array],
    architecture: Architecture,
    ranges: Ranges | None = None,
    tenths: bool = False,
    keep_means: bool = False,
) -> onnx.ModelProto:
    """A fused Compact up to its features: `sweep` -> `features` float32 [1, F]; in int8 where `ranges` are given.

    tenths: `tenths` float32 [1, TENTHS, F] instead, features of the first tenth, the first two tenths and so on. Row d
    depends on no frame after (d + 1) / TENTHS of the window, as long as later frames repeat the newest one (frames that
    have not come yet have no noise) or no taxel is attenuated. A stage that has no response by then counts as silent.
    The bands of the spectrum are the last features, in float.
    """
    g, parts, sizes = GraphBuilder(), [], []
    raw = g("Reshape", "sweep", g.constant([1, form.window, form.rows * form.cols], "int64"))
    attenuation = _attenuation(g, raw, form)
    if architecture.channels:
        x, step = _prepared(g, form, scale, architecture, raw, attenuation, ranges, tenths)
        parts.append(_log_means(g, form, architecture, weights, x, step, ranges, tenths))
        sizes.append(sum(architecture.channels))
    if keep_means:
        counts = _known_steps(_frames(form.window), form.window, tenths)
        parts.append(g("Mul", _levels(g, g("Cast", raw, to=FLOAT), form, counts), g.constant(scale)))
        sizes.append(form.rows * form.cols)
    if architecture.spectrum:
        parts.append(spectrum.nodes(g, raw, attenuation, form, scale, tenths))
        sizes.append(spectrum.count(form))
    features = g("Concat", *parts, axis=2) if len(parts) > 1 else parts[0]
    shape = [1, TENTHS, sum(sizes)] if tenths else [1, sum(sizes)]
    output = g("Reshape", features, g.constant(shape, "int64"), output="tenths" if tenths else "features")
    return g.model(form, output, *shape[1:])


def _log_means(
    g: GraphBuilder, form: SweepFormat, architecture: Architecture, weights: Mapping[str, Array], x: str, step: float,
    ranges: Ranges | None, tenths: bool,
) -> str:  # fmt: skip
    """The stages on [n, R * C, T], in units of `step`: log mean responses [1, 1 or TENTHS, sum of channels]."""
    zero_sum, sums, factors = architecture.zero_sum(form.window), [], []
    rowwise = tenths and not zero_sum
    stages, channels = architecture.stages(form.window), architecture.channels
    for i, (stage, size) in enumerate(zip(stages, channels, strict=True)):
        w, b = weights[f"convs.{i}.weight"], weights[f"convs.{i}.bias"]
        if ranges is None:
            x = response = g("Relu", g("Conv", x, g.constant(w * step), g.constant(b), strides=[stage.stride]))
            step = 1.0
        else:
            y = g("Conv", x, *_int8_weights(g, w, b, step, zero_sum and not i), strides=[stage.stride])
            step = ranges.responses[i] / 255
            response = _quantized(g, y, step)
            if i < len(channels) - 1:  # after the last stage nothing would use it, and onnxruntime would still run it
                x = g("DequantizeLinear", response, g.constant(step), g.constant(0, "uint8"))
        counts = _known_steps(stage, form.window, tenths)
        over_time = g("Transpose", response, perm=[0, 2, 1])
        sums.append(_sums(g, over_time, stage.steps, counts, ranges is not None, rowwise))
        factors.append(_mean_factors(g, step, counts, size, rowwise))
    total = g("Concat", *sums, axis=2)
    total = g("Cast", total, to=FLOAT) if ranges else total
    log = g("Log", g("Add", g("Mul", total, g("Concat", *factors, axis=2)), g.constant(FLOOR)))
    return g("Reshape", log, g.constant([1, TENTHS, sum(channels)], "int64")) if rowwise else log


def _prepared(
    g: GraphBuilder,
    form: SweepFormat,
    scale: float,
    architecture: Architecture,
    raw: str,
    attenuation: str,
    ranges: Ranges | None,
    tenths: bool,
) -> tuple[str, float]:
    """Raw counts [1, T, R * C] -> ([1, R * C, T], the factor that is left to the first convolution's weights).

    Bytes stay bytes where the kernels sum to zero. From other counts the level is subtracted; where that is the mean of
    the whole window, and tenths are wanted, each tenth has a level and a row of its own: [TENTHS, R * C, T].
    """
    zero_sum = architecture.zero_sum(form.window)
    if form.dtype == "uint8" and zero_sum and ranges:
        return _channels_first(g, _attenuated_bytes(g, raw, attenuation, form, scale), scale, 0), scale
    x = g("Cast", raw, to=FLOAT)
    if form.dtype == "uint8" and zero_sum:
        return g("Transpose", g("Mul", x, attenuation), perm=[0, 2, 1]), scale
    rowwise = tenths and not zero_sum
    frames = [level_frames(form.window, architecture)]
    counts = _known_steps(_frames(form.window), form.window, tenths) if rowwise else frames
    x = g("Sub", x, _levels(g, x, form, counts, rowwise))
    x = g("Mul", x, g("Mul", attenuation, g.constant(scale)))
    if ranges is None:
        return g("Transpose", x, perm=[0, 2, 1]), 1.0
    step = ranges.digits * scale / (MIDDLE - 1)
    return _channels_first(g, _quantized(g, x, step, MIDDLE), step, MIDDLE), step


def _attenuation(g: GraphBuilder, raw: str, form: SweepFormat) -> str:
    """Raw counts [1, T, R * C] -> the factor of each taxel [1, 1, R * C]; see architectures.NoiseLimit."""
    step, ranked = NOISE_LIMIT.step(form.window), NOISE_LIMIT.rank(form.rows * form.cols) + 1
    older, newer = (
        g("Cast", g("Slice", raw, *(g.constant([n], "int64") for n in (at, form.window - 1 + at, 1, step))), to=FLOAT)
        for at in (0, 1)
    )
    noise = g("ReduceMean", g("Abs", g("Sub", newer, older)), axes=[1])
    g.nodes.append(helper.make_node("TopK", [noise, g.constant([ranked], "int64")], ["strongest", "who"], axis=2))
    limit = g("Mul", g("ReduceMin", "strongest", axes=[2]), g.constant(NOISE_LIMIT.times))
    limit = g("Where", g("Greater", limit, g.constant(0)), limit, g.constant(np.finfo(np.float32).max))
    return g("Div", limit, g("Max", noise, limit))


def _attenuated_bytes(g: GraphBuilder, raw: str, attenuation: str, form: SweepFormat, scale: float) -> str:
    """Bytes [1, T, R * C] times `attenuation` [1, 1, R * C], as bytes; exact where that is 1."""
    quantized = _quantized(g, attenuation, 1 / 255)
    expanded = g("Expand", quantized, g.constant([1, form.window, form.rows * form.cols], "int64"))
    factors = g("DequantizeLinear", expanded, g.constant(1 / 255), g.constant(0, "uint8"))
    counts = g("DequantizeLinear", raw, g.constant(scale), g.constant(0, "uint8"))
    return _quantized(g, g("Mul", counts, factors), scale)


def _quantized(g: GraphBuilder, x: str, step: float, zero: int = 0) -> str:
    """`x` as bytes, in units of `step`."""
    return g("QuantizeLinear", x, g.constant(step), g.constant(zero, "uint8"))


def _channels_first(g: GraphBuilder, x: str, step: float, zero: int) -> str:
    """Bytes [n, T, R * C] -> the values they stand for [n, R * C, T]."""
    return g("DequantizeLinear", g("Transpose", x, perm=[0, 2, 1]), g.constant(step), g.constant(zero, "uint8"))


def _int8_weights(g: GraphBuilder, weight: Array, bias: Array, step: float, zero_sum: bool) -> tuple[str, str]:
    """Weight [filters, inputs, kernel] in seven bits, a step for each filter; bias in 32 bits, in the product of both
    steps."""
    least = np.abs(bias) / (step * 2**30)  # a silent filter's bias must fit as well
    steps = np.maximum(np.maximum(np.abs(weight).max(axis=(1, 2)) / MAX_TAP, least), 1e-12).astype(np.float32)
    taps = (zero_sum_taps if zero_sum else np.rint)(weight / steps[:, None, None].astype(np.float64))
    zeros = np.zeros(len(weight))
    product = steps.astype(np.float64) * step
    return (
        g("DequantizeLinear", g.constant(taps, "int8"), g.constant(steps), g.constant(zeros, "int8"), axis=0),
        g("DequantizeLinear", g.constant(np.rint(bias / product), "int32"), g.constant(product),
          g.constant(zeros, "int32"), axis=0),
    )  # fmt: skip


def zero_sum_taps(taps: Array) -> Array:
    """Taps [filters, taxels, kernel] rounded so that each kernel sums to zero, as it did before rounding.

    The sum after rounding is the surplus. As many taps, those nearest to being rounded the other way, are rounded that
    way instead. None leaves the range: a tap at its end is whole and was not rounded, and there are enough others.
    """
    taps = taps - taps.mean(axis=2, keepdims=True)
    rounded = np.rint(taps)
    surplus = rounded.sum(axis=2, keepdims=True)
    moved = (rounded - taps) * np.sign(surplus)  # how far each was moved towards the surplus
    rank = np.argsort(np.argsort(-moved, axis=2, kind="stable"), axis=2, kind="stable")
    zero_sum: Array = rounded - np.sign(surplus) * (rank < np.abs(surplus))
    return zero_sum


def _frames(window: int) -> Stage:
    """The frames themselves, as if they were responses."""
    return Stage(1, 1, window, 1, 1)


def _known_steps(stage: Stage, window: int, tenths: bool) -> list[int]:
    """How many responses of a stage are known by the end of each tenth, or of the window."""
    if not tenths:
        return [stage.steps]
    ends = [window * (d + 1) // TENTHS for d in range(TENTHS)]
    return [max((end - stage.reach) // stage.hop + 1, 0) for end in ends]


def _sums(g: GraphBuilder, x: str, steps: int, counts: list[int], integers: bool = False, rowwise: bool = False) -> str:
    """[1, steps, C] -> sums over the first `counts` of them, of integers or floats: [1, len(counts), C].

    rowwise: [len(counts), steps, C] -> [len(counts), 1, C], each over a row of its own. The matrix of ones and zeros is
    computed from two numbers when the box loads the graph; as a constant it would be large.
    """
    at = g("Reshape", g("Range", *(g.constant(n, "int32") for n in (0, steps, 1))), g.constant([1, steps], "int64"))
    known = g("Less", at, g.constant(np.array(counts)[:, None], "int32"))
    if rowwise:
        known = g("Reshape", known, g.constant([len(counts), 1, steps], "int64"))
    ones = g("Cast", known, to=TensorProto.UINT8 if integers else FLOAT)
    return g("MatMulInteger" if integers else "MatMul", ones, x)


def _mean_factors(g: GraphBuilder, step: float, counts: list[int], size: int, rowwise: bool = False) -> str:
    """What makes means of sums over `counts`, in the shape that `_sums` gives."""
    factors = np.array([step / max(n, 1) for n in counts])  # where nothing is known the sum is 0 as well
    lead = (len(counts), 1) if rowwise else (1, len(counts))
    factors = factors.reshape(*lead, 1) if len(counts) > 1 else factors[0]
    return g("Expand", g.constant(factors), g.constant([*lead, size], "int64"))


def _levels(g: GraphBuilder, x: str, form: SweepFormat, counts: list[int], rowwise: bool = False) -> str:
    """Raw counts [1, T, R * C] -> means over the first `counts` frames, [1, len(counts), R * C] or, rowwise, with a row
    each."""
    taxels = form.rows * form.cols
    sums = _sums(g, x, form.window, counts, rowwise=rowwise)
    return g("Mul", sums, _mean_factors(g, 1.0, counts, taxels, rowwise))
