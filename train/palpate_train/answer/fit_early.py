"""Early answers: a head for each prefix of the window, and the rule for answering before its end.

The box computes the heads after each tenth of the window. It answers as soon as the last few heads
agree and the newest is certain enough. The required probability is found on sweeps that the heads
did not see; without a sufficient probability the box does not answer early.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from palpate.answer.early import Early
from palpate.answer.unknown import EarlyClasses, EarlyDistances
from palpate.bundle.contents import Bundle
from palpate.bundle.manifest import Manifest
from palpate_train.answer.embedding import JudgingPart, centred, limit
from palpate_train.answer.heads import ABSENT, shrinkage
from palpate_train.answer.rule import Rule
from palpate_train.data.sets import Dataset
from palpate_train.metrics.temperature import sufficient_temperature
from palpate_train.metrics.tolerances import LOST
from palpate_train.onnx_tools.graph_builder import run_output

Array = NDArray[Any]
FIGURES = "early answers"
"""Key of the figures in a manifest."""
STEPS = "early_embedding"
"""Output of a bundle's graph with the embeddings of unfinished sweeps."""
LEVELS = (0.999, 0.998, 0.995, 0.99, 0.98, 0.97, 0.95, 0.92, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5)
"""Probabilities that a rule may require, the strictest first."""
FLAT = 1e-6
"""Least variance of a direction, relative to the mean variance of all directions."""
AGREE = (1, 2, 3)
"""Numbers of successive steps that a rule may require to agree."""
MIN_SWEEPS = 40
"""Smallest number of sweeps to find a rule on."""
KEPT = 0.9
"""Share of known sweeps within the limit of each step. A sweep beyond it is answered later:
before a slide's pattern was asked for, limits of 97 % let 6.1 % of the sweeps that no one can
classify through, limits of 90 % let 3.9 %, and known sweeps needed 0.30 instead of 0.25 of the
window (docs/decisions/0005)."""


@dataclass(frozen=True, eq=False)
class Heads:
    """One linear head for each step: logits = z @ weight + bias. weight: float32 [D, r, K]; bias:
    float32 [D, K]."""

    weight: Array
    bias: Array

    def logits(self, z: Array) -> Array:
        """Embeddings [n, D or more, r] of prefixes of the window -> logits [n, D, K]."""
        steps: Array = np.einsum("ndr,drk->ndk", z[:, : len(self.weight)], self.weight) + self.bias
        return steps

    def cooled(self, temperatures: Array) -> Heads:
        """The same heads, divided by the temperature of each step [D]."""
        by = np.asarray(temperatures)[:, None]
        return Heads(
            (self.weight / by[..., None]).astype(np.float32), (self.bias / by).astype(np.float32)
        )


@dataclass(frozen=True)
class EarlyRule:
    """A rule, with its figures on the sweeps it was found on. early: for the manifest; None if
    there is no rule, with the reason in `why`.

    share: mean share of the window that it needs. lost: share of sweeps whose right answer it turns
    into a wrong one. n: number of sweeps.
    """

    early: Early | None
    why: str = ""
    share: float = 1.0
    lost: float = 0.0
    n: int = 0


def early_classes(z: Array, labels: Array) -> EarlyClasses:
    """Class means and scatter after each step, from embeddings z [N, D, r] of sweeps of all
    materials. The scatter is that of all materials together."""
    classes = int(labels.max()) + 1
    means = np.stack([z[labels == k].mean(axis=0) for k in range(classes)], axis=1)  # [D, K, r]
    away, r = z - means.swapaxes(0, 1)[labels], z.shape[2]
    covariances = np.einsum("ndr,nds->drs", away, away) / len(away)
    spread = np.trace(covariances, axis1=1, axis2=2)[:, None, None] / r
    flat = np.maximum(FLAT * spread, FLAT) * np.eye(r)
    shapes = np.linalg.cholesky(np.linalg.inv(covariances + flat))
    return EarlyClasses(means.astype(np.float32), shapes.astype(np.float16))


