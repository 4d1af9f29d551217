"""The graphs of a trunk: `sweep` -> its features, in float and in int8.

Both have the same nodes. In int8 everything is an integer up to the mean responses: the first
convolution takes bytes as they come from the sensor, because its integer taps sum to zero and no
offset matters, and the means are integer sums. Therefore all machines compute the same bits up to
there. The filter bank is in int8 only if counts are bytes: wider counts lose too much in a byte.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper

from palpate.core.types import SweepFormat
from palpate_train.models.recipe import bank, distribution, loads, relations, slow, spectrum
from palpate_train.models.recipe.architectures import (
    FLOOR,
    NOISE_LIMIT,
    PREFIXES,
    Architecture,
    each_frame,
)
from palpate_train.onnx_tools import graph_builder
from palpate_train.onnx_tools.graph_builder import FLOAT, MIDDLE, GraphBuilder
from palpate_train.onnx_tools.quantize import PERCENTILE

Array = NDArray[Any]


@dataclass(frozen=True)
class Prepared:
    """Taxels as input of the first convolution.

    x: their values [n, R * C, T] in units of `step`. rounded: the bytes [n, T, R * C] that `x` was
    made of, "" if there are none; zero: the byte that stands for 0.
    """

    x: str
    step: float
    rounded: str = ""
    zero: int = 0


@dataclass(frozen=True)
class Ranges:
    """The ranges of int8. counts: of a raw count on either side of its level, which raw counts that
    are bytes do not need. responses: of each stage, in units of scaled counts."""

    counts: float
    responses: tuple[float, ...]


def level_frames(window: int, architecture: Architecture) -> int:
    """Number of frames over which the level of wide raw counts is averaged: the first tenth if
    kernels sum to zero, else the whole window.

    Kernels that sum to zero need no level, but int8 does. The first tenth is known before every
    early answer.
    """
    return max(window // PREFIXES, 1) if architecture.zero_sum(window) else window


def trunk_graph(
    format: SweepFormat,
    scale: float,
    weights: Mapping[str, Array],
    architecture: Architecture,
    ranges: Ranges | None = None,
    prefixes: bool = False,
) -> onnx.ModelProto:
    """`sweep` -> `features` float32 [1, F], part by part as in `layout`; in int8 if there are
    `ranges`, except the spectrum, loads and relations. weights: of a Fit.

    prefixes: `tenths` float32 [1, PREFIXES, F] instead, the features of each prefix of the window.
    Row d depends on no frame after (d + 1) / PREFIXES of the window, as long as later frames repeat
    the newest one (frames that have not come yet have no noise) or no taxel is attenuated. A stage
    that has no response by then counts as silent.
    """
    nodes = _TrunkNodes(format, scale, architecture, ranges, prefixes)
    parts = nodes.stages(weights) if architecture.channels else []
    parts += nodes.bank(weights) if architecture.pools else []
    parts += nodes.distribution(weights) if architecture.distribution else []
    parts += nodes.loads() if architecture.loads else []
    parts += nodes.relations() if architecture.relations else []
    parts += nodes.slow() if architecture.slow else []
    parts += nodes.spectrum() if architecture.spectrum else []
    size = max(part.stop for part in layout(format, weights, architecture).values())
    g = nodes.g
    features = graph_builder.side_by_side(g, parts)
    shape = [1, PREFIXES, size] if prefixes else [1, size]
    name = "tenths" if prefixes else "features"
    output = g("Reshape", features, shape, output=name)
    return g.model(format, output, *shape[1:])


def layout(
    format: SweepFormat, weights: Mapping[str, Array], architecture: Architecture
) -> dict[str, slice]:
    """The features of each part of a trunk, by name: `stages`, `magnitudes` and `shares` of the
    bank, `levels` of the distribution, `loads`, `relations`, `slow`, `bands`."""
    filters = len(weights["bank.unit"]) if architecture.pools else 0
    counts = {
        "stages": sum(architecture.channels),
        **{pool: filters * (pool in architecture.pools) for pool in bank.POOLS},
        "levels": len(distribution.Levels.of(weights)) if architecture.distribution else 0,
        "loads": architecture.loads * loads.count(format),
        "relations": architecture.relations * relations.each(format),
        "slow": architecture.slow * slow.count(format),
        "bands": architecture.spectrum * spectrum.count(format),
    }
    ends = np.cumsum(list(counts.values())).tolist()
    return {
        name: slice(end - n, end) for (name, n), end in zip(counts.items(), ends, strict=True) if n
    }


class _TrunkNodes:
    """The nodes of a trunk, part by part. raw: counts [1, T, R * C]. attenuation: [1, 1, R * C],
    the factor of each taxel; see architectures.NoiseLimit."""

    def __init__(
        self,
        format: SweepFormat,
        scale: float,
        architecture: Architecture,
        ranges: Ranges | None = None,
        prefixes: bool = False,
    ) -> None:
        self.g, self._format, self._scale = GraphBuilder(), format, scale
        self._architecture, self._ranges, self._prefixes = architecture, ranges, prefixes
        self._zero_sum = architecture.zero_sum(format.window)
        self._rowwise = prefixes and not self._zero_sum
        # a byte does not hold wider counts: fixed features of these stay in float (decision 4)
        self._own = ranges if format.dtype == "uint8" else None
        self.raw = self.g("Reshape", "sweep", [1, format.window, format.channels])
        self.attenuation = self._attenuation()
        self._prepared: dict[Ranges | None, Prepared] = {}

    def stages(self, weights: Mapping[str, Array]) -> list[str]:
        """Log mean responses [1, 1 or PREFIXES, sum of channels]."""
        g, window, ranges = self.g, self._format.window, self._ranges
        taxels, sums, factors = self.prepared(ranges), [], []
        x, step = taxels.x, taxels.step
        stages, channels = self._architecture.stages(window), self._architecture.channels
        for i, (stage, size) in enumerate(zip(stages, channels, strict=True)):
            w, b = weights[f"convs.{i}.weight"], weights[f"convs.{i}.bias"]
            if ranges is None:
                taps = g.constant(w * step), g.constant(b)
                x = response = g("Relu", g("Conv", x, *taps, strides=[stage.stride]))
                step = 1.0
            else:
                taps = graph_builder.int8_weights(g, w, b, step, self._zero_sum and not i)
                y = g("Conv", x, *taps, strides=[stage.stride])
                step = ranges.responses[i] / 255
                response = graph_builder.quantized(g, y, step)
                if i < len(channels) - 1:  # else onnxruntime would run a node without a use
                    x = graph_builder.counts_of(g, response, step)
            counts = stage.known_steps(window, self._prefixes)
            x_t = g("Transpose", response, perm=[0, 2, 1])
            whole = ranges is not None
            sums.append(graph_builder.sums(g, x_t, stage.steps, counts, whole, self._rowwise))
            factors.append(graph_builder.mean_factors(g, step, counts, size, self._rowwise))
        total = graph_builder.side_by_side(g, sums)
        total = g("Cast", total, to=FLOAT) if ranges else total
        means = g("Mul", total, graph_builder.side_by_side(g, factors))
        log = g("Log", g("Add", means, g.constant(FLOOR)))
        if not self._rowwise:
            return [log]
        return [g("Reshape", log, [1, PREFIXES, sum(channels)])]

    def bank(self, weights: Mapping[str, Array]) -> list[str]:
        """See bank.pooled."""
        pools, int8 = self._architecture.pools, self._own is not None
        how = bank.Pooling(int8, pools, self._prefixes, self._rowwise)
        taxels = self.prepared(self._own)
        filters = bank.Bank.of(weights)
        return bank.pooled(self.g, self._format, filters, taxels.x, taxels.step, how)

    def distribution(self, weights: Mapping[str, Array]) -> list[str]:
        """See distribution.pooled."""
        g, taxels = self.g, self.prepared(self._own)
        x = taxels.x
        if taxels.rounded:
            # sums of whole numbers are exact in floats, so all machines find the same frames
            # above a level
            x = graph_builder.channels_first(g, taxels.rounded, 1.0, taxels.zero)
        levels, int8 = distribution.Levels.of(weights), self._own is not None
        return [distribution.pooled(g, self._format, levels, x, taxels.step, int8, self._prefixes)]

    def loads(self) -> list[str]:
        """See loads.nodes."""
        counts = self.g("Cast", self.raw, to=FLOAT)
        return [loads.nodes(self.g, counts, self._format, self._scale, self._prefixes)]

    def relations(self) -> list[str]:
        """See relations.nodes."""
        given = self._format, self._scale, self._architecture.relations, self._prefixes
        return [relations.nodes(self.g, self.raw, self.attenuation, *given)]

    def slow(self) -> list[str]:
        """See slow.nodes."""
        given = self._format, self._scale, self._architecture.mains_hz, self._prefixes
        return [slow.nodes(self.g, self.raw, self.attenuation, *given)]

    def spectrum(self) -> list[str]:
        """See spectrum.nodes."""
        given = self._format, self._scale, self._architecture.mains_hz, self._prefixes
        return [spectrum.nodes(self.g, self.raw, self.attenuation, *given)]

    def prepared(self, ranges: Ranges | None) -> Prepared:
        """Taxels in units of `step`, which the weights of the first convolution take up.

        Bytes stay bytes if the kernels sum to zero. From other counts the level is subtracted. If
        that is the mean of the whole window, and prefixes are wanted, each prefix has a level and a
        row of its own: [PREFIXES, R * C, T].
        """
        if ranges not in self._prepared:
            self._prepared[ranges] = self._prepare(ranges)
        return self._prepared[ranges]

    def _prepare(self, ranges: Ranges | None) -> Prepared:
        g, format, scale = self.g, self._format, self._scale
        if format.dtype == "uint8" and self._zero_sum and ranges:
            return self._rounded(self._attenuated_bytes(), scale, 0)
        x = g("Cast", self.raw, to=FLOAT)
        if format.dtype == "uint8" and self._zero_sum:
            x = g("Mul", x, self.attenuation)
            return Prepared(g("Transpose", x, perm=[0, 2, 1]), scale)
        counts = [level_frames(format.window, self._architecture)]
        if self._rowwise:
            counts = each_frame(format.window).known_steps(format.window, self._prefixes)
        x = g("Sub", x, self._levels(x, counts, self._rowwise))
        x = g("Mul", x, g("Mul", self.attenuation, g.constant(scale)))
        if ranges is None:
            return Prepared(g("Transpose", x, perm=[0, 2, 1]), 1.0)
        step = ranges.counts * scale / (MIDDLE - 1)
        return self._rounded(graph_builder.quantized(g, x, step, MIDDLE), step, MIDDLE)

    def _rounded(self, rounded: str, step: float, zero: int) -> Prepared:
        x = graph_builder.channels_first(self.g, rounded, step, zero)
        return Prepared(x, step, rounded, zero)

    def _attenuation(self) -> str:
        g, window = self.g, self._format.window
        step, ranked = NOISE_LIMIT.step(window), NOISE_LIMIT.rank(self._format.channels) + 1
        older, newer = (g("Cast", self._every(step, start), to=FLOAT) for start in (0, 1))
        noise = g("ReduceMean", g("Abs", g("Sub", newer, older)), axes=[1])
        inputs = [noise, g.constant([ranked], "int64")]
        g.nodes.append(helper.make_node("TopK", inputs, ["strongest", "who"], axis=2))
        limit = g("Mul", g("ReduceMin", "strongest", axes=[2]), g.constant(NOISE_LIMIT.times))
        largest = np.finfo(np.float32).max
        limit = g("Where", g("Greater", limit, g.constant(0)), limit, g.constant(largest))
        return g("Div", limit, g("Max", noise, limit))

    def _every(self, step: int, start: int) -> str:
        """Raw counts of every step-th frame from `start` on, but not of a last frame that has no
        neighbour."""
        end = self._format.window - 1 + start
        return self.g("Slice", self.raw, [start], [end], [1], [step])

    def _attenuated_bytes(self) -> str:
        """Attenuated raw counts [1, T, R * C] as bytes; exact where the factor is 1."""
        g, format, scale = self.g, self._format, self._scale
        factors = graph_builder.quantized(g, self.attenuation, 1 / 255)
        factors = g("Expand", factors, [1, format.window, format.channels])
        counts = graph_builder.counts_of(g, self.raw, scale)
        product = g("Mul", counts, graph_builder.counts_of(g, factors, 1 / 255))
        return graph_builder.quantized(g, product, scale)

    def _levels(self, x: str, counts: list[int], rowwise: bool = False) -> str:
        """Raw counts [1, T, R * C] -> means over the first `counts` frames, [1, len(counts), R * C]
        or, rowwise, with a row each."""
        sums = graph_builder.sums(self.g, x, self._format.window, counts, rowwise=rowwise)
        size = self._format.channels
        return self.g("Mul", sums, graph_builder.mean_factors(self.g, 1.0, counts, size, rowwise))


def bank_responses(
    format: SweepFormat, scale: float, architecture: Architecture, filters: bank.Bank
) -> Iterator[tuple[Array, onnx.ModelProto]]:
    """For each of bank.groups the numbers of its filters and the float model of their responses,
    float32 [1, steps, filters]."""
    for numbers, _ in bank.groups(filters):
        nodes = _TrunkNodes(format, scale, architecture)
        g, taxels = nodes.g, nodes.prepared(None)
        y, (stage,) = bank.responses(g, format, filters.take(numbers), taxels.x, taxels.step, False)
        g("Identity", y, output="responses")
        yield numbers, g.model(format, "responses", stage.steps, len(numbers))


def count_range(samples: Array, architecture: Architecture) -> float:
    """How far int8 reaches on either side of a count's level, from raw counts [N, T, R, C]; see
    Ranges."""
    frames = level_frames(samples.shape[1], architecture)
    level = samples[:, :frames].mean(axis=1, keepdims=True, dtype=np.float64)
    return max(float(np.percentile(np.abs(samples - level), PERCENTILE)), 1e-6)
