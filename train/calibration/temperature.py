"""Temperature scaling. In: logits of sweeps that the head did not see, their labels and groups.
Out: a temperature.

The temperature is only as high as these sweeps demand: where they do not show that a head is too
certain, it stays 1, so that scaling makes no calibrated head worse.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.inference.classifier import LEAST_PROBABILITY, softmax
from train.models.linear_head import TEMPERATURES

Array = NDArray[Any]
SLACK = 0.5
"""Standard errors by which the log loss may be above the least. With 0, four of fourteen calibrated
heads were made worse by more than a tenth of a point (simulated, seeds 301 to 316); with 1, heads
that judge four positions stay too sure."""


def fit_temperature(logits: Array, labels: Array, groups: Array) -> float:
    """The least of TEMPERATURES, a divisor of `logits` [n, K], whose log loss on `labels` [n] is
    within SLACK standard errors of the least loss (after the one-standard-error rule; Breiman et
    al. 1984).

    The error is that of a mean over groups [n], whose sweeps are right or wrong together; over
    sweeps where there is one. Platt's correction is not made: logits of a good head are so large
    that its small share of wrong answers would cost more than all others, and the temperature would
    be three times too high.
    """
    if len(np.unique(groups)) < 2:
        groups = np.arange(len(labels))
    member = np.unique(groups, return_inverse=True)[1]
    size = np.bincount(member)
    losses = np.stack([_losses(logits / t, labels) for t in TEMPERATURES])
    best = losses[losses.mean(axis=1).argmin()]
    for temperature, loss in zip(TEMPERATURES, losses, strict=True):
        worse = loss - best
        spread = np.bincount(member, worse) - size * worse.mean()
        error = np.sqrt((spread**2).sum() * len(size) / max(len(size) - 1, 1)) / len(labels)
        if worse.mean() <= SLACK * error:
            return float(temperature)
    raise AssertionError("the best temperature is within an error of itself")


def _losses(logits: Array, labels: Array) -> Array:
    """Log loss [n] of each sweep."""
    p = softmax(logits)[np.arange(len(labels)), labels]
    losses: Array = -np.log(np.maximum(p, LEAST_PROBABILITY))
    return losses
