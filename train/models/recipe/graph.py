"""The graphs of the compact network. In: its weights and, for int8, ranges. Out: the model `sweep`
-> its features.

Float and int8 have the same nodes. In int8 everything is an integer up to the mean responses: the
first convolution takes bytes as they come from the sensor, for its integer taps sum to zero and no
offset matters, and the means are integer sums. So all machines give the same bits there. The filter
bank is in int8 only where counts are bytes: wider counts lose too much in one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper

from appliance.core.types import SweepFormat
from train.models.recipe import bank, distribution, spectrum
from train.models.recipe.architectures import FLOOR, NOISE_LIMIT, PREFIXES, Architecture, each_frame
from train.onnx_tools import graph_builder
from train.onnx_tools.graph_builder import FLOAT, MIDDLE, GraphBuilder
from train.onnx_tools.quantize import PERCENTILE

Array = NDArray[Any]


@dataclass(frozen=True)
class Prepared:
    """Taxels as the first convolution takes them. x: their values [n, R * C, T] in units of `step`.
    rounded: the bytes [n, T, R * C] that these come from, "" where they were not rounded; zero: the
    byte that stands for 0."""

    x: str
    step: float
    rounded: str = ""
    zero: int = 0


@dataclass(frozen=True)
class Ranges:
    """The ranges of int8. counts: of a raw count on either side of its level; raw counts that are
    bytes do not need it. responses: of each stage, in the scaled units of the network."""

    counts: float
    responses: tuple[float, ...]


def level_frames(window: int, architecture: Architecture) -> int:
    """Over how many frames the level of raw counts that are not bytes is averaged: the first tenth,
    or the whole window.

    Kernels that sum to zero need no level, but int8 does. The first tenth is known by the time of
    every early answer.
    """
    return max(window // PREFIXES, 1) if architecture.zero_sum(window) else window


def trunk_graph(
    format: SweepFormat,
    scale: float,
    weights: Mapping[str, Array],
    architecture: Architecture,
    ranges: Ranges | None = None,
    prefixes: bool = False,
    keep_means: bool = False,
) -> onnx.ModelProto:
    """A fused Compact up to its features: `sweep` -> `features` float32 [1, F]; in int8 where
    `ranges` are given.

    tenths: `tenths` float32 [1, PREFIXES, F] instead, features of the first tenth, the first two
    tenths and so on. Row d depends on no frame after (d + 1) / PREFIXES of the window, as long as
    later frames repeat the newest one (frames that have not come yet have no noise) or no taxel is
    attenuated. A stage that has no response by then counts as silent. The bands of the spectrum are
    the last features, in float.
    """
    g, parts = GraphBuilder(), []
    raw = g("Reshape", "sweep", g.constant([1, format.window, format.channels], "int64"))
    attenuation = _attenuation(g, raw, format)
    own = (
        ranges if format.dtype == "uint8" else None
    )  # a byte does not hold wider counts, see decision 11
    prepared = cache(
        lambda some: _prepared(g, format, scale, architecture, raw, attenuation, some, prefixes)
    )
    if architecture.channels:
        parts.append(
            _log_means(g, format, architecture, weights, prepared(ranges), ranges, prefixes)
        )
    if architecture.pools:
        rowwise = prefixes and not architecture.zero_sum(format.window)
        asked = bank.Pooling(own is not None, architecture.pools > 1, prefixes, rowwise)
        parts += bank.pooled(
            g, format, bank.Bank.of(weights), prepared(own).x, prepared(own).step, asked
        )
    if architecture.distribution:
        taxels = prepared(own)
        # whole numbers, whose sums are exact in floats: all machines find the same frames above a
        # level
        x = (
            graph_builder.channels_first(g, taxels.rounded, 1.0, taxels.zero)
            if taxels.rounded
            else taxels.x
        )
        some = distribution.Levels.of(weights)
        parts.append(
            distribution.pooled(g, format, some, x, taxels.step, own is not None, prefixes)
        )
    if keep_means:
        counts = each_frame(format.window).known_steps(format.window, prefixes)
        parts.append(
            g("Mul", _levels(g, g("Cast", raw, to=FLOAT), format, counts), g.constant(scale))
        )
    if architecture.spectrum:
        parts.append(
            spectrum.nodes(g, raw, attenuation, format, scale, architecture.mains_hz, prefixes)
        )
    size = max(part.stop for part in layout(format, weights, architecture, keep_means).values())
    features = graph_builder.side_by_side(g, parts)
    shape = [1, PREFIXES, size] if prefixes else [1, size]
    output = g(
        "Reshape", features, g.constant(shape, "int64"), output="tenths" if prefixes else "features"
    )
    return g.model(format, output, *shape[1:])


def layout(
    format: SweepFormat,
    weights: Mapping[str, Array],
    architecture: Architecture,
    keep_means: bool = False,
) -> dict[str, slice]:
    """Where the features of each part of a trunk are: `stages`, `sizes` and `shares` of the bank,
    `levels` of the distribution, `means`, `bands`."""
    filters = len(weights["bank.unit"]) if architecture.pools else 0
    counts = {
        "stages": sum(architecture.channels),
        "sizes": filters,
        "shares": filters * (architecture.pools > 1),
        "levels": len(distribution.Levels.of(weights)) if architecture.distribution else 0,
        "means": keep_means * format.channels,
        "bands": architecture.spectrum * spectrum.count(format),
    }
    ends = np.cumsum(list(counts.values())).tolist()
    return {
        name: slice(end - n, end) for (name, n), end in zip(counts.items(), ends, strict=True) if n
    }


def _log_means(
    g: GraphBuilder,
    format: SweepFormat,
    architecture: Architecture,
    weights: Mapping[str, Array],
    taxels: Prepared,
    ranges: Ranges | None,
    prefixes: bool,
) -> str:
    """The stages: log mean responses [1, 1 or PREFIXES, sum of channels]."""
    zero_sum, sums, factors = architecture.zero_sum(format.window), [], []
    rowwise, x, step = prefixes and not zero_sum, taxels.x, taxels.step
    stages, channels = architecture.stages(format.window), architecture.channels
    for i, (stage, size) in enumerate(zip(stages, channels, strict=True)):
        w, b = weights[f"convs.{i}.weight"], weights[f"convs.{i}.bias"]
        if ranges is None:
            x = response = g(
                "Relu", g("Conv", x, g.constant(w * step), g.constant(b), strides=[stage.stride])
            )
            step = 1.0
        else:
            y = g(
                "Conv",
                x,
                *graph_builder.int8_weights(g, w, b, step, zero_sum and not i),
                strides=[stage.stride],
            )
            step = ranges.responses[i] / 255
            response = graph_builder.quantized(g, y, step)
            if (
                i < len(channels) - 1
            ):  # after the last stage nothing would use it, and onnxruntime would still run it
                x = graph_builder.counts_of(g, response, step)
        counts = stage.known_steps(format.window, prefixes)
        over_time = g("Transpose", response, perm=[0, 2, 1])
        sums.append(
            graph_builder.sums(g, over_time, stage.steps, counts, ranges is not None, rowwise)
        )
        factors.append(graph_builder.mean_factors(g, step, counts, size, rowwise))
    total = graph_builder.side_by_side(g, sums)
    total = g("Cast", total, to=FLOAT) if ranges else total
    log = g(
        "Log", g("Add", g("Mul", total, graph_builder.side_by_side(g, factors)), g.constant(FLOOR))
    )
    return g("Reshape", log, g.constant([1, PREFIXES, sum(channels)], "int64")) if rowwise else log


def _prepared(
    g: GraphBuilder,
    format: SweepFormat,
    scale: float,
    architecture: Architecture,
    raw: str,
    attenuation: str,
    ranges: Ranges | None,
    prefixes: bool,
) -> Prepared:
    """Raw counts [1, T, R * C] -> taxels in units of what is left to the first convolution's
    weights.

    Bytes stay bytes where the kernels sum to zero. From other counts the level is subtracted; where
    that is the mean of the whole window, and tenths are wanted, each tenth has a level and a row of
    its own: [PREFIXES, R * C, T].
    """
    zero_sum = architecture.zero_sum(format.window)
    if format.dtype == "uint8" and zero_sum and ranges:
        return _rounded(g, _attenuated_bytes(g, raw, attenuation, format, scale), scale, 0)
    x = g("Cast", raw, to=FLOAT)
    if format.dtype == "uint8" and zero_sum:
        return Prepared(g("Transpose", g("Mul", x, attenuation), perm=[0, 2, 1]), scale)
    rowwise = prefixes and not zero_sum
    frames = [level_frames(format.window, architecture)]
    counts = each_frame(format.window).known_steps(format.window, prefixes) if rowwise else frames
    x = g("Sub", x, _levels(g, x, format, counts, rowwise))
    x = g("Mul", x, g("Mul", attenuation, g.constant(scale)))
    if ranges is None:
        return Prepared(g("Transpose", x, perm=[0, 2, 1]), 1.0)
    step = ranges.counts * scale / (MIDDLE - 1)
    return _rounded(g, graph_builder.quantized(g, x, step, MIDDLE), step, MIDDLE)


def _rounded(g: GraphBuilder, rounded: str, step: float, zero: int) -> Prepared:
    return Prepared(graph_builder.channels_first(g, rounded, step, zero), step, rounded, zero)


def _attenuation(g: GraphBuilder, raw: str, format: SweepFormat) -> str:
    """Raw counts [1, T, R * C] -> the factor of each taxel [1, 1, R * C]; see
    architectures.NoiseLimit."""
    step, ranked = NOISE_LIMIT.step(format.window), NOISE_LIMIT.rank(format.channels) + 1
    older, newer = (
        g(
            "Cast",
            g(
                "Slice",
                raw,
                *(g.constant([n], "int64") for n in (at, format.window - 1 + at, 1, step)),
            ),
            to=FLOAT,
        )
        for at in (0, 1)
    )
    noise = g("ReduceMean", g("Abs", g("Sub", newer, older)), axes=[1])
    g.nodes.append(
        helper.make_node(
            "TopK", [noise, g.constant([ranked], "int64")], ["strongest", "who"], axis=2
        )
    )
    limit = g("Mul", g("ReduceMin", "strongest", axes=[2]), g.constant(NOISE_LIMIT.times))
    limit = g(
        "Where", g("Greater", limit, g.constant(0)), limit, g.constant(np.finfo(np.float32).max)
    )
    return g("Div", limit, g("Max", noise, limit))


def _attenuated_bytes(
    g: GraphBuilder, raw: str, attenuation: str, format: SweepFormat, scale: float
) -> str:
    """Bytes [1, T, R * C] times `attenuation` [1, 1, R * C], as bytes; exact where that is 1."""
    quantized = graph_builder.quantized(g, attenuation, 1 / 255)
    expanded = g("Expand", quantized, g.constant([1, format.window, format.channels], "int64"))
    product = g(
        "Mul", graph_builder.counts_of(g, raw, scale), graph_builder.counts_of(g, expanded, 1 / 255)
    )
    return graph_builder.quantized(g, product, scale)


def _levels(
    g: GraphBuilder, x: str, format: SweepFormat, counts: list[int], rowwise: bool = False
) -> str:
    """Raw counts [1, T, R * C] -> means over the first `counts` frames, [1, len(counts), R * C] or,
    rowwise, with a row each."""
    taxels = format.channels
    sums = graph_builder.sums(g, x, format.window, counts, rowwise=rowwise)
    return g("Mul", sums, graph_builder.mean_factors(g, 1.0, counts, taxels, rowwise))


def bank_responses(
    format: SweepFormat, scale: float, architecture: Architecture, filters: bank.Bank
) -> Iterator[tuple[Array, onnx.ModelProto]]:
    """For each of bank.groups the numbers of its filters and the float model that gives their
    responses, float32 [1, steps, filters]."""
    for numbers, _ in bank.groups(filters):
        g = GraphBuilder()
        raw = g("Reshape", "sweep", g.constant([1, format.window, format.channels], "int64"))
        taxels = _prepared(
            g, format, scale, architecture, raw, _attenuation(g, raw, format), None, False
        )
        y, (stage,) = bank.responses(g, format, filters.take(numbers), taxels.x, taxels.step, False)
        g("Identity", y, output="responses")
        yield numbers, g.model(format, "responses", stage.steps, len(numbers))


def count_range(samples: Array, architecture: Architecture) -> float:
    """How far int8 reaches on either side of a count's level, from raw counts [N, T, R, C]; see
    Ranges."""
    frames = level_frames(samples.shape[1], architecture)
    level = samples[:, :frames].mean(axis=1, keepdims=True, dtype=np.float64)
    return max(float(np.percentile(np.abs(samples - level), PERCENTILE)), 1e-6)
