"""Temperature scaling: the divisor of logits that makes their softmax a calibrated probability.

All functions take logits [n, K] of sweeps that the head did not see, with their labels [n], and
return a temperature. They differ in how they treat the little that held-out sweeps can show:

- `platt_temperature`: the most likely temperature, with Platt's correction. For a head that is
  judged by few held-out sweeps: all may be right, which would otherwise allow any confidence.
- `weighted_platt_temperature`: the same with a weight for each sweep, continuous and in both
  directions. For comparing candidates, whose logits have no natural size.
- `sufficient_temperature`: the lowest temperature that held-out sweeps do not contradict. For heads
  in a bundle: it never makes a calibrated head less confident, and an underconfident one more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.status import LEAST_PROBABILITY

Array = NDArray[Any]
TEMPERATURES = np.geomspace(1, 100, 200)
"""Candidates of `platt_temperature` and `sufficient_temperature`. Posteriors of LDA (temperature 1)
are seldom underconfident; at 100 they are almost uniform."""
LEAST, FINE = 0.05, 1.02
"""Least temperature of underconfident logits, about, and the steps towards it."""
STEP, PRECISION = 0.5, 1e-5
COARSE: list[float] = np.arange(4, -6 - STEP, -STEP).tolist()
"""Logarithms of temperatures that `weighted_platt_temperature` compares first, because very sure
logits have several minima, the highest of equal ones; and the precision of the result."""
SLACK = 0.5
"""Standard errors by which the log loss of `sufficient_temperature` may exceed the smallest loss.
With 0, four of fourteen calibrated heads got worse by more than 0.1 percentage points (simulated,
seeds 301 to 316). With 1, heads judged by four positions stay overconfident."""
SHY = 2.5
"""Standard errors by which the largest probabilities may on average be below the share of right
labels."""
MOST_LOSS = -np.log(LEAST_PROBABILITY)
"""Largest loss of a sweep: one absurd sweep does not decide."""


def platt_temperature(logits: Array, labels: Array) -> float:
    """The element of TEMPERATURES with the highest likelihood of `labels`.

    Each label counts as right with probability (n + 1) / (n + 2) (Platt 1999). Without this
    correction a few held-out sweeps, all right, would allow any confidence.
    """
    wrong, log_p = 1 / (len(labels) + 2), _cooled(logits)
    costs = []
    for t in TEMPERATURES:
        p = log_p(t)
        right = p[labels, np.arange(len(labels))]
        costs.append(-np.mean((1 - wrong) * right + wrong * p.mean(axis=0)))
    return float(TEMPERATURES[np.argmin(costs)])


def weighted_platt_temperature(logits: Array, labels: Array, weights: Array) -> float:
    """The temperature with the lowest cross entropy, with Platt's correction as above and the
    `weights` [n] of the sweeps, which sum to 1. It may be below 1."""
    wrong, log_p = 1 / (len(labels) + 2), _cooled(logits)

    def cost(log_temperature: float) -> float:
        p = np.maximum(log_p(np.exp(log_temperature)), -MOST_LOSS)
        right = p[labels, np.arange(len(labels))]
        return float(-weights @ ((1 - wrong) * right + wrong * p.mean(axis=0)))

    best = COARSE[int(np.argmin([cost(t) for t in COARSE]))]
    low, high = best - STEP, best + STEP
    while high - low > PRECISION:
        middle = (low + high) / 2
        falls = cost(middle + PRECISION) <= cost(middle)
        low, high = (middle, high) if falls else (low, middle)
    return float(np.exp(middle))


def sufficient_temperature(logits: Array, labels: Array, groups: Array) -> float:
    """The lowest of TEMPERATURES whose log loss is within SLACK standard errors of the smallest
    loss, after the rule of one standard error (Breiman et al. 1984); or a lower one, as long as the
    largest probabilities are on average below the share of right labels by more than that. A few
    sweeps that are very wrong cost more log loss than many that are right save, the more the more
    materials there are; and a discriminant that expects new values of a condition is not sure.

    The standard error is that of a mean over `groups` [n], because sweeps of a group are right or
    wrong together; with a single group it is that of a mean over sweeps. Platt's correction is left
    out of the loss: the logits of a good head are so large that its assumed share of wrong labels
    would outweigh all sweeps, and the temperature would be three times too high.
    """
    if len(np.unique(groups)) < 2:
        groups = np.arange(len(labels))
    member = np.unique(groups, return_inverse=True)[1]
    size = np.bincount(member)

    def within(excess: Array, errors: float = SLACK) -> bool:
        spread = np.bincount(member, excess) - size * excess.mean()
        error = np.sqrt((spread**2).sum() * len(size) / max(len(size) - 1, 1)) / len(labels)
        return bool(excess.mean() <= errors * error)

    log_p, numbers = _cooled(logits), np.arange(len(labels))
    losses = np.stack([np.minimum(-log_p(t)[labels, numbers], MOST_LOSS) for t in TEMPERATURES])
    best = losses[losses.mean(axis=1).argmin()]
    found = TEMPERATURES[[within(loss - best) for loss in losses].index(True)]
    lower, right = False, (logits.argmax(axis=1) == labels) * (1 - 1 / (len(labels) + 2))

    def shy(errors: float) -> bool:
        return not within(right - np.exp(log_p(found).max(axis=0)), errors)

    while shy(SLACK if lower else SHY) and found > LEAST:
        found, lower = found / FINE, True
    return float(found)


def _cooled(logits: Array) -> Callable[[float], Array]:
    """Gives the log probabilities [K, n] at a temperature. Sums over the few materials are five
    times as fast along the first axis."""
    away = np.ascontiguousarray((logits - logits.max(axis=1, keepdims=True)).T, np.float64)

    def log_p(temperature: float) -> Array:
        z = away / temperature
        found: Array = z - np.log(np.exp(z).sum(axis=0))
        return found

    return log_p
