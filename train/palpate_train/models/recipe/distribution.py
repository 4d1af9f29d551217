"""The distribution of each taxel's counts and of their changes: shares above levels, and their
nodes in a trunk.

A filter responds to neighbouring frames. How often a taxel is at a height, and how far it moves
from one frame to the next, is other evidence (Dempster et al. 2024, QUANT, which sorts to find
quantiles). Here levels are fixed and the frames above them are counted, which needs no sorting. A
feature is a share for each taxel, signal and level. The mean over the window is subtracted from
counts, so that offsets do not matter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

from palpate.core.types import SweepFormat
from palpate_train.models.recipe.architectures import PREFIXES, FilterStage
from palpate_train.onnx_tools import graph_builder
from palpate_train.onnx_tools.graph_builder import FLOAT, GraphBuilder

Array = NDArray[Any]
SIGNALS = 2
"""Number of signals: counts without their mean, and differences between neighbouring frames."""
MOST_FEATURES = 256
FEWEST_LEVELS, MOST_LEVELS = 4, 16
MOST_FRAMES = 256
"""Largest number of frames of a window to count; they are evenly spaced."""
APART = 1e-3
"""Distance, in deviations, of the two values between which a level lies in the middle: whole counts
never equal it."""


@dataclass(frozen=True, eq=False)
class Levels:
    """taxels: int [n], ascending, the taxels that are used. levels: float32 [SIGNALS, n, k], of
    scaled counts."""

    taxels: Array
    levels: Array

    def __len__(self) -> int:
        """Number of features."""
        return int(self.levels.size)

    def weights(self) -> dict[str, Array]:
        """The weights that a Fit keeps."""
        return {f"distribution.{name}": values for name, values in vars(self).items()}

    @classmethod
    def of(cls, weights: Mapping[str, Array]) -> Levels:
        """The levels that gave these `weights`. Raises KeyError if there were none."""
        return cls(**{name: weights[f"distribution.{name}"] for name in cls.__dataclass_fields__})


def fitted(samples: Array, scale: float, rng: np.random.Generator) -> Levels:
    """Levels at evenly spaced quantiles of raw counts [N, T, R, C, ...] of training sweeps. If
    there are more taxels than MOST_FEATURES allows, random ones are used."""
    n, window = samples.shape[:2]
    counts = samples.reshape(n, window, -1)
    taxels = np.sort(rng.permutation(counts.shape[2])[: MOST_FEATURES // (SIGNALS * FEWEST_LEVELS)])
    x = counts[:, :, taxels].astype(np.float64) * scale
    number = int(np.clip(MOST_FEATURES // (SIGNALS * len(taxels)), FEWEST_LEVELS, MOST_LEVELS))
    hop = _looked(window).hop
    older, newer = x[:, : window - 1 : hop], x[:, 1::hop]
    seen = older - older.mean(axis=1, keepdims=True), newer - older
    levels = [
        [_levels(values[:, :, i].ravel(), number) for i in range(len(taxels))] for values in seen
    ]
    return Levels(taxels, np.array(levels, np.float32))


def _levels(values: Array, number: int) -> Array:
    """Quantiles [number] of `values` [n], each moved up to the middle between two values, or above
    the largest. A taxel that never moves is not above any of its levels."""
    ordered = np.sort(values)
    at = np.quantile(ordered, (np.arange(number) + 0.5) / number, method="lower")
    above = np.searchsorted(ordered, at + max(APART * float(ordered.std()), 1e-12), side="right")
    levels: Array = (at + np.append(ordered, ordered[-1] + APART)[above]) / 2
    return levels


def _looked(window: int) -> FilterStage:
    """The frames that are used, each with the next one."""
    hop = max(window // MOST_FRAMES, 1)
    return FilterStage(2, hop, (window - 2) // hop + 1, 2, hop)


def pooled(
    g: GraphBuilder,
    format: SweepFormat,
    some: Levels,
    x: str,
    step: float,
    int8: bool,
    prefixes: bool = False,
) -> str:
    """Taxels [n, R * C, T], which times `step` are scaled counts, n being 1 or PREFIXES -> shares
    [1, 1 or PREFIXES, len(some)] for each signal, taxel and level. int8: whether frames are counted
    in integers."""
    if len(some.taxels) < format.channels:
        x = g("Gather", x, some.taxels, axis=1)
    looked, taxels = _looked(format.window), len(some.taxels)
    counts = looked.known_steps(format.window, prefixes)
    total = partial(graph_builder.sums, g, steps=looked.steps, counts=counts, rowwise=prefixes)
    older, newer = (
        g("Slice", x, [at], [format.window - 1 + at], [2], [looked.hop]) for at in (0, 1)
    )
    changes, older = (
        g("Transpose", signal, perm=[0, 2, 1]) for signal in (g("Sub", newer, older), older)
    )
    if prefixes:  # each prefix has its own means
        changes = g("Expand", changes, [PREFIXES, looked.steps, taxels])
    about = g(
        "Sub",
        older,
        g("Mul", total(older), graph_builder.mean_factors(g, 1.0, counts, taxels, prefixes)),
    )
    y = g("Transpose", graph_builder.side_by_side(g, [about, changes]), perm=[0, 2, 1])
    # comparing a level with a whole row of frames is four times as fast as comparing a frame with
    # a row of levels
    levels = some.levels.reshape(SIGNALS * taxels, -1, 1) / step
    above = g("Greater", g("Reshape", y, [0, 0, 1, -1]), g.constant(levels))
    above = g(
        "Reshape", g("Cast", above, to=TensorProto.UINT8 if int8 else FLOAT), [0, len(some), -1]
    )
    above = total(above, integers=int8, time_last=True)
    shares = g("Cast", above, to=FLOAT) if int8 else above
    shares = g("Mul", shares, graph_builder.mean_factors(g, 1.0, counts, len(some), prefixes))
    return g("Reshape", shares, [1, PREFIXES, -1]) if prefixes else shares
