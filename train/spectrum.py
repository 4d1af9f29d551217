"""The room of the spectrum that all taxels share. In: a trunk's graph. Out: the same graph, with band powers as features.

What was trained to tell materials apart folds away what does not help it, and so hardly sees that a material is none of
them. Fixed features do not: here the taxels' mean over the grid, cut into tenths of the window, and the power in bands
of its spectrum (Welch 1967), as logarithms. A tenth is looked at by itself, so no offset and no later frame matters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from appliance.sweep import SweepFormat

Array = NDArray[Any]
SEGMENTS = 10
"""Into which a window is cut: the tenths after which a box may decide early."""
BANDS = 24
"""Of a spectrum, at most: their edges lie evenly on a logarithmic axis, as whole bins."""
FLOOR = 1e-4
"""Added to a band's power before its logarithm, where the texture's is about 1: a silent skin stays finite."""


def edges(length: int) -> Array:
    """Edges [n + 1] of the n bands of a segment of `length` frames, in half bins of its spectrum: from 2 to `length`.

    With whole bins, which lie as far apart as Hann's window is wide, AUROC of unknown materials falls by .007.
    """
    return np.unique(np.rint(np.geomspace(2, length + 1, BANDS + 1)).astype(int))


def bands(form: SweepFormat) -> int:
    """How many features `with_spectrum` adds; 0 where a tenth of the window is less than four frames."""
    length = form.window // SEGMENTS
    return len(edges(length)) - 1 if length >= 4 else 0


def with_spectrum(trunk: onnx.ModelProto, form: SweepFormat, scale: float) -> onnx.ModelProto:
    """A trunk's graph, `sweep` -> `features` [1, F] or `tenths` [1, SEGMENTS, F], with `bands` more features at the end.

    scale: what makes digits about 1, as networks.texture_scale gives it. Row d of `tenths` is of the first d + 1
    segments. The graph stays as it is where the window is too short for a spectrum.
    """
    if not (size := bands(form)):
        return trunk
    whole = onnx.ModelProto()
    whole.CopyFrom(trunk)
    graph, given = whole.graph, trunk.graph.output[0]
    dims = [d.dim_value for d in given.type.tensor_type.shape.dim]
    constants, nodes = graph.initializer, graph.node

    def constant(value: Any, kind: str) -> str:
        name = f"s{len(constants)}"
        constants.append(numpy_helper.from_array(np.array(value, kind, order="C"), name))
        return name

    def add(op: str, *inputs: str, **how: Any) -> str:
        output = f"spectrum{len(nodes)}"
        nodes.append(helper.make_node(op, inputs, [output], name=output, **how))
        return output

    power = _power(add, constant, form, scale)
    if len(dims) == 3:
        power = add("MatMul", constant(np.tri(SEGMENTS) / np.arange(1, SEGMENTS + 1)[:, None], "float32"), power)
    else:
        power = add("ReduceMean", power, axes=[0])
    power = add("Log", add("Add", power, constant(FLOOR, "float32")))
    if len(dims) == 3:
        power = add("Unsqueeze", power, constant([0], "int64"))
    inner = f"trunk.{given.name}"
    for node in nodes:
        node.output[:] = [inner if name == given.name else name for name in node.output]
        node.input[:] = [inner if name == given.name else name for name in node.input]
    nodes.append(helper.make_node("Concat", [inner, power], [given.name], name="spectrum", axis=len(dims) - 1))
    dims[-1] += size
    del graph.output[:]
    graph.output.append(helper.make_tensor_value_info(given.name, TensorProto.FLOAT, dims))
    onnx.checker.check_model(whole, full_check=True)
    return whole


def _power(add: Any, constant: Any, form: SweepFormat, scale: float) -> str:
    """Nodes `sweep` -> mean power of each segment in each band [SEGMENTS, bands]."""
    length, taxels = form.window // SEGMENTS, form.rows * form.cols
    x = add("Cast", add("Reshape", "sweep", constant([form.window, taxels], "int64")), to=TensorProto.FLOAT)
    x = add("MatMul", x, constant(np.full((taxels, 1), scale / taxels), "float32"))
    if form.window % SEGMENTS:
        x = add("Slice", x, constant([0], "int64"), constant([length * SEGMENTS], "int64"))
    x = add("Reshape", x, constant([SEGMENTS, length], "int64"))
    x = add("MatMul", x, _basis(add, constant, length))
    return str(add("MatMul", add("Mul", x, x), _collect(add, constant, edges(length))))


def _basis(add: Any, constant: Any, length: int) -> str:
    """Nodes that give [length, 2 * bins], cosines and sines under Hann's window, each with mean 0: onnxruntime folds
    them into one constant when it loads the model, and the file holds none of it."""
    zero, one = (constant(n, "int64") for n in (0, 1))
    n = add("Unsqueeze", add("Range", zero, constant(length, "int64"), one), constant([1], "int64"))
    k = add("Range", constant(2, "int64"), constant(length + 1, "int64"), one)
    turn = add("Cast", add("Mod", add("Mul", n, k), constant(2 * length, "int64")), to=TensorProto.FLOAT)
    turn = add("Mul", turn, constant(np.pi / length, "float32"))
    window = np.hanning(length + 2)[1:-1, None]  # without its zeros
    waves = add("Concat", add("Cos", turn), add("Sin", turn), axis=1)
    waves = add("Mul", waves, constant(window / np.sqrt((window**2).sum()), "float32"))
    return str(add("Sub", waves, add("ReduceMean", waves, axes=[0])))


def _collect(add: Any, constant: Any, ends: Array) -> str:
    """Nodes that give [2 * bins, bands], what makes the mean of each band of squares; folded as `_basis` is."""
    k = add("Range", *(constant(n, "int64") for n in (2, int(ends[-1]), 1)))
    k = add("Unsqueeze", add("Concat", k, k, axis=0), constant([1], "int64"))
    below, beyond = (add("Less", k, constant(side, "int64")) for side in (ends[:-1], ends[1:]))
    inside = add("Cast", add("And", add("Not", below), beyond), to=TensorProto.FLOAT)
    return str(add("Mul", inside, constant(1 / np.diff(ends), "float32")))
