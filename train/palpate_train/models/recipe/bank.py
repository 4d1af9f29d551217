"""A bank of random filters, which are not trained: their draw, and their nodes in a trunk.

Each filter is a dilated kernel over time, the same for a random subset of the taxels up to a factor
for each taxel. Kernel and factors are small integers, so float and int8 have the same taps, and a
bundle holds 25 bytes for 144 taps. The responses are pooled twice: the logarithm of their mean
magnitude, and the share of responses above a threshold (Dempster et al. 2021 use the share alone).
A filter either sums to zero over time on each taxel, so that offsets do not matter, or is free,
which needs taxels without their means.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate_train.models.recipe.architectures import FLOOR, FilterStage
from palpate_train.onnx_tools import graph_builder
from palpate_train.onnx_tools.graph_builder import FLOAT, MIDDLE, GraphBuilder
from palpate_train.onnx_tools.quantize import PERCENTILE

Array = NDArray[Any]
POOLS = "magnitudes", "shares"
"""The features of a filter: the logarithm of its mean magnitude, and the share of its responses
above a threshold."""
TAPS, DILATED, PART = 9, 16, 16
"""Taps of a filter in time. A dilation is at most DILATED or, in long windows, a PART of the
window; the filters then span half of it."""
MOST_FILTERS, LEAST_FILTERS = 512, 64
MOST_TAPS, MOST_MACS = 36_864, 12_000_000
"""Largest number of taps of all filters of a kind (256 filters of sixteen taxels, 512 of eight or
fewer), and of their multiply-accumulates for a window, from which the stride follows."""
LARGE, MORE = 40, 4
"""A skin of more channels than LARGE may have MORE times of both; the filters of fewer would be too
few to see each part of it."""
LARGEST, SPREAD = 8, 3.0
"""Largest factor of a taxel and of a frame, whose product is a tap of seven bits; deviation of the
normal numbers that are rounded to such factors."""
MOST_STEPS = 1024
"""Largest number of responses of a filter for a window. The logarithm of a mean over few is
noisy."""
SHARES = (0.1, 0.9)
"""Range of the share of training responses above the threshold of a filter, which is drawn
uniformly."""


@dataclass(frozen=True, eq=False)
class Bank:
    """Filters for one format, in the order of `free`, then `dilations`.

    across: int8 [F, R * C], factors of the taxels; along: int8 [F, TAPS], of the frames. unit: [F],
    factor of their products, on scaled counts; 999 of 1000 training responses lie between -1 and 1.
    dilations: int [F]. free: bool [F], not zero-sum. reach: [F], a response of 1 in deviations of
    the counts. limits: [F], thresholds of responses.
    """

    across: Array
    along: Array
    unit: Array
    dilations: Array
    free: Array
    reach: Array
    limits: Array

    def __len__(self) -> int:
        return len(self.unit)

    def taps(self) -> Array:
        """float32 [F, R * C, TAPS]."""
        taps: Array = self.unit[:, None, None] * (
            self.across[:, :, None].astype(np.float32) * self.along[:, None, :]
        )
        return taps

    def take(self, kept: Array) -> Bank:
        """The filters `kept` (mask or ascending numbers)."""
        return Bank(**{name: values[kept] for name, values in vars(self).items()})

    def weights(self) -> dict[str, Array]:
        """The weights that a Fit keeps."""
        return {f"bank.{name}": values for name, values in vars(self).items()}

    @classmethod
    def of(cls, weights: Mapping[str, Array]) -> Bank:
        """The bank that gave these `weights`. Raises KeyError if there was none."""
        return cls(**{name: weights[f"bank.{name}"] for name in cls.__dataclass_fields__})


def count(format: SweepFormat) -> int:
    """Number of filters of one kind for `format`."""
    most = _more(format) * MOST_TAPS // (format.channels * TAPS)
    return int(np.clip(most, LEAST_FILTERS, MOST_FILTERS))


def _more(format: SweepFormat) -> int:
    return MORE if format.channels > LARGE else 1


def dilations(window: int) -> list[int]:
    """The dilations of filters for a window of this many frames: 1, 2, 4 and so on. Raises
    FormatError if the window is shorter than a filter."""
    if window < TAPS:
        raise FormatError(
            f"a window of {window} frames is too short for a filter; record at least {TAPS}"
        )
    most = min(max(DILATED, window // PART), (window - 1) // (TAPS - 1))
    return [2**k for k in range(most.bit_length())]


def draw(format: SweepFormat, rng: np.random.Generator, kinds: Sequence[bool]) -> Bank:
    """`count` filters of each kind (free or not), with all dilations that fit into the window in
    turn; their taps have unit norm.

    Raises FormatError if the window is shorter than a filter.
    """
    fitting = dilations(format.window)
    taxels, filters = format.channels, count(format)
    free = np.repeat(kinds, filters)
    across = np.rint(SPREAD * rng.standard_normal((len(free), taxels))).clip(-LARGEST, LARGEST)
    across[across == 0] = 1
    sizes = (
        np.floor(np.exp(rng.uniform(0, np.log(taxels + 1), len(free)))).astype(int).clip(1, taxels)
    )
    for factors, size in zip(across, sizes, strict=True):
        factors[rng.permutation(taxels)[size:]] = 0
    drawn = SPREAD * rng.standard_normal((len(free), 1, TAPS))
    along = np.where(free[:, None], np.rint(drawn)[:, 0], graph_builder.zero_sum_taps(drawn)[:, 0])
    along = _within(along)
    unit = 1 / np.maximum(np.linalg.norm(across, axis=1) * np.linalg.norm(along, axis=1), 1)
    one = np.ones(len(free), np.float32)
    return Bank(
        across.astype(np.int8),
        along.astype(np.int8),
        unit.astype(np.float32),
        np.tile(np.resize(fitting, filters), len(kinds)),
        free,
        one,
        0 * one,
    )


def _within(along: Array) -> Array:
    """Kernels [F, TAPS] of whole numbers, halved until no number is above LARGEST; a kernel of
    zeros becomes a difference."""
    kernels = []
    for kernel in along:
        zero_sum = kernel.sum() == 0
        while np.abs(kernel).max() > LARGEST:
            kernel = (
                (graph_builder.zero_sum_taps(kernel[None, None] / 2)[0, 0])
                if zero_sum
                else np.rint(kernel / 2)
            )
        kernels.append(kernel if kernel.any() else np.eye(TAPS)[0] - np.eye(TAPS)[-1])
    return np.stack(kernels)


def fitted(drawn: Bank, seen: Sequence[Array], rng: np.random.Generator) -> Bank:
    """Drawn filters, scaled to their responses. seen: for each filter, in order, its responses [n]
    to training sweeps."""
    reach = np.array(
        [max(float(np.percentile(np.abs(x), PERCENTILE)), 1e-6) for x in seen], np.float32
    )
    above = rng.uniform(*SHARES, len(seen))
    quantiles = [np.quantile(x, 1 - share) for x, share in zip(seen, above, strict=True)]
    limits = (np.array(quantiles, np.float32) / reach).clip(-1, 0.99)
    return replace(drawn, unit=drawn.unit / reach, reach=reach, limits=limits).take(
        np.lexsort((drawn.dilations, drawn.free))
    )


def stage(format: SweepFormat, dilation: int) -> FilterStage:
    """The responses of a filter of this dilation."""
    macs = count(format) * format.channels * TAPS * format.window
    stride = max(1, format.window // MOST_STEPS, -(-macs // (_more(format) * MOST_MACS)))
    reach = (TAPS - 1) * dilation + 1
    return FilterStage(TAPS, stride, (format.window - reach) // stride + 1, reach, stride)


def groups(bank: Bank) -> list[tuple[Array, int]]:
    """The filters of each convolution: their numbers, in order, and their dilation."""
    kinds = sorted({(bool(f), int(d)) for f, d in zip(bank.free, bank.dilations, strict=True)})
    return [(np.flatnonzero((bank.free == f) & (bank.dilations == d)), d) for f, d in kinds]


@dataclass(frozen=True)
class Pooling:
    """The pooling of responses. int8: in integers. pools: some of POOLS. prefixes: for each
    prefix. rowwise: each prefix has a row of its own."""

    int8: bool
    pools: tuple[str, ...]
    prefixes: bool = False
    rowwise: bool = False


def responses(
    g: GraphBuilder, format: SweepFormat, bank: Bank, x: str, step: float, int8: bool
) -> tuple[str, list[FilterStage]]:
    """Taxels [n, R * C, T] in units of `step` -> responses [n, steps, filters], with the
    FilterStage of each of `groups`.

    Long filters give fewer responses than short ones. Zeros after the window make their number
    equal; these responses are ignored. In int8 a response is a byte, where MIDDLE is 0 and 255
    about 1.
    """
    found, stages = [], [stage(format, dilation) for _, dilation in groups(bank)]
    shortest = min(shape.reach for shape in stages)
    for (numbers, dilation), shape in zip(groups(bank), stages, strict=True):
        taps, behind = _taps(g, bank.take(numbers), step, int8), [0, shape.reach - shortest]
        y = g("Conv", x, taps, dilations=[dilation], strides=[shape.stride], pads=behind)
        y = graph_builder.quantized(g, y, 1 / (MIDDLE - 1), MIDDLE) if int8 else y
        found.append(g("Transpose", y, perm=[0, 2, 1]))
    return graph_builder.side_by_side(g, found), stages


def _taps(g: GraphBuilder, bank: Bank, step: float, int8: bool) -> str:
    """Taps [F, R * C, TAPS] in units of `step`. onnxruntime multiplies the factors when it loads
    the graph."""
    factors = (
        g.constant(bank.across[:, :, None], "int8"),
        g.constant(bank.along[:, None, :], "int8"),
    )
    taps = g("Mul", *(g("Cast", x, to=TensorProto.INT64) for x in factors))
    taps = g("Cast", taps, to=TensorProto.INT8)
    # the scale of the counts is a separate factor in int8, and part of the product in float
    unit = bank.unit if int8 else bank.unit * step
    return g(
        "DequantizeLinear", taps, g.constant(unit), g.constant(np.zeros(len(bank)), "int8"), axis=0
    )


def pooled(
    g: GraphBuilder, format: SweepFormat, bank: Bank, x: str, step: float, how: Pooling
) -> list[str]:
    """Taxels as for `responses` -> log mean magnitudes, and shares above the thresholds, each
    [1, 1 or PREFIXES, F]; only the ones `how` has."""
    y, stages = responses(g, format, bank, x, step, how.int8)
    counts = np.array([shape.known_steps(format.window, how.prefixes) for shape in stages]).T
    steps, weights = max(shape.steps for shape in stages), _of_own_group(g, bank, counts)

    def mean(z: str) -> str:
        """[n, steps, F] -> means over the responses of each filter."""
        total = graph_builder.sums(g, z, steps, counts, integers=how.int8, rowwise=how.rowwise)
        total = g("Reshape", g("Cast", total, to=FLOAT) if how.int8 else total, [*counts.shape, -1])
        return g("ReduceSum", g("Mul", total, weights), [1])

    def magnitudes() -> str:
        size = g("Sub", *map(mean, _sides(g, y))) if how.int8 else mean(g("Abs", y))
        size = g("Mul", size, g.constant(bank.reach / (MIDDLE - 1 if how.int8 else 1)))
        return g("Log", g("Add", size, g.constant(FLOOR)))

    def shares() -> str:
        return mean(_above(g, y, bank.limits, how.int8))

    kinds = dict(zip(POOLS, (magnitudes, shares), strict=True))
    return [g("Transpose", make(), perm=[1, 0, 2]) for n, make in kinds.items() if n in how.pools]


def _of_own_group(g: GraphBuilder, bank: Bank, counts: Array) -> str:
    """Factors [m, groups, F] that turn sums over counts [m, groups] into means, 0 for other groups
    than the filter's."""
    ends = np.cumsum([len(numbers) for numbers, _ in groups(bank)])[:, None]
    at = g("Range", *(g.constant(n, "int32") for n in (0, len(bank), 1)))
    own = g("Not", g("Less", at, g.constant(np.append(0, ends[:-1])[:, None], "int32")))
    own = g("And", own, g("Less", at, g.constant(ends, "int32")))
    # without a known response the sum is 0 as well
    factors = g.constant(1 / np.maximum(counts, 1)[:, :, None])
    return g("Mul", g("Cast", own, to=FLOAT), factors)


def _sides(g: GraphBuilder, y: str) -> Iterator[str]:
    """Bytes clipped to above MIDDLE, and to below. The difference of their means is the mean
    magnitude, because the multiples of MIDDLE cancel."""
    for side in ((MIDDLE, 255), (0, MIDDLE)):
        yield g("Clip", y, *(g.constant(end, "uint8") for end in side))


def _above(g: GraphBuilder, y: str, limits: Array, int8: bool) -> str:
    """1 for each response above `limits` [filters], else 0."""
    if not int8:
        return g("Cast", g("Greater", y, g.constant(limits)), to=FLOAT)
    over = g("Greater", y, g.constant(np.floor(limits * (MIDDLE - 1)) + MIDDLE, "uint8"))
    return g("Cast", over, to=TensorProto.UINT8)
