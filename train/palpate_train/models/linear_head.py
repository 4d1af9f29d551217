"""Linear heads on features that a graph computes, and the sweeps that are held out to judge them.

A head is fitted by scikit-learn to the features that the graph gives on the box. One temperature,
found on held-out groups, calibrates its probabilities. minirocket.py and sthmp.py build the graphs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data.sets import Dataset
from palpate_train.metrics.temperature import platt_temperature
from palpate_train.onnx_tools.graph_builder import run, with_head

Array = NDArray[Any]
HELD_OUT = 0.2
"""Share of the groups that is held out from training, for temperature and validation."""
ABSENT = -30.0
"""Logit of a material that training never saw. The best of the other logits is never below 0, so
the probability of such a material is below 1e-12."""
SHARPENING = 30.0
"""Factor on margins before `platt_temperature`, which only softens: margins are about 1 and have to
be sharpened."""


@dataclass(frozen=True, eq=False)
class LinearHeadModel:
    """A trained model: features that a graph computes, and a linear head with the temperature
    folded in.

    features: `sweep` [1, T, R, C] -> `features` float32 [1, F]. weight [K, F], bias [K]: float32.
    """

    features: onnx.ModelProto
    weight: Array
    bias: Array

    def logits(self, inputs: Array) -> Array:
        """Raw counts [n, T, R, C] -> logits float32 [n, K], from the graph that the box runs."""
        return run(self.graph(), inputs)

    def graph(self) -> onnx.ModelProto:
        """`sweep` [1, T, R, C] -> `logits` float32 [1, K]."""
        return with_head(self.features, self.weight, self.bias)


def hold_out(
    sweeps: Dataset, seed: int, by: Sequence[str] = ("position",)
) -> tuple[Dataset, Dataset, str]:
    """(training sweeps, held-out sweeps, name of the group): whole values of the first group of
    `by` that has several and can be split, else recordings.

    Raises FormatError if the set has too few groups, or if only one sweep of a material would be
    left to train on.
    """
    for name in by:
        if len(np.unique(sweeps.groups.get(name, 0))) > 1:
            with suppress(FormatError):
                return _split(sweeps, name, seed)
    return _split(sweeps, "recording", seed)


def hold_out_or_all(
    sweeps: Dataset, seed: int, by: Sequence[str] = ("position",)
) -> tuple[Dataset, Dataset, str]:
    """As `hold_out`; if the set is too small, all of it on both sides, by "nothing". Then only
    Platt's correction bounds the temperature."""
    try:
        return hold_out(sweeps, seed, by)
    except FormatError:
        return sweeps, sweeps, "nothing"


def _split(sweeps: Dataset, by: str, seed: int) -> tuple[Dataset, Dataset, str]:
    train, held_out = sweeps.split(by, 1 - HELD_OUT, seed)
    counts = np.bincount(train.labels, minlength=len(sweeps.materials))
    if 1 in counts:
        material = sweeps.materials[int(np.flatnonzero(counts == 1)[0])]
        raise FormatError(
            f"{sweeps.source}: split by {by!r} leaves one sweep of {material!r}; record more of it"
        )
    return train, held_out, by


def train_linear_head(
    features: onnx.ModelProto,
    fit: Callable[[Array, Array], tuple[Array, Array]],
    sweeps: Dataset,
    inputs: Array,
    seed: int,
) -> LinearHeadModel:
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
    all_weight = np.zeros((len(sweeps.materials), computed.shape[1]), np.float32)
    all_bias = np.full(len(sweeps.materials), ABSENT, np.float32)
    weight, bias = _centred(*fit(computed, labels))
    all_weight[present], all_bias[present] = weight * factor, bias * factor
    return LinearHeadModel(features, all_weight, all_bias)


def _centred(coefficients: Array, intercepts: Array) -> tuple[Array, Array]:
    """One row for each label, minus their mean, so that the largest margin is never below 0."""
    coefficients, intercepts = np.atleast_2d(coefficients), np.atleast_1d(intercepts)
    if len(coefficients) == 1:  # of two labels scikit-learn gives the second one's margin
        coefficients, intercepts = (
            np.vstack([-coefficients, coefficients]),
            np.append(-intercepts, intercepts),
        )
    return coefficients - coefficients.mean(0), intercepts - intercepts.mean()


def expanded_head(weight: Array, bias: Array, present: Array, classes: int) -> tuple[Array, Array]:
    """A head for all `classes`, trained for those in `present`; see Network.expand_head."""
    all_weight, all_bias = (
        np.zeros((classes, weight.shape[1]), np.float32),
        np.full(classes, ABSENT, np.float32),
    )
    all_weight[present], all_bias[present] = weight - weight.mean(axis=0), bias - bias.mean()
    return all_weight, all_bias
