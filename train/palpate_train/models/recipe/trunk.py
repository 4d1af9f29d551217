"""A trunk without heads: it computes the features of sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_train.answer.heads import HeadPlan
from palpate_train.data.sets import Dataset
from palpate_train.models.recipe import graph
from palpate_train.models.recipe.architectures import Architecture
from palpate_train.models.recipe.bank import Bank
from palpate_train.onnx_tools.graph_builder import run

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Trunk:
    """A trunk without heads, for sweeps of one set. weights: of stages and bank, as
    graph.trunk_graph takes them."""

    sweeps: Dataset
    scale: float
    weights: Mapping[str, Array]
    architecture: Architecture
    ranges: graph.Ranges

    def features(self, sweeps: Dataset, int8: bool = True) -> Array:
        """Features float32 [n, F] of `sweeps`."""
        ranges = self.ranges if int8 else None
        model = graph.trunk_graph(
            sweeps.format, self.scale, self.weights, self.architecture, ranges
        )
        return run(model, sweeps.samples)

    @property
    def quantized(self) -> bool:
        """Whether its features in int8 differ from those in float: stages, and what sees bytes."""
        return bool(self.architecture.channels) or self.sweeps.format.dtype == "uint8"

    def layout(self) -> dict[str, slice]:
        """See graph.layout."""
        return graph.layout(self.sweeps.format, self.weights, self.architecture)


def describe(trunk: Trunk, plan: HeadPlan) -> str:
    """The parts of the trunk, and how many discriminants see copies, in words."""
    pools, channels = trunk.architecture.pools, trunk.architecture.channels
    filters = Bank.of(trunk.weights).free if pools else np.empty(0, bool)
    words = [
        f"{int((filters == free).sum())} {name} filters"
        for free, name in ((False, "zero-sum"), (True, "free"))
        if (filters == free).any()
    ]
    words += [" and ".join(pools)] * (len(pools) > 0)
    words += ["distribution"] * trunk.architecture.distribution
    words += ["loads"] * trunk.architecture.loads
    scales = trunk.architecture.relations
    words += [f"relations at {scales} scales"] * (scales > 0)
    words += ["slow waves"] * trunk.architecture.slow
    words += ["spectrum"] * trunk.architecture.spectrum
    words += [f"stages of {', '.join(map(str, channels))} channels"] * (len(channels) > 0)
    copied = sum(part.copies for part in plan.parts)
    return f"{', '.join(words)}; {len(plan.parts)} discriminants, {copied} with augmented copies"
