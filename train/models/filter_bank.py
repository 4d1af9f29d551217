"""A bank of random filters with a closed-form head, fitted in seconds without PyTorch. In: sweeps. Out: a LinearHeadModel.

Each filter is dilated, spans a random subset of the taxels and sums to zero over time on each of them, so that no offset
of a taxel reaches it. Its response is pooled twice: log of the mean magnitude, share of samples above a quantile.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.preprocessing import StandardScaler

from appliance.core.errors import FormatError
from appliance.core.types import SweepFormat
from train.data.sets import Dataset
from train.models.linear_head import LinearHeadModel, train_linear_head
from train.models.methods import Method
from train.onnx_tools.graph_builder import GraphBuilder, centred, run

Array = NDArray[Any]
FILTERS, TAPS, DILATIONS = 1000, 9, (1, 2, 4, 8, 16)
FLOOR = 0.02
"""Added to a mean magnitude before its logarithm, in standard deviations of the raw counts: a taxel at rest stays finite."""
SAMPLES = 256
"""A filter's stride leaves about this many responses a window: pooling over more does not change what is pooled."""
QUANTILES = (0.1, 0.9)
"""The share of training responses above a filter's threshold is drawn uniformly from this range."""
THRESHOLD_SWEEPS = 200
"""Training sweeps that the thresholds are taken from."""


@dataclass(frozen=True)
class Bank:
    """Random filters for one format. weights: float32 [F, R * C, TAPS], unit norm, zero sum over taps; dilations: int [F]."""

    weights: Array
    dilations: Array


def draw(form: SweepFormat, rng: np.random.Generator, count: int) -> Bank:
    """`count` filters, shared evenly among the dilations that fit into the window.

    Raises FormatError where the window is shorter than a filter.
    """
    fitting = [d for d in DILATIONS if (TAPS - 1) * d < form.window]
    if not fitting:
        raise FormatError(f"a window of {form.window} frames is too short for filter-bank; record at least {TAPS}")
    taxels = form.rows * form.cols
    weights = rng.standard_normal((count, taxels, TAPS))
    sizes = np.floor(np.exp(rng.uniform(0, np.log(taxels + 1), count))).astype(int).clip(1, taxels)
    for filter_weights, size in zip(weights, sizes, strict=True):
        filter_weights[rng.permutation(taxels)[size:]] = 0
    weights -= weights.mean(axis=2, keepdims=True) * (weights != 0).any(axis=2, keepdims=True)
    weights /= np.linalg.norm(weights, axis=(1, 2), keepdims=True)
    return Bank(weights.astype(np.float32), np.resize(np.repeat(fitting, -(-count // len(fitting))), count))


def train(sweeps: Dataset, given: Array, seed: int) -> LinearHeadModel:
    """The bank and shrinkage LDA on `given`, the raw counts [N, T, R, C] of `sweeps`.

    Raises FormatError where the window is shorter than a filter, every taxel of every sweep is constant, or there are
    no more sweeps than materials.
    """
    form, rng = sweeps.require_materials().format, np.random.default_rng(seed)
    if len(sweeps) <= len(np.unique(sweeps.labels)):
        raise FormatError(f"{len(sweeps)} sweeps of as many materials are too few for filter-bank; record more")
    scale = float(np.std(given - given.mean(axis=1, keepdims=True, dtype=np.float64)))
    if not scale > 0:
        raise FormatError("every taxel of every sweep is constant; check the skin, nothing can be learnt from this")
    bank = draw(form, rng, FILTERS)
    some = given[rng.permutation(len(given))[:THRESHOLD_SWEEPS]]
    above = rng.uniform(*QUANTILES, len(bank.weights))
    return train_linear_head(
        features(form, bank, scale, thresholds(form, bank, some, above)), _lda, sweeps, given, seed
    )


def thresholds(form: SweepFormat, bank: Bank, given: Array, above: Array) -> Array:
    """The value that the share `above` [F] of each filter's responses to `given` [n, T, R, C] exceeds: float32 [F]."""
    found = np.empty(len(bank.weights), np.float32)
    for dilation in np.unique(bank.dilations):
        chosen = np.flatnonzero(bank.dilations == dilation)
        g = GraphBuilder()
        response = _responses(g, centred(g, form)[0], form, bank.weights[chosen], int(dilation))
        length = _length(form, int(dilation))
        g("Reshape", response, g.constant([1, len(chosen) * length], "int64"), output="responses")
        seen = run(g.model(form, "responses", len(chosen) * length), given).reshape(len(given), len(chosen), length)
        flat = seen.transpose(1, 0, 2).reshape(len(chosen), -1)
        found[chosen] = [np.quantile(row, 1 - share) for row, share in zip(flat, above[chosen], strict=True)]
    return found


def features(form: SweepFormat, bank: Bank, scale: float, limits: Array) -> onnx.ModelProto:
    """`sweep` -> `features` float32 [1, 2 F]: by dilation the log mean magnitudes, then the shares above `limits`.

    scale: standard deviation of the raw counts about each taxel's mean; limits: of each filter's response, raw counts [F].
    """
    g = GraphBuilder()
    x, parts = centred(g, form)[0], []
    for dilation in np.unique(bank.dilations):
        chosen = bank.dilations == dilation
        response = _responses(g, x, form, bank.weights[chosen], int(dilation))
        size = g("ReduceMean", g("Abs", response), axes=[2], keepdims=0)
        parts.append(g("Log", g("Add", size, g.constant(FLOOR * scale))))
        over = g("Cast", g("Greater", response, g.constant(limits[chosen][:, None])), to=TensorProto.FLOAT)
        parts.append(g("ReduceMean", over, axes=[2], keepdims=0))
    g("Concat", *parts, axis=1, output="features")
    return g.model(form, "features", 2 * len(bank.weights))


def _stride(form: SweepFormat) -> int:
    return max(1, form.window // SAMPLES)


def _length(form: SweepFormat, dilation: int) -> int:
    """Responses of one filter to one window."""
    return (form.window - (TAPS - 1) * dilation - 1) // _stride(form) + 1


def _responses(g: GraphBuilder, x: str, form: SweepFormat, weights: Array, dilation: int) -> str:
    """Raw counts about each taxel's mean [1, R * C, T] -> responses [1, F, n]."""
    return g("Conv", x, g.constant(weights), dilations=[dilation], strides=[_stride(form)])


def _lda(seen: Array, labels: Array) -> tuple[Array, Array]:
    """Coefficients and intercepts of LDA with automatic shrinkage, for features as they are: the scaling is folded in."""
    scaler = StandardScaler()
    lda = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(scaler.fit_transform(seen), labels)
    weight = lda.coef_ / scaler.scale_
    return weight, lda.intercept_ - weight @ scaler.mean_


METHODS = (
    Method(
        "filter-bank",
        "1,000 random zero-sum filters, log mean magnitude and share above a quantile, shrinkage LDA",
        "raw",
        train,
    ),
)
