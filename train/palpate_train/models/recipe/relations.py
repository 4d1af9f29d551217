"""How taxels move together: log deviations and correlations of taxels, over several lags.

Filters, distribution and spectrum look at magnitudes. How strongly two taxels move together, and
with which sign, tells textures apart where force, speed or direction of the slide are new: both
taxels change alike, so that their correlation stays. Correlations are made normal by arctanh
(Fisher 1915); deviations are logarithms. Such features in closed form come from brain signals
(Barachant et al. 2012), without the eigenvalues that are used there.

A correlation dies with a taxel and moves with a row of the skin. Therefore relations are only used
where held-out groups show that they help.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import SweepFormat
from palpate_train.models.recipe.architectures import PREFIXES
from palpate_train.models.recipe.spectrum import QUIET
from palpate_train.onnx_tools import graph_builder
from palpate_train.onnx_tools.graph_builder import FLOAT, GraphBuilder

Array = NDArray[np.int64]
LAGS = (1, 2, 4, 8, 16, 32)
"""Frames over which differences are taken, besides the signal itself."""
SHORT = 3
"""Number of the shortest scales: the signal and its differences over one and two frames. These few
carry over best to a new speed, all scales to a new force or direction."""
MOST_CHANNELS = 24
"""Larger skins are divided into cells, whose taxels are averaged: pairs grow with the square."""
MOST_FRAMES = 750
"""Of longer windows every second frame is used, or fewer."""
NEARLY_ONE = 0.99
"""Factor of a correlation before arctanh, so that equal taxels stay finite."""


def scales(format: SweepFormat) -> int:
    """Number of scales: the signal itself and lags up to a quarter of the window. 0 if there is
    only one channel, or if the window has fewer frames than early answers."""
    if len(cells(format)) < 2 or format.window < PREFIXES:
        return 0
    return 1 + sum(lag <= format.window // 4 for lag in LAGS)


def each(format: SweepFormat) -> int:
    """Number of features of one scale: a deviation for each channel, a correlation for each
    pair."""
    size = len(cells(format))
    return size + size * (size - 1) // 2


def nodes(
    g: GraphBuilder,
    raw: str,
    attenuation: str,
    format: SweepFormat,
    scale: float,
    used: int,
    prefixes: bool,
) -> str:
    """Raw counts [1, T, M] and the factor of each [1, 1, M], M = R * C * A -> [1, 1 or PREFIXES,
    used * each(format)], of the first `used` scales."""
    rows = PREFIXES if prefixes else 1
    length = format.window // PREFIXES
    hop = _hop(length, format.window)
    x = celled(g, raw, attenuation, format, scale)
    size, steps = len(cells(format)), length * PREFIXES // hop
    changes = _changes(g, x, length * PREFIXES, hop, size, used)
    parts = g("Reshape", changes, [used, rows, steps // rows, size])
    squares = g("MatMul", g("Transpose", parts, perm=[0, 1, 3, 2]), parts)
    squares = g("Reshape", squares, [used, rows, size * size])
    totals = g("Reshape", g("ReduceMean", parts, axes=[2]), [used, rows, size])
    # a prefix has the sums of all tenths up to its end
    upto = np.tril(np.ones((rows, rows))) / np.arange(1, rows + 1)[:, None]
    squares = g("MatMul", g.constant(upto * rows / steps), squares)
    means = g("MatMul", g.constant(upto), totals)
    features = _relations(g, squares, means, size)
    features = g("Transpose", features, perm=[1, 0, 2])
    return g("Reshape", features, [1, rows, used * each(format)])


def celled(g: GraphBuilder, raw: str, attenuation: str, format: SweepFormat, scale: float) -> str:
    """Raw counts [1, T, M] and the factor of each [1, 1, M] -> scaled counts [1, T, k], averaged
    over each of `cells`."""
    x = g("Mul", g("Cast", raw, to=FLOAT), g("Mul", attenuation, g.constant(scale)))
    belongs = cells(format)
    if len(belongs) < belongs.shape[1]:
        x = g("MatMul", x, g.constant(belongs.T / belongs.sum(axis=1)))
    return x


def _relations(g: GraphBuilder, squares: str, means: str, size: int) -> str:
    """Mean products [n, rows, size * size] and means [n, rows, size] -> log deviations and
    correlations [n, rows, size + pairs]."""

    def at(x: str, numbers: Array) -> str:
        return g("Gather", x, numbers, axis=2)

    first, second = np.triu_indices(size, 1)
    same = np.arange(size)
    variance = g("Sub", at(squares, same * (size + 1)), g("Mul", means, means))
    variance = g("Max", variance, g.constant(0))
    deviation = g("Sqrt", g("Add", variance, g.constant(QUIET)))
    together = g("Mul", at(means, first), at(means, second))
    together = g("Sub", at(squares, first * size + second), together)
    both = g("Mul", at(deviation, first), at(deviation, second))
    limit = g.constant(-NEARLY_ONE), g.constant(NEARLY_ONE)
    share = g("Clip", g("Div", together, both), *limit)
    one = g.constant(1)
    normal = g("Sub", g("Log", g("Add", one, share)), g("Log", g("Sub", one, share)))
    normal = g("Mul", normal, g.constant(0.5))  # arctanh
    return graph_builder.side_by_side(g, [g("Log", deviation), normal])


def _changes(g: GraphBuilder, x: str, frames: int, hop: int, size: int, used: int) -> str:
    """[1, T, k] -> [used, steps, k]: every hop-th of the first `frames` less the frame that is a
    lag older, or the first one where there is none that old; for the signal itself always less the
    first."""

    def cut(y: str, start: int, end: int, step: int = 1) -> str:
        return g("Slice", y, [start], [end], [1], [step])

    def still(steps: int) -> str:
        return g("Expand", cut(x, 0, 1), [1, steps, size])

    lags, steps = LAGS[: used - 1], frames // hop
    most = max(lags, default=1)
    x_longer = g("Concat", still(most), cut(x, 0, frames), axis=1)
    older = [cut(x_longer, most - lag + hop - 1, most - lag + frames, hop) for lag in lags]
    every = g("Concat", still(steps), *older, axis=0) if older else still(steps)
    return g("Sub", cut(x, hop - 1, frames, hop), every)


def _hop(length: int, window: int) -> int:
    """The smallest divisor of a tenth's `length` that leaves at most MOST_FRAMES of a window."""
    fewest = -(-window // MOST_FRAMES)
    return next(n for n in range(min(fewest, length), length + 1) if length % n == 0)


def cells(format: SweepFormat) -> NDArray[np.float64]:
    """Ones where a channel belongs to a cell of the skin [k, M]; each channel is one cell if there
    are at most MOST_CHANNELS."""
    rows, cols, axes = format.rows, format.cols, format.axes
    most = max(MOST_CHANNELS // axes, 1)
    grids = [(down, min(most // down, cols)) for down in range(1, min(rows, most) + 1)]
    # as many cells as possible, then as square as possible
    down, across = max(
        grids,
        key=lambda grid: (
            grid[0] * grid[1],
            -round(abs(np.log(rows * grid[1] / cols / grid[0])), 6),
        ),
    )
    row, col = np.arange(rows) * down // rows, np.arange(cols) * across // cols
    cell = (row[:, None] * across + col).ravel()
    number = (cell[:, None] * axes + np.arange(axes)).ravel()
    belongs: NDArray[np.float64] = np.eye(down * across * axes)[number].T
    return belongs
