"""The methods of the compact network: compact-bands to compact-100k, and compact.

Each is trained as `palpate-train fit --size` does. The method is the int8 graph that the box runs;
its precision "float" is the network from which the graph was made.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from train.data.sets import Dataset
from train.models.linear_head import expanded_head, hold_out_or_all
from train.models.methods import FULL_EFFORT, Effort, Log, Method, no_log
from train.models.recipe.architectures import ARCHITECTURES, DEFAULT, Architecture
from train.models.recipe.fitted import CompactModel
from train.models.recipe.stages import FitRecipe, fit_network_on, network_of
from train.models.training import NetworkModel, describe_run, scale_steps

Array = NDArray[Any]
RECIPE = FitRecipe()


def train_compact(
    sweeps: Dataset,
    inputs: Array,
    seed: int,
    *,
    architecture: Architecture,
    recipe: FitRecipe,
    log: Log,
) -> CompactModel:
    """A network of this architecture and its closed-form heads, trained as `palpate-train fit
    --size` does.

    inputs: the raw counts [N, T, R, C] of `sweeps`. Raises FormatError if only one material occurs,
    if each occurs only once, or if a window is too short.
    """
    known = replace(sweeps, samples=inputs).select(())
    fit = fit_network_on(*hold_out_or_all(known, seed), seed, recipe, log, architecture)
    network, present, ran = (
        network_of(fit),
        np.unique(sweeps.labels),
        describe_run(recipe, "cpu", False, False),
    )
    network.expand_head(present, len(sweeps.materials), 1.0)
    head = expanded_head(*fit.int8_head(), present, len(sweeps.materials))
    return CompactModel(fit, *head, ran, fit.cost, {"float": NetworkModel(network, ran, fit.cost)})


def methods(effort: Effort = FULL_EFFORT, log: Log = no_log) -> tuple[Method, ...]:
    """One method for each size and `compact`, trained with this effort. log: called after every
    iteration."""
    recipe = scale_steps(RECIPE, effort)

    def method(name: str, about: str, architecture: Architecture) -> Method:
        train = partial(train_compact, architecture=architecture, recipe=recipe, log=log)
        return Method(name, about, "raw", train, effort=f"{recipe.steps} iterations")

    convolutions = (
        "strided convolutions, a spectrum and a closed-form head in int8, {},000 weights at most"
    )
    bands = "the spectrum that all taxels share, and a closed-form head: nothing else is learned"
    sizes = (
        method(f"compact-{size}", convolutions.format(size[:-1]) if one.channels else bands, one)
        for size, one in ARCHITECTURES.items()
    )
    usual = "as compact-20k, or smaller where held-out sweeps need less"
    return (*sizes, method("compact", usual, DEFAULT))


METHODS = methods()
