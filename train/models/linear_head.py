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
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from appliance.core.errors import FormatError
from train.data.sets import Dataset
from train.onnx_tools.graph_builder import run, with_head

Array = NDArray[Any]
HELD_OUT = 0.2
"""Share of the groups that training does not see: they give the temperature and the figures of validation."""
TEMPERATURES = np.geomspace(1, 100, 200)
"""From the LDA's own posteriors, which are never too modest, to hardly sure of anything."""
ABSENT = -30.0
"""Logit of a material that training never saw, where the best of the others is never below 0: its probability is below
1e-12."""
SHARPEST = 30.0
"""Margins are about 1 and need sharpening, while `temperature` only softens: what it starts from."""


def hold_out(sweeps: Dataset, seed: int) -> tuple[Dataset, Dataset, str]:
    """(to train on, held out, by what): whole positions where there are several and these allow it, else recordings.

    Raises FormatError where the set has too few groups, or one sweep of a material would be all that is left.
    """
    if len(np.unique(sweeps.groups.get("position", 0))) > 1:
        with suppress(FormatError):
            return _parted(sweeps, "position", seed)
    return _parted(sweeps, "recording", seed)


def _parted(sweeps: Dataset, by: str, seed: int) -> tuple[Dataset, Dataset, str]:
    train, held = sweeps.split(by, 1 - HELD_OUT, seed)
    counts = np.bincount(train.labels, minlength=len(sweeps.materials))
    if 1 in counts:
        one = sweeps.materials[int(np.flatnonzero(counts == 1)[0])]
        raise FormatError(f"{sweeps.source}: split by {by!r} leaves one sweep of {one!r}; record more of it")
    return train, held, by


def closed_form_head(seen: Array, labels: Array, held: Array, held_labels: Array) -> tuple[Array, Array]:
    """Weight [K, F] and bias [K], float32, of shrinkage LDA on the features `seen` [N, F], as sure as `held` allows.

    Raises FormatError where there is but one sweep of each material, which says nothing of how they vary.
    """
    if len(labels) <= len(np.unique(labels)):
        raise FormatError(
            f"{len(labels)} sweeps of as many materials are too few for a linear discriminant; record more"
        )
    lda = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(seen, labels)
    weight, bias = lda.coef_, lda.intercept_
    if len(weight) == 1:  # of two classes it gives only the difference
        weight, bias = np.vstack([0 * weight, weight]), np.append(0, bias)
    cooler = temperature(held @ weight.T + bias, held_labels)
    return (weight / cooler).astype(np.float32), (bias / cooler).astype(np.float32)


def temperature(logits: Array, labels: Array) -> float:
    """The divisor of `logits` [N, K] with the best likelihood, each label believed to (N + 1) / (N + 2) as Platt does.

    Without that doubt a few held-out sweeps, all right, would allow any certainty.
    """
    doubt = 1 / (len(labels) + 2)
    costs = []
    for t in TEMPERATURES:
        z = logits / t
        z = z - z.max(axis=1, keepdims=True)
        log_p = z - np.log(np.exp(z).sum(axis=1, keepdims=True))
        costs.append(-np.mean((1 - doubt) * log_p[np.arange(len(labels)), labels] + doubt * log_p.mean(axis=1)))
    return float(TEMPERATURES[np.argmin(costs)])


@dataclass(frozen=True)
class LinearHeadModel:
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


def train_linear_head(
    features: onnx.ModelProto,
    fit: Callable[[Array, Array], tuple[Array, Array]],
    sweeps: Dataset,
    given: Array,
    seed: int,
) -> LinearHeadModel:
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
    return LinearHeadModel(features, whole_weight, whole_bias)


def _centred(coefficients: Array, intercepts: Array) -> tuple[Array, Array]:
    """One row a label, less their mean: the best margin is then never below 0."""
    coefficients, intercepts = np.atleast_2d(coefficients), np.atleast_1d(intercepts)
    if len(coefficients) == 1:  # of two labels scikit-learn gives the second one's margin
        coefficients, intercepts = np.vstack([-coefficients, coefficients]), np.append(-intercepts, intercepts)
    return coefficients - coefficients.mean(0), intercepts - intercepts.mean()
