"""The room of the spectrum that all taxels share. In: the form of a sweep. Out: band powers, in PyTorch and as nodes.

Fixed features beside those that are learnt. What was trained to tell materials apart folds away what does not help it,
so it hardly sees that a material is none of them, and it knows its training sweeps too well. Here the taxels' mean over
the grid is cut into tenths of the window, and the power in bands of its spectrum taken (Welch 1967), as logarithms. A
tenth is looked at by itself, so no offset and no later frame matters; nor does the hum of the mains.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from onnx import TensorProto
from torch import Tensor

from appliance.core.types import SweepFormat
from train.models.compact.architectures import MAINS_HZ
from train.onnx_tools.graph_builder import GraphBuilder

Array = NDArray[Any]
SEGMENTS = 10
"""Into which a window is cut: the tenths after which a box may decide early."""
BANDS = 24
"""Of a spectrum, at most: their edges lie evenly on a logarithmic axis, as whole half bins."""
QUIET = 1e-4
"""Added to a band's power before its logarithm, where the texture's is about 1: a silent skin stays finite."""
SHORTEST = 4
"""Frames of a tenth that has a spectrum."""


def count(form: SweepFormat) -> int:
    """How many bands there are; 0 where a tenth of the window is less than SHORTEST frames."""
    length = form.window // SEGMENTS
    return len(_edges(length)) - 1 if length >= SHORTEST else 0


def bands(x: Tensor, form: SweepFormat) -> Tensor:
    """Scaled taxels [B, R * C, T] -> log band powers [B, count(form)]."""
    length = form.window // SEGMENTS
    waves, collect = (torch.from_numpy(m) for m in _matrices(length, _mains(form)))
    cut = x.mean(1)[:, : length * SEGMENTS].unflatten(1, (SEGMENTS, length))
    return torch.log(((cut @ waves).square() @ collect).mean(1) + QUIET)


def nodes(g: GraphBuilder, raw: str, turned: str, form: SweepFormat, scale: float, tenths: bool) -> str:
    """Digits [1, T, R * C], and what each taxel is multiplied with [1, 1, R * C], as log band powers [1, rows, bands].

    One row for the whole window; or with `tenths` a row for the first tenth, two tenths ... of it.
    """
    length, taxels = form.window // SEGMENTS, form.rows * form.cols
    share = g("Mul", g("Reshape", turned, g.constant([taxels, 1], "int64")), g.constant(scale / taxels))
    x = g("MatMul", g("Cast", raw, to=TensorProto.FLOAT), share)
    if form.window % SEGMENTS:
        x = g("Slice", x, *(g.constant([n], "int64") for n in (0, length * SEGMENTS, 1)))
    x = g("MatMul", g("Reshape", x, g.constant([SEGMENTS, length], "int64")), _waves(g, length, _mains(form)))
    power = g("MatMul", g("Mul", x, x), _collect(g, _edges(length)))
    if tenths:
        power = g("MatMul", g.constant(np.tri(SEGMENTS) / np.arange(1, SEGMENTS + 1)[:, None]), power)
    else:
        power = g("ReduceMean", power, axes=[0])
    power = g("Log", g("Add", power, g.constant(QUIET)))
    return g("Reshape", power, g.constant([1, SEGMENTS if tenths else 1, len(_edges(length)) - 1], "int64"))


def _edges(length: int) -> Array:
    """Edges [n + 1] of the n bands of a segment of `length` frames, in half bins of its spectrum: from 2 to `length`.

    With whole bins, which lie as far apart as Hann's window is wide, AUROC of unknown materials falls by .007.
    """
    return np.unique(np.rint(np.geomspace(2, length + 1, BANDS + 1)).astype(int))


def _mains(form: SweepFormat) -> float:
    """Periods of the mains from one frame to the next; 0 where a segment holds less than two, or hum is too fast."""
    turns = MAINS_HZ / form.rate_hz
    return turns if turns * (form.window // SEGMENTS) >= 2 and turns <= 0.25 else 0.0


def _unwanted(length: int, mains: float) -> Array:
    """Orthonormal [length, 1 or 3]: what no wave may hear, an offset and the mains."""
    turn = 2 * np.pi * mains * np.arange(length)
    return np.linalg.qr(np.stack([np.ones(length), np.sin(turn), np.cos(turn)][: 3 if mains else 1], axis=1))[0]


def _window(length: int) -> Array:
    """Hann's, without its zeros [length, 1]; what white noise has in a wave is then the same for all lengths."""
    window = np.hanning(length + 2)[1:-1, None]
    return window / np.sqrt((window**2).sum())


@cache
def _matrices(length: int, mains: float) -> tuple[Array, Array]:
    """Waves [length, 2 * half bins] and what makes the mean of each band of their squares, float32."""
    k = np.arange(2, length + 1)
    turn = np.pi / length * (np.arange(length)[:, None] * k % (2 * length))
    waves = np.hstack([np.cos(turn), np.sin(turn)]) * _window(length)
    unwanted, edges = _unwanted(length, mains), _edges(length)
    both = np.tile(k, 2)[:, None]
    collect = ((both >= edges[:-1]) & (both < edges[1:])) / np.diff(edges)
    return (waves - unwanted @ (unwanted.T @ waves)).astype(np.float32), collect.astype(np.float32)


def _waves(g: GraphBuilder, length: int, mains: float) -> str:
    """Nodes that give the waves: onnxruntime folds them into one constant when it loads the model, and the file holds
    none of it."""
    one = g.constant(1, "int64")
    n = g("Unsqueeze", g("Range", g.constant(0, "int64"), g.constant(length, "int64"), one), g.constant([1], "int64"))
    k = g("Range", g.constant(2, "int64"), g.constant(length + 1, "int64"), one)
    turn = g("Cast", g("Mod", g("Mul", n, k), g.constant(2 * length, "int64")), to=TensorProto.FLOAT)
    turn = g("Mul", turn, g.constant(np.pi / length))
    waves = g("Mul", g("Concat", g("Cos", turn), g("Sin", turn), axis=1), g.constant(_window(length)))
    unwanted = _unwanted(length, mains)
    heard = g("MatMul", g.constant(unwanted), g("MatMul", g.constant(unwanted.T), waves))
    return g("Sub", waves, heard)


def _collect(g: GraphBuilder, edges: Array) -> str:
    """Nodes that give what makes the mean of each band of squares; folded as `_waves` is."""
    k = g("Range", *(g.constant(n, "int64") for n in (2, int(edges[-1]), 1)))
    k = g("Unsqueeze", g("Concat", k, k, axis=0), g.constant([1], "int64"))
    below, beyond = (g("Less", k, g.constant(side, "int64")) for side in (edges[:-1], edges[1:]))
    inside = g("Cast", g("And", g("Not", below), beyond), to=TensorProto.FLOAT)
    return g("Mul", inside, g.constant(1 / np.diff(edges)))
