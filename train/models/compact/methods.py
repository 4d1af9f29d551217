"""The room of the box's own methods. In: an Effort. Out: the METHODS compact-1k to compact-100k, and compact.

NetworkModel as `palpate-train fit` does. The method is what the box runs, the int8 graph; its form "float" is the network it
was made of.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from train.data.sets import Dataset
from train.models.compact.architectures import ARCHITECTURES, DEFAULT, Architecture
from train.models.compact.fit import Fit, FitRecipe, fit_on
from train.models.linear_head import ABSENT
from train.models.methods import FULL_EFFORT, Effort, Method, Model
from train.models.neural_methods import NetworkModel, parts, ran, shortened
from train.models.training import Cost, Log, silent
from train.onnx_tools.graph_builder import run, with_head

Array = NDArray[Any]
RECIPE = FitRecipe()
SPECTRUM = "the spectrum that all taxels share, and a closed-form head: nothing else is learnt"


@dataclass(frozen=True)
class CompactModel:
    """A trained member of the family as the box runs it. forms: "float", the same before quantization.

    made: the fit it comes from, with the sweeps that were trained on and held out. weight [K, F], bias [K]: its head.
    """

    made: Fit
    weight: Array
    bias: Array
    ran: str
    cost: Cost = field(default_factory=list)
    forms: Mapping[str, Model] = field(default_factory=dict)

    def features(self, given: Array, tenths: bool = False) -> Array:
        """Digits [n, T, R, C] -> what the head sees, float32 [n, F]; of each tenth [n, 10, F]; see exact.trunk."""
        return run(self.made.trunk(tenths=tenths), given)

    def logits(self, given: Array) -> Array:
        """Digits [n, T, R, C] -> float32 [n, K]."""
        return run(self.graph(), given)

    def graph(self) -> onnx.ModelProto:
        """`sweep` [1, T, R, C] -> `logits` float32 [1, K]."""
        return with_head(self.made.trunk(), self.weight, self.bias)


def train_compact(
    sweeps: Dataset, given: Array, seed: int, *, shape: Architecture, recipe: FitRecipe, log: Log
) -> CompactModel:
    """Train a network of this shape and its closed-form heads, as `palpate-train fit` does.

    Raises FormatError where only one material occurs, each only once, or a window is too short.
    """
    known = replace(sweeps, samples=given).select(())
    made = fit_on(*parts(known, seed), seed, recipe, log, shape)
    network, present, told = made.network(), np.unique(sweeps.labels), ran(recipe, "cpu", False, False)
    network.spread(present, len(sweeps.materials), 1.0)
    head = spread(*made.int8_head(), present, len(sweeps.materials))
    return CompactModel(made, *head, told, made.cost, {"float": NetworkModel(network, told, made.cost)})


def spread(weight: Array, bias: Array, present: Array, classes: int) -> tuple[Array, Array]:
    """A head for all `classes`, of which `present` were learnt; as Network.spread."""
    all_weight, all_bias = np.zeros((classes, weight.shape[1]), np.float32), np.full(classes, ABSENT, np.float32)
    all_weight[present], all_bias[present] = weight - weight.mean(axis=0), bias - bias.mean()
    return all_weight, all_bias


def methods(effort: Effort = FULL_EFFORT, log: Log = silent) -> tuple[Method, ...]:
    """The family, trained with this effort. log: is told of every iteration."""
    recipe = shortened(RECIPE, effort)

    def rung(name: str, about: str, shape: Architecture) -> Method:
        train = partial(train_compact, shape=shape, recipe=recipe, log=log)
        return Method(name, about, "raw", train, effort=f"{recipe.steps} iterations")

    about = "strided convolutions, a spectrum and a closed-form head in int8, {},000 weights at most"
    ladder = (
        rung(f"compact-{size}", about.format(size[:-1]) if shape.channels else SPECTRUM, shape)
        for size, shape in ARCHITECTURES.items()
    )
    return (*ladder, rung("compact", "the box's own: as compact-20k, or less where held-out sweeps need less", DEFAULT))


METHODS = methods()