def early_limits(classes: EarlyClasses, z: Array, kept: float = KEPT) -> tuple[float, ...]:
    """The limits of each step that keep KEPT of sweeps of known materials, or `kept` if that is
    less, from embeddings z [n, D, r] of sweeps that `classes` have not seen."""
    distances = EarlyDistances(classes, (0.0,) * z.shape[1])
    nearest = np.stack([distances.nearest(sweep) for sweep in z])
    return tuple(limit(step, min(kept, KEPT)) for step in nearest.T)


def heads(z: Array, labels: Array, classes: int) -> Heads:
    """Heads for all prefixes but the last, from embeddings z [N, D + 1, r]: shrinkage LDA with
    equal priors, at temperature 1.

    A label without a sweep gets logits far below all others.
    """
    steps = z.shape[1] - 1
    made = Heads(
        np.empty((steps, z.shape[2], classes), np.float32), np.empty((steps, classes), np.float32)
    )
    for d in range(steps):
        made.weight[d], made.bias[d] = lda(z[:, d], labels, classes)
    return made


def lda(x: Array, labels: Array, classes: int) -> tuple[Array, Array]:
    """Weight [F, K] and bias [K], float32, of shrinkage LDA with equal priors on x [N, F]; labels
    without a sweep as in `heads`."""
    present = np.unique(labels)
    weight, bias = np.zeros((x.shape[1], classes), np.float32), np.full(classes, ABSENT, np.float32)
    own = [x[labels == label] for label in present]
    means = np.stack([sweeps.mean(axis=0) for sweeps in own])
    covariance = np.mean([_covariance(sweeps) for sweeps in own], axis=0)
    from scipy import linalg

    coefficients = linalg.lstsq(covariance, means.T)[0].T
    intercepts = -0.5 * (means * coefficients).sum(axis=1) - np.log(len(present))
    if len(present) == 2:  # only the difference counts
        coefficients[1] -= coefficients[0]
        intercepts[1] -= intercepts[0]
        coefficients[0], intercepts[0] = 0, 0
    weight[:, present], bias[present] = coefficients.T, intercepts
    return weight, bias


def _covariance(x: Array) -> Array:
    """Ledoit and Wolf's covariance [F, F] of the sweeps of one material [n, F], shrunk at the same
    spread of all features."""
    away, spread = centred(x)
    z = away / spread
    share, mean = shrinkage(z, z.T @ z)
    correlation = (1 - share) / len(z) * (z.T @ z) + share * mean * np.eye(z.shape[1])
    covariance: Array = correlation * np.outer(spread, spread)
    return covariance


def cross_fitted_logits(
    tenths: Array, labels: Array, parts: Iterable[JudgingPart]
) -> tuple[Array, Array]:
    """Logits [n, D + 1, K] of each prefix and the whole window at temperature 1, and the numbers
    [n] of their sweeps.

    tenths: features [N, D + 1, F]. Each sweep is judged by the embedding of its part, see
    embedding.cross_fitted, and by heads of the sweeps that this was fitted to.
    """
    classes, logits, numbers = int(labels.max()) + 1, [], []
    for fit, judges, embedding, present in parts:
        z = embedding(tenths)
        steps = heads(z[fit], labels[fit], classes).logits(z[judges])
        whole = np.full((len(judges), 1, classes), ABSENT)
        whole[:, 0, present] = embedding.logits(tenths[judges, -1])
        logits.append(np.concatenate([steps, whole], axis=1))
        numbers.append(judges)
    return np.concatenate(logits), np.concatenate(numbers)


def fit_temperatures(logits: Array, labels: Array, groups: Array) -> Array:
    """A temperature [D + 1] for each prefix and the whole window, from logits [n, D + 1, K] of
    sweeps that the heads did not see."""
    return np.array(
        [sufficient_temperature(step, labels, groups) for step in logits.swapaxes(0, 1)]
    )


