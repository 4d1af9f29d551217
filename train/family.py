"""The room of the box's own method. In: an Effort. Out: the METHOD compact, trained as `palpate-train fit` does."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .fit import Recipe, fit_on
from .loop import Log, silent
from .methods import USUAL, Effort, Method
from .nets import Trained, parts, ran, shortened
from .sets import SweepSet

Array = NDArray[Any]
RECIPE = Recipe()
GRID_SHIFT = 0.5
"""Share of the training sweeps that `compact` moves by one row of taxels, where the taxels form a grid (as the bundle
of the box does); in a line of taxels there is no row to be off by."""


def train_compact(sweeps: SweepSet, given: Array, seed: int, *, steps: int, log: Log) -> Trained:
    """Train the compact network and its closed-form head, as `palpate-train fit` does.

    Raises FormatError where only one material occurs, each only once, or a window is too short.
    """
    known = replace(sweeps, samples=given).select(())
    line = 1 in (known.format.rows, known.format.cols)
    recipe = replace(RECIPE, steps=steps, row_shift=0.0 if line else GRID_SHIFT)
    made = fit_on(*parts(known, seed), seed, recipe, log)
    network = made.network()
    network.spread(np.unique(sweeps.labels), len(sweeps.materials), 1.0)
    return Trained(network, ran(recipe, "cpu", False, False), made.cost)


def methods(effort: Effort = USUAL, log: Log = silent) -> tuple[Method, ...]:
    """The family, trained with this effort. log: is told of every iteration."""
    compact = partial(train_compact, steps=shortened(RECIPE, effort).steps, log=log)
    return (
        Method("compact", "the box's own small network with a closed-form head", "raw", compact,
               effort=f"{compact.keywords['steps']} iterations"),
    )  # fmt: skip


METHODS = methods()
