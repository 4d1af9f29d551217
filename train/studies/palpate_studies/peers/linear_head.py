"""Linear heads on features that a graph computes.

A head is fitted by scikit-learn to the features that the graph gives on the box. One temperature,
found on held-out groups, calibrates its probabilities. minirocket.py and sthmp.py build the graphs.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data.sets import Dataset
from palpate_train.metrics.temperature import platt_temperature
from palpate_train.models.linear_head import expanded_head, hold_out
from palpate_train.onnx_tools.graph_builder import GraphModel, run, with_head

Array = NDArray[Any]
SHARPENING = 30.0
"""Factor on margins before `platt_temperature`, which only softens: margins are about 1 and have to
be sharpened."""


def train_linear_head(
    features: onnx.ModelProto,
    fit: Callable[[Array, Array], tuple[Array, Array]],
    sweeps: Dataset,
    inputs: Array,
    seed: int,
) -> GraphModel:
    """The graph `features` with a linear head, trained on `inputs`, the raw counts [N, T, R, C] of
    `sweeps`.

    fit: (features [n, F], labels [n]) -> scikit-learn's coefficients [k, F] and intercepts [k] for
    the k labels that occur, in one row if k is 2. The temperature is found on the groups that
    `hold_out` returns, with a head that did not see them; it is 1 if `sweeps` are too few.
    """
    present, labels = np.unique(sweeps.labels, return_inverse=True)
    computed = run(features, inputs)
    factor = 1.0
    with suppress(FormatError):
        numbered = replace(sweeps, groups=sweeps.groups | {"index": np.arange(len(sweeps))})
        train, held_out = (side.group("index") for side in hold_out(numbered, seed)[:2])
        weight, bias = _centred(*fit(computed[train], labels[train]))
        margins = computed[held_out] @ weight.T + bias
        factor = SHARPENING / platt_temperature(SHARPENING * margins, labels[held_out])
    weight, bias = _centred(*fit(computed, labels))
    classes = len(sweeps.materials)
    whole = expanded_head(weight * factor, bias * factor, present, classes)
    return GraphModel(with_head(features, *whole))


def _centred(coefficients: Array, intercepts: Array) -> tuple[Array, Array]:
    """One row for each label, minus their mean, so that the largest margin is never below 0."""
    coefficients, intercepts = np.atleast_2d(coefficients), np.atleast_1d(intercepts)
    if len(coefficients) == 1:  # of two labels scikit-learn gives the second one's margin
        coefficients, intercepts = (
            np.vstack([-coefficients, coefficients]),
            np.append(-intercepts, intercepts),
        )
    return coefficients - coefficients.mean(0), intercepts - intercepts.mean()
