"""MiniRocket, the usual alternative for time series: the METHOD minirocket, aeon's transform and
ridge.

aeon fits the transform. Its parameters are written as a graph, which runs on the box and to which
the head is fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto
from sklearn.linear_model import RidgeClassifierCV
from sklearn.preprocessing import StandardScaler

from palpate.core.errors import FormatError
from palpate.core.types import SweepFormat
from palpate_studies.peers.aeon_peers import series, undisturbed
from palpate_studies.peers.linear_head import train_linear_head
from palpate_train.data.sets import Dataset
from palpate_train.models.methods import Method
from palpate_train.onnx_tools.graph_builder import GraphBuilder, GraphModel

Array = NDArray[Any]
LENGTH, KERNELS = 9, np.array(list(combinations(range(9), 3)))
"""Length of a kernel, and the 84 kernels: for each, the three of nine taps that are 2; the others
are -1 (Dempster et al., sec. 3.1)."""
FEATURES = 10_000
"""The default of aeon and of Dempster et al.; rounded down to a multiple of 84."""
ALPHAS = np.logspace(-3, 3, 10)
"""Ridge penalties that leave-one-out selects from, as in aeon's MiniRocketClassifier and the
authors' code."""


def train(sweeps: Dataset, inputs: Array, seed: int) -> GraphModel:
    """MiniRocket and ridge on `inputs`, the raw counts [N, T, R, C] of `sweeps`.

    Raises FormatError if aeon is missing, if a window is shorter than a kernel, or if `sweeps` are
    too few.
    """
    return train_linear_head(
        transform(sweeps.require_materials().format, fitted(inputs, seed)),
        _ridge,
        sweeps,
        inputs,
        seed,
    )


def fitted(inputs: Array, seed: int) -> tuple[Array, ...]:
    """aeon's parameters of the transform, fitted to raw counts [N, T, R, C]; `transform` describes
    them.

    numpy's global random state, which aeon seeds, is restored. Raises FormatError as `train`.
    """
    if inputs.shape[1] < LENGTH:
        raise FormatError(
            f"a window of {inputs.shape[1]} frames is too short for minirocket; record at least "
            f"{LENGTH}"
        )
    try:
        from aeon.transformations.collection.convolution_based import MiniRocket
    except ImportError as e:
        raise FormatError(
            f"minirocket needs aeon ({e}); try pip install 'palpate-train[peers]'"
        ) from e
    with undisturbed():
        own = MiniRocket(FEATURES, n_jobs=1, random_state=seed).fit(series(inputs))
    found: tuple[Array, ...] = own.parameters
    return found


def in_aeon(sweeps: Dataset, seed: int) -> Callable[[Array], Array]:
    """aeon's own transform and a head on it, fitted to `sweeps`, for timing: raw counts [T, R, C]
    -> margins [K]."""
    from aeon.transformations.collection.convolution_based import MiniRocket

    own = MiniRocket(FEATURES, n_jobs=1, random_state=seed)
    with undisturbed():
        weight, bias = _ridge(own.fit_transform(series(sweeps.samples)), sweeps.labels)
    return lambda counts: weight @ own.transform(series(counts[None]))[0] + bias


def transform(format: SweepFormat, parameters: tuple[Array, ...]) -> onnx.ModelProto:
    """The fitted transform as a graph: `sweep` -> `features` float32 [1, F], each the share of
    frames above a bias.

    parameters: for each dilation and kernel the number of taxels; those taxels one after another;
    the dilations [D]; the number of biases of each kernel per dilation [D]; the biases [F] by
    dilation and kernel, in the order of the features. If dilation number plus kernel number is
    even, the window is padded with zeros; else the kernel stays within it.
    """
    counts, taxels, dilations, per_kernel, biases = parameters
    g, size, at = GraphBuilder(), format.channels, 0
    chosen = iter(np.split(taxels, np.cumsum(counts)[:-1]))
    x = g("Cast", g("Reshape", "sweep", [1, format.window, size]), to=TensorProto.FLOAT)
    x, parts = g("Transpose", x, perm=[0, 2, 1]), []
    for number, (dilation, n) in enumerate(
        zip(dilations.tolist(), per_kernel.tolist(), strict=True)
    ):
        weights = np.zeros((len(KERNELS), size, LENGTH))
        for weight, kernel in zip(weights, KERNELS, strict=True):
            weight[next(chosen)] = np.where(np.isin(np.arange(LENGTH), kernel), 2, -1)
        bias = biases[at : at + n * len(KERNELS)].reshape(len(KERNELS), 1, n, 1)
        at, halves = at + bias.size, []
        for half in (0, 1):
            padding = 0 if (number + half) % 2 else LENGTH // 2 * dilation
            y = g(
                "Conv",
                x,
                g.constant(weights[half::2]),
                dilations=[dilation],
                pads=[padding, padding],
            )
            above = g("Greater", g("Unsqueeze", y, [2, 3]), g.constant(bias[half::2]))
            halves.append(
                g("ReduceMean", g("Cast", above, to=TensorProto.FLOAT), axes=[4], keepdims=0)
            )
        parts.append(g("Flatten", g("Concat", *halves, axis=2)))
    g("Concat", *parts, axis=1, output="features")
    return g.model(format, "features", len(biases))


def _ridge(features: Array, labels: Array) -> tuple[Array, Array]:
    """Coefficients and intercepts of the ridge for unscaled features: the scaling is folded in."""
    scaler, ridge = StandardScaler(with_mean=False), RidgeClassifierCV(ALPHAS)
    ridge.fit(scaler.fit_transform(features), labels)
    return ridge.coef_ / scaler.scale_, ridge.intercept_


METHODS = (
    Method(
        "minirocket", "MiniRocket of aeon + ridge (Dempster et al. 2021)", "raw", train, "peers"
    ),
)
