"""Small trunks as ONNX graphs."""

from collections.abc import Callable

import numpy as np
import onnx

from palpate.core.types import SweepFormat
from palpate_train.models.recipe.architectures import PREFIXES
from palpate_train.onnx_tools.graph_builder import TENSOR, GraphBuilder, run

FORMAT = SweepFormat(2, 2, 100.0, 163, "int16")


def trunk(format: SweepFormat, prefixes: bool = False) -> onnx.ModelProto:
    """Means over the window, `features` [1, F]; prefixes: over tenths, [1, 10, F]."""
    g, taxels, length = GraphBuilder(), format.rows * format.cols, format.window // 10
    x = g("Cast", g("Reshape", "sweep", g.constant([format.window, taxels], "int64")), to=1)
    x = g("Slice", x, g.constant([0], "int64"), g.constant([10 * length], "int64"))
    x = g(
        "ReduceMean",
        g("Reshape", x, g.constant([10, length, taxels], "int64")),
        axes=[1],
        keepdims=0,
    )
    x = g("MatMul", g.constant(np.tri(10) / np.arange(1, 11)[:, None]), x)
    name, shape = ("tenths", [1, 10, taxels]) if prefixes else ("features", [1, taxels])
    x = x if prefixes else g("Slice", x, g.constant([9], "int64"), g.constant([10], "int64"))
    g("Reshape", x, g.constant(shape, "int64"), output=name)
    given = onnx.helper.make_tensor_value_info(
        "sweep", TENSOR[format.dtype], [1, format.window, format.rows, format.cols]
    )
    out = onnx.helper.make_tensor_value_info(name, 1, shape)
    graph = onnx.helper.make_graph(g.nodes, "toy", [given], [out], g.constants)
    return onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8
    )


def view(
    format: SweepFormat, nodes: Callable[..., str], size: int, samples: np.ndarray, prefixes: bool
) -> np.ndarray:
    """Features [n, size] or [n, PREFIXES, size] of counts by a graph's `nodes` alone."""
    g, shape = GraphBuilder(), (PREFIXES, size) if prefixes else (size,)
    raw = g("Reshape", "sweep", g.constant([1, format.window, format.channels], "int64"))
    found = nodes(g, raw, g.constant(np.ones((1, 1, format.channels))))
    g("Reshape", found, g.constant([1, *shape], "int64"), output="features")
    return run(g.model(format, "features", *shape), samples)