def decide(probabilities: Array, early: Early) -> tuple[Array, Array]:
    """The answers of the box and their times: probabilities [n, D + 1, K] -> labels [n], share of
    the window [n].

    It decides as the appliance's inference.classifier does, for many sweeps at once. The last
    row, the whole window, always decides.
    """
    n, steps, _ = probabilities.shape
    label, certain = probabilities.argmax(2), probabilities.max(2) >= np.append(early.least, 0)
    for back in range(1, early.agree):
        certain[:, :-1] &= np.pad(label[:, :-back] == label[:, back:], ((0, 0), (back, 0)))[:, :-1]
    step = certain.argmax(1)
    return label[np.arange(n), step], (step + 1) / steps


def find_rule(probabilities: Array, labels: Array) -> EarlyRule:
    """The rule that needs the smallest share of the window, found on probabilities [n, D + 1, K] of
    sweeps that the heads did not see.

    For each number of steps that must agree, levels are tried from the strictest on, until one
    turns more than LOST of the sweeps from right to wrong. A looser level that seems to do
    better after that does so by chance (fixed sequence testing; Maurer et al. 1995).
    """
    if probabilities.shape[1] == 1:
        return EarlyRule(None, "no beginnings of sweeps were looked at", n=len(labels))
    if (n := len(labels)) < MIN_SWEEPS:
        return EarlyRule(
            None,
            f"{n} sweeps were held out, and a rule needs at least {MIN_SWEEPS}; record more",
            n=n,
        )
    right = probabilities[:, -1].argmax(1) == labels
    best = EarlyRule(
        None,
        f"no rule answers before the end and turns at most {LOST:.1%} of {n} held-out sweeps wrong",
        n=n,
    )
    for agree in AGREE:
        for level in LEVELS:
            early = Early((level,) * (probabilities.shape[1] - 1), agree)
            label, share = decide(probabilities, early)
            if (lost := float(np.mean(right & (label != labels)))) > LOST:
                break
            if share.mean() < best.share:
                best = EarlyRule(early, "", float(share.mean()), lost, n)
    return best


def no_limits(held_out: int) -> str | None:
    """The reason against limits of known materials at each step, None for enough held-out sweeps.
    Without these limits the box would answer early to anything."""
    if held_out >= MIN_SWEEPS:
        return None
    return f"{held_out} sweeps were held out, and its limits need {MIN_SWEEPS}; record more"


def measure(
    model: onnx.ModelProto, train: Dataset, held_out: Dataset, kept: float
) -> tuple[EarlyClasses, tuple[float, ...]]:
    """The classes of unfinished sweeps and the limit of each step, from the output STEPS of
    `model`. The limits are found on held-out sweeps. kept: share of known whole sweeps within
    their limit; that of unfinished ones is not larger."""
    classes = early_classes(run_output(model, STEPS, train.samples), train.labels)
    return classes, early_limits(classes, run_output(model, STEPS, held_out.samples), kept)


def text(manifest: Manifest) -> str:
    """What early answers need and cost, in words; "" without early answers."""
    if manifest.early is None:
        return ""
    if not manifest.early.limits:
        return "early answers: unknown materials are not detected before the end of a sweep"
    steps = f"early answers: only of known materials, at each of {len(manifest.early.limits)} steps"
    if not (found := manifest.figures.get(FIGURES)):
        return steps
    named, junk = found["junk"]
    return (
        f"{steps}; held-out sweeps need {found['share']:.0%} of the window, "
        f"{manifest.made['early']['lost']:.1%} of them lose the right label, and {named} of {junk} "
        "windows without a slide over one material get one"
    )


def without(bundle: Bundle) -> Bundle:
    """The bundle that answers whole sweeps only."""
    classes = bundle.classes and replace(bundle.classes, early=None)
    return replace(bundle, manifest=replace(bundle.manifest, early=None), classes=classes)


RULES = {"early": Rule("early answers", without, tried=False)}
