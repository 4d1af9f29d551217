"""The room of heads. In: a training set, features, logits. Out: what is held out inside it, a linear head, a temperature.

A head stands on features of a sweep and is found in closed form; one temperature, found on groups that were held out,
makes its probabilities honest.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from appliance.core.errors import FormatError
from train.data.sets import LabelledSweeps

Array = NDArray[Any]
HELD_OUT = 0.2
"""Share of the groups that training does not see: they give the temperature and the figures of validation."""
TEMPERATURES = np.geomspace(1, 100, 200)
"""From the LDA's own posteriors, which are never too modest, to hardly sure of anything."""
ABSENT = -30.0
"""Logit of a material that training never saw, where the best of the others is never below 0: its probability is below
1e-12."""


def hold_out(sweeps: LabelledSweeps, seed: int) -> tuple[LabelledSweeps, LabelledSweeps, str]:
    """(to train on, held out, by what): whole positions where there are several and these allow it, else recordings.

    Raises FormatError where the set has too few groups, or one sweep of a material would be all that is left.
    """
    if len(np.unique(sweeps.groups.get("position", 0))) > 1:
        with suppress(FormatError):
            return _parted(sweeps, "position", seed)
    return _parted(sweeps, "recording", seed)


def _parted(sweeps: LabelledSweeps, by: str, seed: int) -> tuple[LabelledSweeps, LabelledSweeps, str]:
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
