"""The load of each taxel, and how all taxels together move in the first and the last tenth.

Filters, distribution and spectrum do not respond to the level of a taxel. Where the force is
controlled and the skin stays, the level shows the hardness of a material; where forces or skins
differ, it is a trap. Therefore loads are only used where held-out groups show that they help.
"""

from __future__ import annotations

import numpy as np

from palpate.core.types import SweepFormat
from palpate_train.models.recipe.architectures import PREFIXES, each_frame
from palpate_train.onnx_tools import graph_builder
from palpate_train.onnx_tools.graph_builder import GraphBuilder

MOVES = 2
"""Movements of each axis: the first and the last tenth, less the mean."""


def count(format: SweepFormat) -> int:
    """Number of features."""
    return format.channels + MOVES * format.axes


def nodes(g: GraphBuilder, x: str, format: SweepFormat, scale: float, prefixes: bool) -> str:
    """Raw counts [1, T, M] as floats, M = R * C * A -> loads [1, 1 or PREFIXES, M + MOVES * A],
    times `scale`. A prefix has a mean and a last tenth of its own."""
    window, axes = format.window, format.axes
    tenth = max(window // PREFIXES, 1)
    ends = [max(end, 1) for end in each_frame(window).known_steps(window, prefixes)]
    starts = [max(end - tenth, 0) for end in ends]
    sums = graph_builder.sums(g, x, window, [tenth, *starts, *ends])
    rows, eye = len(ends), np.eye(len(ends))
    mean = np.hstack([np.zeros((rows, 1 + rows)), eye / np.array(ends)[:, None]])
    first = np.hstack([np.full((rows, 1), 1 / tenth), np.zeros((rows, 2 * rows))]) - mean
    length = np.subtract(ends, starts)[:, None]
    last = np.hstack([np.zeros((rows, 1)), -eye / length, eye / length]) - mean
    taxels = format.channels // axes
    share = np.tile(np.eye(axes), (taxels, 1)) * scale / taxels
    moves = [
        g("MatMul", g("MatMul", g.constant(tenth_less_mean), sums), g.constant(share))
        for tenth_less_mean in (first, last)
    ]
    means = g("Mul", g("MatMul", g.constant(mean), sums), g.constant(scale))
    return graph_builder.side_by_side(g, [means, *moves])
