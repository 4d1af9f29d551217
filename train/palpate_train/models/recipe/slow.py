"""Slow waves of each taxel: log powers of the lowest lines of the window's transform, and of low
bands of its tenths.

A filter spans a part of the window, and the spectrum averages taxels. A wave as long as the window,
or a wave that few taxels of a large skin feel, is in neither. The lines are of the whole window
without a taper, which would hide the slowest; the bands are of each tenth, as in spectrum.py.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import SweepFormat
from palpate_train.models.recipe import relations, spectrum
from palpate_train.models.recipe.architectures import PREFIXES
from palpate_train.onnx_tools import graph_builder
from palpate_train.onnx_tools.graph_builder import FLOAT, GraphBuilder

Array = NDArray[np.int64]
LINES, BANDS = 16, 10
"""Number of the lowest lines, and of the bands that their powers are averaged in."""
HALF_LINES, TENTH_BANDS = 32, 12
"""The same of each tenth, whose lines are half a line apart."""
MIN_WINDOW = 4 * PREFIXES
"""Number of frames of the shortest window that has slow waves."""


def count(format: SweepFormat) -> int:
    """Number of features; 0 if the window has fewer frames than MIN_WINDOW."""
    if format.window < MIN_WINDOW:
        return 0
    length = format.window // PREFIXES
    bands = len(_edges(length * PREFIXES)) + len(_tenth_edges(length)) - 2
    return len(relations.cells(format)) * bands


def nodes(
    g: GraphBuilder,
    raw: str,
    attenuation: str,
    format: SweepFormat,
    scale: float,
    mains_hz: float,
    prefixes: bool,
) -> str:
    """Raw counts [1, T, M] and the factor of each [1, 1, M], M = R * C * A -> [1, 1 or PREFIXES,
    count(format)]. Of large skins each cell of relations.py is one taxel."""
    length = format.window // PREFIXES
    x = relations.celled(g, raw, attenuation, format, scale)
    x = g("Slice", x, [0], [length * PREFIXES], [1])
    size = len(relations.cells(format))
    x = g("Reshape", x, [PREFIXES, length, size])
    x = g("Transpose", x, perm=[0, 2, 1])
    parts = [_lines(g, x, length, size, prefixes)]
    parts.append(_tenths(g, x, length, size, spectrum.mains(format, mains_hz), prefixes))
    return graph_builder.side_by_side(g, parts)


def _lines(g: GraphBuilder, x: str, length: int, size: int, prefixes: bool) -> str:
    """[PREFIXES, k, length] -> log powers [1, rows, k * bands] of the lowest lines. The mean of a
    prefix is subtracted; the lines of a whole window do not respond to it."""
    frames, edges = length * PREFIXES, _edges(length * PREFIXES)
    n = g("Range", 0, frames, 1)
    n = g("Unsqueeze", n, [1])
    turn = g("Mod", g("Mul", n, np.arange(1, edges[-1])), frames)
    phase = g("Mul", g("Cast", turn, to=FLOAT), g.constant(2 * np.pi / frames))
    waves = g("Concat", g("Cos", phase), g("Sin", phase), axis=1)
    width = 2 * (int(edges[-1]) - 1)
    waves = g("Reshape", waves, [PREFIXES, length, width])
    each = g("Reshape", g("MatMul", x, waves), [PREFIXES, size * width])
    rows = PREFIXES if prefixes else 1
    upto = np.tri(PREFIXES) if prefixes else np.ones((1, PREFIXES))
    known = upto.sum(axis=1, keepdims=True) * length
    found = g("Reshape", g("MatMul", g.constant(upto), each), [rows, size, width])
    if prefixes:
        total = g("ReduceSum", x, [2], keepdims=0)
        mean = g("MatMul", g.constant(upto / known), total)
        responses = g("MatMul", g.constant(upto), g("ReduceSum", waves, [1], keepdims=0))
        offset = g("Mul", g("Unsqueeze", mean, [2]), g("Unsqueeze", responses, [1]))
        found = g("Sub", found, offset)
    power = g("MatMul", g("Mul", found, found), g.constant(_averages(edges, 1)))
    return _log(
        g, g("Mul", power, g.constant(1 / known[:, :, None])), rows, size * (len(edges) - 1)
    )


def _tenths(g: GraphBuilder, x: str, length: int, size: int, mains: float, prefixes: bool) -> str:
    """[PREFIXES, k, length] -> log powers [1, rows, k * bands] of low bands, over all tenths."""
    edges = _tenth_edges(length)
    found = g("MatMul", x, spectrum.wave_nodes(g, length, mains, int(edges[-1])))
    power = g("MatMul", g("Mul", found, found), g.constant(_averages(edges, 2)))
    width = size * (len(edges) - 1)
    power = g("Reshape", power, [PREFIXES, width])
    rows = PREFIXES if prefixes else 1
    upto = np.tri(PREFIXES) if prefixes else np.ones((1, PREFIXES))
    power = g("MatMul", g.constant(upto / upto.sum(axis=1, keepdims=True)), power)
    return _log(g, power, rows, width)


def _log(g: GraphBuilder, power: str, rows: int, width: int) -> str:
    power = g("Log", g("Add", power, g.constant(spectrum.QUIET)))
    return g("Reshape", power, [1, rows, width])


def _edges(frames: int) -> Array:
    """Edges of the bands of the lowest lines of `frames`."""
    last = min(LINES, frames // 2) + 1
    return np.unique(np.rint(np.geomspace(1, last, BANDS + 1)).astype(int))


def _tenth_edges(length: int) -> Array:
    """Edges of the bands of a tenth of `length` frames, in half lines."""
    last = min(HALF_LINES, length) + 1
    return np.unique(np.rint(np.geomspace(2, last, TENTH_BANDS + 1)).astype(int))


def _averages(edges: Array, first: int) -> NDArray[np.float64]:
    """A matrix [2 * lines, bands] that averages squares of cosines and sines over each band."""
    k = np.arange(first, edges[-1])[:, None]
    inside = ((k >= edges[:-1]) & (k < edges[1:])) / np.diff(edges)
    return np.vstack([inside, inside])
