"""The room of graphs with a linear head. In: a graph that computes features, training sweeps. Out: a Model of both.

minirocket.py and sthmp.py make the graphs; what trains the head is the graph itself, as the box runs it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from train.data.sets import LabelledSweeps
from train.models.heads import ABSENT, hold_out, temperature
from train.onnx_tools.graph_builder import run, with_head

Array = NDArray[Any]
SHARPEST = 30.0
"""Margins are about 1 and need sharpening, while `temperature` only softens: what it starts from."""


@dataclass(frozen=True)
class Headed:
    """A trained model: features that a graph computes, and a linear head with the temperature folded in.

    features: `sweep` [1, T, R, C] -> `features` float32 [1, F]. weight [K, F], bias [K]: float32.
    """

    features: onnx.ModelProto
    weight: Array
    bias: Array

    def logits(self, given: Array) -> Array:
        """Digits [n, T, R, C] -> logits float32 [n, K], by the very graph that the box runs."""
        return run(self.graph(), given)

    def graph(self) -> onnx.ModelProto:
        """`sweep` [1, T, R, C] -> `logits` float32 [1, K]."""
        return with_head(self.features, self.weight, self.bias)


def headed(
    features: onnx.ModelProto,
    fit: Callable[[Array, Array], tuple[Array, Array]],
    sweeps: LabelledSweeps,
    given: Array,
    seed: int,
) -> Headed:
    """The graph `features` with a linear head, trained on `given`, the digits [N, T, R, C] of `sweeps`.

    fit: (features [n, F], labels [n]) -> scikit-learn's coefficients [k, F] and intercepts [k] for the k labels there,
    one of each where there are two. The temperature is found on the groups that `hold_out` names, with a head that
    did not see them; it is 1 where `sweeps` are too few for that.
    """
    there, labels = np.unique(sweeps.labels, return_inverse=True)
    seen = run(features, given)
    factor = 1.0
    with suppress(FormatError):
        numbered = replace(sweeps, groups=sweeps.groups | {"index": np.arange(len(sweeps))})
        part, held = (side.group("index") for side in hold_out(numbered, seed)[:2])
        weight, bias = _centred(*fit(seen[part], labels[part]))
        factor = SHARPEST / temperature(SHARPEST * (seen[held] @ weight.T + bias), labels[held])
    whole_weight = np.zeros((len(sweeps.materials), seen.shape[1]), np.float32)
    whole_bias = np.full(len(sweeps.materials), ABSENT, np.float32)
    weight, bias = _centred(*fit(seen, labels))
    whole_weight[there], whole_bias[there] = weight * factor, bias * factor
    return Headed(features, whole_weight, whole_bias)


def _centred(coefficients: Array, intercepts: Array) -> tuple[Array, Array]:
    """One row a label, less their mean: the best margin is then never below 0."""
    coefficients, intercepts = np.atleast_2d(coefficients), np.atleast_1d(intercepts)
    if len(coefficients) == 1:  # of two labels scikit-learn gives the second one's margin
        coefficients, intercepts = np.vstack([-coefficients, coefficients]), np.append(-intercepts, intercepts)
    return coefficients - coefficients.mean(0), intercepts - intercepts.mean()
