"""The spectrum that all taxels share: log band powers, as ONNX nodes.

These are fixed features. Training discards features that do not separate the training materials;
it overfits, and its features hardly show that a material is unknown. Here the mean of the taxels
over the grid, for each axis, is cut into tenths of the window. The power in bands of each tenth's
spectrum (Welch 1967) is a feature, as a logarithm. Each tenth is processed by itself, so that
offsets and later frames do not matter; the hum of the mains is removed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

from palpate.core.types import SweepFormat
from palpate_train.models.recipe.architectures import PREFIXES
from palpate_train.onnx_tools.graph_builder import GraphBuilder

Array = NDArray[Any]
SEGMENTS = PREFIXES
"""Number of segments of a window: a box can answer early after each of them."""
BANDS = 24
"""Largest number of bands of a spectrum: their edges are evenly spaced on a logarithmic axis, at
whole half bins."""
QUIET = 1e-4
"""Added to the power of a band before its logarithm, and to a variance, so that a silent skin stays
finite; those of a texture are about 1."""
MIN_SEGMENT = 4
"""Number of frames of the shortest segment that has a spectrum."""


def count(format: SweepFormat) -> int:
    """Number of bands of all axes; 0 if a segment has fewer frames than MIN_SEGMENT."""
    length = format.window // SEGMENTS
    return format.axes * (len(_edges(length)) - 1) if length >= MIN_SEGMENT else 0


def nodes(
    g: GraphBuilder,
    raw: str,
    attenuation: str,
    format: SweepFormat,
    scale: float,
    mains_hz: float,
    prefixes: bool,
) -> str:
    """Raw counts [1, T, M] and the factor of each [1, 1, M], M = R * C * A -> log band powers [1,
    rows, bands], the bands of the first axis first.

    There is one row for the whole window; with `prefixes` one row for each prefix.
    """
    length, axes, taxels = format.window // SEGMENTS, format.axes, format.rows * format.cols
    mean = scale / taxels * (np.tile(np.eye(axes), (taxels, 1)) if axes > 1 else 1)  # [M, A]
    share = g("Mul", g("Reshape", attenuation, [format.channels, 1]), g.constant(mean))
    x = g("MatMul", g("Cast", raw, to=TensorProto.FLOAT), share)
    if format.window % SEGMENTS:
        x = g("Slice", x, [0], [length * SEGMENTS], [1])
    if axes > 1:
        x = g("Transpose", g("Reshape", x, [SEGMENTS, length, axes]), perm=[0, 2, 1])
    x = g("Reshape", x, [SEGMENTS * axes, length])
    x = g("MatMul", x, wave_nodes(g, length, mains(format, mains_hz), length + 1))
    power = g("MatMul", g("Mul", x, x), _averaging_nodes(g, _edges(length)))
    if axes > 1:
        power = g("Reshape", power, [SEGMENTS, count(format)])
    if prefixes:
        power = g(
            "MatMul", g.constant(np.tri(SEGMENTS) / np.arange(1, SEGMENTS + 1)[:, None]), power
        )
    else:
        power = g("ReduceMean", power, axes=[0])
    power = g("Log", g("Add", power, g.constant(QUIET)))
    return g("Reshape", power, [1, SEGMENTS if prefixes else 1, count(format)])


def _edges(length: int) -> Array:
    """Edges [n + 1] of the n bands of a segment of `length` frames, in half bins of its spectrum:
    from 2 to `length`.

    Whole bins, which are as wide as Hann's window, lower the AUROC of unknown materials by .007.
    """
    return np.unique(np.rint(np.geomspace(2, length + 1, BANDS + 1)).astype(int))


def mains(format: SweepFormat, mains_hz: float) -> float:
    """Periods of mains of this frequency per frame; 0 if a segment holds less than two periods, or
    if the hum is too fast to be resolved."""
    periods = mains_hz / format.rate_hz
    return periods if periods * (format.window // SEGMENTS) >= 2 and periods <= 0.25 else 0.0


def _unwanted(length: int, mains: float) -> Array:
    """Orthonormal [length, 1 or 3]: an offset and the mains, to which no wave may respond."""
    phase = 2 * np.pi * mains * np.arange(length)
    basis = np.stack([np.ones(length), np.sin(phase), np.cos(phase)][: 3 if mains else 1], axis=1)
    orthonormal: Array = np.linalg.qr(basis)[0]
    return orthonormal


def _window(length: int) -> Array:
    """Hann's window without its zeros [length, 1], scaled so that white noise has the same power
    for all lengths."""
    window = np.hanning(length + 2)[1:-1, None]
    scaled: Array = window / np.sqrt((window**2).sum())
    return scaled


def wave_nodes(g: GraphBuilder, length: int, mains: float, end: int) -> str:
    """Nodes that compute the waves [length, 2 * (end - 2)] of 2 to `end` - 1 half periods: cosines,
    then sines, tapered and orthogonal to offset and mains. onnxruntime folds them into one constant
    when it loads the model, so that the file does not hold them."""
    n = g("Unsqueeze", g("Range", 0, length, 1), [1])
    k = g("Range", 2, end, 1)
    phase = g("Cast", g("Mod", g("Mul", n, k), 2 * length), to=TensorProto.FLOAT)
    phase = g("Mul", phase, g.constant(np.pi / length))
    waves = g(
        "Mul", g("Concat", g("Cos", phase), g("Sin", phase), axis=1), g.constant(_window(length))
    )
    unwanted = g.constant(_unwanted(length, mains))
    removed = g("MatMul", unwanted, g("MatMul", g("Transpose", unwanted, perm=[1, 0]), waves))
    return g("Sub", waves, removed)


def _averaging_nodes(g: GraphBuilder, edges: Array) -> str:
    """Nodes that compute the matrix that averages squares over each band; folded like the
    nodes of `wave_nodes`."""
    k = g("Range", 2, int(edges[-1]), 1)
    k = g("Unsqueeze", g("Concat", k, k, axis=0), [1])
    below, beyond = (g("Less", k, side) for side in (edges[:-1], edges[1:]))
    inside = g("Cast", g("And", g("Not", below), beyond), to=TensorProto.FLOAT)
    return g("Mul", inside, g.constant(1 / np.diff(edges)))
