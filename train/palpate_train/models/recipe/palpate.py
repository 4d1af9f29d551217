"""The methods of our family: palpate, its sizes, and palpate-reattached.

Each is the int8 graph that the box runs; its precision "float" is the model before quantization.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.models.linear_head import expanded_head
from palpate_train.models.methods import (
    AS_RECORDED,
    FULL_EFFORT,
    PACKAGED,
    SHIPPED,
    Effort,
    Log,
    Method,
    no_log,
)
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import FittedModel
from palpate_train.models.recipe.sizes import SIZES
from palpate_train.onnx_tools.graph_builder import GraphModel, with_head

Array = NDArray[Any]


def train(
    sweeps: Dataset, inputs: Array, seed: int, *, settings: recipe.Settings, log: Log = no_log
) -> FittedModel:
    """Fit as `palpate-train fit` does, on `inputs`, the raw counts [N, T, R, C] of `sweeps`, but
    without calibration.

    Raises FormatError as recipe.fit, and if only one material occurs.
    """
    known = replace(sweeps, samples=inputs).select(())
    fit = recipe.fit(known, Run(seed, log), replace(settings, calibrate=False))
    present = np.unique(sweeps.labels)
    heads = {
        name: expanded_head(
            fit.weights[f"{name}.weight"],
            fit.weights[f"{name}.bias"],
            present,
            len(sweeps.materials),
        )
        for name in ("head", "int8")
    }
    precisions = {"float": GraphModel(with_head(fit.trunk(int8=False), *heads["head"]))}
    return FittedModel(fit, *heads["int8"], fit.about["chosen"], precisions=precisions)


def methods(effort: Effort = FULL_EFFORT) -> tuple[Method, ...]:
    """`palpate`, its sizes, and the same for a skin that is taken off and put back."""
    settings = recipe.Settings(use=effort.use)
    special = "" if effort.use == AS_RECORDED else repr(effort.use)
    steps = max(round(recipe.STAGE_STEPS * effort.share), 2)

    def method(name: str, about: str, settings: recipe.Settings) -> Method:
        trains = f"{settings.steps} iterations of stages" if settings.steps else ""
        trains += f"{', ' * bool(trains and special)}{special}"
        return Method(name, about, "raw", partial(train, settings=settings), effort=trains)

    sizes = (
        method(
            f"{SHIPPED}-{name}",
            f"{size.about} at most",
            replace(settings, size=size, steps=steps if name == "stages" else 0),
        )
        for name, size in SIZES.items()
    )
    return (
        *sizes,
        method(
            SHIPPED,
            "filters, spectrum, relations and slow waves, as held-out groups of the training "
            "sweeps ask for",
            settings,
        ),
        method(
            PACKAGED,
            "as palpate, but all heads see augmented copies, as of a skin put back",
            replace(settings, use=replace(effort.use, reattached=True)),
        ),
    )
