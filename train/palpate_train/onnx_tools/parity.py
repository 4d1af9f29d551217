"""Compares the float and the int8 precision of a model on labelled sweeps: how much the answers
differ, and how much accuracy is lost, with its interval. Graphs run as on the box."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate_train.metrics.score import widen
from palpate_train.onnx_tools.graph_builder import run_output

Array = NDArray[Any]
Z95 = 1.96


@dataclass(frozen=True)
class AnswerDifference:
    """Differences between the answers of int8 and float.

    agreement: share of equal labels. Probability and logit: the largest difference over the labels
    of each sweep; maximum and mean of it over sweeps. Each sweep's mean is subtracted from its
    logits first, which changes no answer. expected_loss: the loss of accuracy by float's own
    probabilities. For a sweep with different labels, it is the probability of float's label minus
    the probability of int8's label. If probabilities are calibrated, it equals the mean loss in
    counts of right answers, with far less variance.
    """

    agreement: float
    expected_loss: float
    probability_difference: float
    probability_mean: float
    logit_difference: float
    logit_mean: float


@dataclass(frozen=True)
class AccuracyLoss:
    """Accuracy of both precisions, as counts of `total` sweeps. lost: float's share minus int8's;
    low, high: its 95 % interval.

    chance: if both were equally good, the probability that int8 loses at least as many of the
    sweeps on which they differ.
    """

    total: int
    float_right: int
    int8_right: int
    lost: float
    low: float
    high: float
    chance: float


def measure(
    int8: onnx.ModelProto,
    reference: onnx.ModelProto,
    inputs: Array,
    labels: Array,
    clusters: Array | None = None,
) -> tuple[AnswerDifference, AccuracyLoss]:
    """Compare `int8` with the float model `reference` on `inputs` of sweeps with `labels` [n].
    clusters: int [n]; sweeps of a cluster succeed or fail together."""
    precise, rounded = logits(reference, inputs), logits(int8, inputs)
    lost = loss(precise.argmax(1) == labels, rounded.argmax(1) == labels, clusters)
    return compare(precise, rounded), lost


def logits(model: onnx.ModelProto, inputs: Array) -> Array:
    """The output `logits` for each of `inputs`, float32 [n, K], in the same kind of session as on
    the box."""
    return run_output(model, "logits", inputs)


def compare(float_logits: Array, int8_logits: Array) -> AnswerDifference:
    """Compare the logits [n, K] of both precisions for the same sweeps."""
    p, q = softmax(float_logits), softmax(int8_logits)
    label, other = float_logits.argmax(1, keepdims=True), int8_logits.argmax(1, keepdims=True)
    given_away = np.take_along_axis(p, label, 1) - np.take_along_axis(p, other, 1)
    moved = np.abs(p - q).max(1)
    centred = [x - x.mean(1, keepdims=True) for x in (float_logits, int8_logits)]
    z = np.abs(centred[0] - centred[1]).max(1)
    figures = (
        np.mean(label == other),
        given_away.mean(),
        moved.max(),
        moved.mean(),
        z.max(),
        z.mean(),
    )
    return AnswerDifference(*(float(x) for x in figures))


def loss(float_right: Array, int8_right: Array, clusters: Array | None = None) -> AccuracyLoss:
    """The loss of accuracy; booleans [n] say which answers to the same sweeps are right.

    The interval of the difference of matched proportions is that of Agresti and Min (Statistics in
    Medicine 24, 2005). It adds a half to each of the four counts, and so is valid even if both
    precisions always agree. With `clusters` it is extended to the interval of the cluster bootstrap
    (see score.interval).
    """
    difference = float_right.astype(float) - int8_right
    fewer, more = int((difference > 0).sum()), int((difference < 0).sum())
    n, worse, better = len(difference), fewer + 0.5, more + 0.5
    chance = sum(comb(fewer + more, k) for k in range(fewer, fewer + more + 1)) / 2 ** (
        fewer + more
    )
    middle = (worse - better) / (n + 2)
    reach = Z95 * np.sqrt(((worse + better) / (n + 2) - middle**2) / (n + 2))
    low, high = widen((middle - reach, middle + reach), difference, clusters)
    lost, low, high = float(difference.mean()), float(max(low, -1)), float(min(high, 1))
    return AccuracyLoss(n, int(float_right.sum()), int(int8_right.sum()), lost, low, high, chance)
