"""The room of deciding early. In: an embedding of each tenth of a sweep. Out: a head for each tenth, and the rule.

The box asks after each tenth of the window; it decides when the last few heads agree and the newest is sure enough. How
sure that must be is found on sweeps that the heads did not see; where these do not support it there is no rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from appliance.bundle.bundle import Early
from train.calibration.novelty import embed_some, parts
from train.models.linear_head import temperature

Array = NDArray[Any]
LEVELS = (0.999, 0.998, 0.995, 0.99, 0.98, 0.97, 0.95, 0.92, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5)
"""Probabilities that a rule may ask for, the strictest first."""
AGREE = (1, 2, 3)
"""How many steps a rule may want to agree."""
ABSENT = -1e4
"""Logit, before cooling, of a label that was not there."""
LOSS = 0.005
"""Share of sweeps that deciding early may turn from right to wrong."""
FEWEST = 40
"""Sweeps that a rule is found on at least."""
WORTH = 0.95
"""Mean share of the sweep above which a rule is not worth having."""


@dataclass(frozen=True)
class Heads:
    """One linear head for each step: logits = z @ weight + bias. weight: float32 [D, r, K]; bias: float32 [D, K]."""

    weight: Array
    bias: Array

    def logits(self, z: Array) -> Array:
        """Embeddings [n, D or more, r] of the window's first parts -> logits [n, D, K]."""
        steps: Array = np.einsum("ndr,drk->ndk", z[:, : len(self.weight)], self.weight) + self.bias
        return steps

    def cooled(self, temperatures: Array) -> Heads:
        """The same, as sure as its [D] temperatures allow."""
        by = np.asarray(temperatures)[:, None]
        return Heads((self.weight / by[..., None]).astype(np.float32), (self.bias / by).astype(np.float32))


@dataclass(frozen=True)
class EarlyRule:
    """What was found. early: for the manifest, None where there is no rule, and `why`. share: mean share of the sweep
    that it needs; lost: share of sweeps that it turns from right to wrong, both where it was found; n: sweeps there."""

    early: Early | None
    why: str = ""
    share: float = 1.0
    lost: float = 0.0
    n: int = 0


def heads(z: Array, labels: Array, classes: int) -> Heads:
    """Heads for all rows but the last of the embeddings z [N, D + 1, r]: shrinkage LDA with equal priors, not cooled.

    A label of which there is no sweep among `labels` gets logits far below all others.
    """
    each = [lda(z[:, d], labels, classes) for d in range(z.shape[1] - 1)]
    return Heads(np.stack([weight for weight, _ in each]), np.stack([bias for _, bias in each]))


def lda(x: Array, labels: Array, classes: int) -> tuple[Array, Array]:
    """Weight [F, K] and bias [K], float32, of shrinkage LDA with equal priors on x [N, F]; see `heads` for labels that
    are not there."""
    there = np.unique(labels)
    weight, bias = np.zeros((x.shape[1], classes), np.float32), np.full(classes, ABSENT, np.float32)
    prior = np.full(len(there), 1 / len(there))
    found = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto", priors=prior).fit(x, labels)
    coefficients, intercepts = found.coef_, found.intercept_
    if len(there) == 2:  # of two it gives only the difference
        coefficients, intercepts = np.vstack([0 * coefficients, coefficients]), np.append(0, intercepts)
    weight[:, there], bias[there] = coefficients.T, intercepts
    return weight, bias


def crossed(tenths: Array, labels: Array, groups: Array, judged: Array, fixed: int = 0) -> tuple[Array, Array]:
    """Logits [n, D + 1, K], not cooled, of each step and the whole, and the numbers [n] of the sweeps they are of.

    tenths: features [N, D + 1, F]. Each sweep of `judged` (bool [N]) is judged by an embedding and heads that did not
    see its group (int [N]); sweeps of a material that is in no other part are left out.
    Raises FormatError as `parts`.
    """
    classes, told, numbers = int(labels.max()) + 1, [], []
    for fit, judges in parts(groups, judged):
        one, there = embed_some(tenths[fit, -1], labels[fit], fixed)
        judges = judges[np.isin(labels[judges], there)]
        steps = heads(one(tenths[fit]), labels[fit], classes).logits(one(tenths[judges]))
        end = np.full((len(judges), 1, classes), ABSENT)
        end[:, 0, there] = one.logits(tenths[judges, -1])
        told.append(np.concatenate([steps, end], axis=1))
        numbers.append(judges)
    return np.concatenate(told), np.concatenate(numbers)


def temperatures(logits: Array, labels: Array) -> Array:
    """One for each step and the whole: logits [n, D + 1, K] that the heads did not see -> [D + 1]."""
    return np.array([temperature(step, labels) for step in logits.swapaxes(0, 1)])


def decide(probabilities: Array, early: Early) -> tuple[Array, Array]:
    """What the box says to sweeps, and when: probabilities [n, D + 1, K] -> labels [n], share of the sweep [n].

    As appliance.early.decides, for many sweeps at once; the last row, the whole window, always decides.
    """
    n, steps, _ = probabilities.shape
    named, sure = probabilities.argmax(2), probabilities.max(2) >= np.append(early.least, 0)
    for back in range(1, early.agree):
        sure[:, :-1] &= np.pad(named[:, :-back] == named[:, back:], ((0, 0), (back, 0)))[:, :-1]
    step = sure.argmax(1)
    return named[np.arange(n), step], (step + 1) / steps


def rule(probabilities: Array, labels: Array) -> EarlyRule:
    """The rule that needs the least of the sweep, found on probabilities [n, D + 1, K] that the heads did not see.

    For each number of steps that must agree, levels are tried from the strictest on, and none after the first that
    turns more than LOSS of the sweeps from right to wrong: a looser one that seems to do better does so by luck (fixed
    sequence testing; Maurer et al. 1995).
    """
    if (n := len(labels)) < FEWEST:
        return EarlyRule(None, f"{n} sweeps were held out, and a rule is found on {FEWEST} at least; record more", n=n)
    right = probabilities[:, -1].argmax(1) == labels
    best = EarlyRule(None, f"no rule needs less than {WORTH:.0%} of the sweep and turns at most {LOSS:.1%} of {n} held-out "
                "sweeps wrong", n=n)  # fmt: skip
    for agree in AGREE:
        for level in LEVELS:
            early = Early((level,) * (probabilities.shape[1] - 1), agree)
            named, share = decide(probabilities, early)
            if (lost := float(np.mean(right & (named != labels)))) > LOSS:
                break
            if share.mean() < min(best.share, WORTH):
                best = EarlyRule(early, "", float(share.mean()), lost, n)
    return best
