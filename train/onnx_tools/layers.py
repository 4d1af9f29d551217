"""The room of int8 inside. In: an int8 graph, its float form, sweeps. Out: one Layer for every rounded tensor.

Graphs are run in the box's kind of session with their inner tensors shown.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from appliance.inference.session import session

Array = NDArray[Any]
PERCENTILES = (0.1, 50.0, 99.9, 100.0)
"""Of a tensor's values; the last is the largest."""
WEIGHED = ("Conv", "Gemm", "MatMul")
COMPARED = (*WEIGHED, "MaxPool")
"""Kinds of nodes that both forms have in the same order; behind them tensors are compared."""
TINY = 1e-30


@dataclass(frozen=True)
class Layer:
    """One tensor that int8 rounds. kind: activations or weights.

    against: what it is compared with, `float` (the same tensor of the float graph) or `itself` (its value before it is
    rounded, where the float graph has none such). percentiles: PERCENTILES of that. low, high: what int8 reaches, in
    steps of `step` (of weights: the median channel's). saturated: share of values beyond; what a ReLU cuts off does not
    count. sqnr_db: power of the values over that of the difference, in decibel; of weights after one common factor is
    taken out, of which float knows nothing.
    """

    tensor: str
    kind: str
    against: str
    percentiles: tuple[float, ...]
    low: float
    high: float
    step: float
    saturated: float
    sqnr_db: float


def layers(int8: onnx.ModelProto, reference: onnx.ModelProto | None, inputs: Array) -> Iterator[Layer]:
    """Every rounded tensor of `int8`, then its weights where `reference`, its float form, tells what they were."""
    known, nodes = _constants(int8), rounded(int8)
    seen = outputs(int8, [q.input[0] for q in nodes] + [q.output[0] for q in nodes], inputs)
    twins = [_twin(int8, reference, q.input[0]) for q in nodes]
    told = [name for name in twins if name]
    of_float = dict(zip(told, outputs(reference, told, inputs), strict=True)) if reference and told else {}
    for q, itself, digits, twin in zip(nodes, seen, seen[len(nodes) :], twins, strict=False):
        step, zero, limits = float(known[q.input[1]]), int(known[q.input[2]]), np.iinfo(digits.dtype)
        low, high = (limits.min - zero) * step, (limits.max - zero) * step
        against = "float" if twin and of_float[twin].shape == digits.shape else "itself"
        want = of_float[twin] if against == "float" else itself
        want = np.maximum(want, 0) if low == 0 else want  # rounding does the ReLU along the way
        beyond = float(np.mean((want > high + step / 2) | (want < low - step / 2)))
        noise = _sqnr(want, (digits.astype(np.float64) - zero) * step)
        yield Layer(q.input[0], "activations", against, _spread(want), low, high, step, beyond, noise)
    if reference:
        yield from _weight_layers(int8, reference)


def _weight_layers(int8: onnx.ModelProto, reference: onnx.ModelProto) -> Iterator[Layer]:
    floats = _constants(reference)
    for node in _nodes(int8, *WEIGHED):
        found, same = _weights(int8, node), _same(int8, reference, node)
        if found and same and same.input[1] in floats:
            want, (digits, steps) = floats[same.input[1]], found
            have = digits * steps
            have *= np.sum(want * have) / max(float(np.sum(have * have)), TINY)
            reach, step = float(np.abs(have).max()), float(np.median(steps))
            name = f"{node.output[0]} weights"
            yield Layer(name, "weights", "float", _spread(want), -reach, reach, step, 0.0, _sqnr(want, have))


def tap_sum(model: onnx.ModelProto) -> int:
    """See Parity."""
    for conv in _nodes(model, "Conv"):
        found = _weights(model, conv)
        return int(np.abs(found[0].sum(axis=tuple(range(2, found[0].ndim)))).max()) if found else -1
    return -1


def shown(model: onnx.ModelProto, names: Sequence[str]) -> onnx.ModelProto:
    """`model` with inner tensors as outputs, too."""
    whole = onnx.ModelProto()
    whole.CopyFrom(model)
    there = {out.name for out in whole.graph.output}
    whole.graph.output.extend(onnx.ValueInfoProto(name=name) for name in dict.fromkeys(names) if name not in there)
    return whole


def rounded(int8: onnx.ModelProto) -> list[onnx.NodeProto]:
    """The nodes that round: from their first input to whole numbers, their first output."""
    return _nodes(int8, "QuantizeLinear")


def outputs(model: onnx.ModelProto, names: list[str], inputs: Array) -> list[Array]:
    """Tensors of `model` by name, inner ones too, for each of `inputs`: [n, ...] each."""
    run, given = session(shown(model, names).SerializeToString()), model.graph.input[0].name
    each = [run.run(names, {given: one[None]}) for one in inputs]
    return [np.concatenate([one[i] for one in each]) for i in range(len(names))]


def _constants(model: onnx.ModelProto) -> dict[str, Array]:
    return {c.name: numpy_helper.to_array(c) for c in model.graph.initializer}


def _nodes(model: onnx.ModelProto, *kinds: str) -> list[onnx.NodeProto]:
    return [node for node in model.graph.node if node.op_type in kinds]


def _maker(model: onnx.ModelProto, tensor: str) -> onnx.NodeProto | None:
    return next((node for node in model.graph.node if tensor in node.output), None)


def _same(int8: onnx.ModelProto, reference: onnx.ModelProto, node: onnx.NodeProto) -> onnx.NodeProto | None:
    """The node of `reference` that does what `node` does: the same number among as many of its kind."""
    mine, its = _nodes(int8, node.op_type), _nodes(reference, node.op_type)
    return its[mine.index(node)] if len(mine) == len(its) else None


def _twin(int8: onnx.ModelProto, reference: onnx.ModelProto | None, tensor: str) -> str:
    """The name in `reference` of what `tensor` is in `int8`, behind its ReLU; "" where that cannot be told."""
    node = _maker(int8, tensor)
    if reference is None or node is None or node.op_type not in COMPARED:
        return ""
    same = _same(int8, reference, node)
    name = same.output[0] if same else ""
    return next((relu.output[0] for relu in _nodes(reference, "Relu") if relu.input[0] == name), name)


def _weights(model: onnx.ModelProto, node: onnx.NodeProto) -> tuple[Array, Array] | None:
    """Integer weights of `node` less their zero point, float64, and the step of each channel, shaped to fit; None where
    they are float."""
    maker, known = _maker(model, node.input[1]), _constants(model)
    if maker is None or maker.op_type != "DequantizeLinear" or maker.input[0] not in known:
        return None
    digits, steps = known[maker.input[0]].astype(np.float64), known[maker.input[1]]
    if len(maker.input) > 2:
        digits -= known[maker.input[2]].reshape(-1, *[1] * (digits.ndim - 1) * (steps.ndim > 0))
    return digits, steps.reshape(-1, *[1] * (digits.ndim - 1))


def _spread(values: Array) -> tuple[float, ...]:
    return tuple(float(x) for x in np.percentile(values, PERCENTILES))


def _sqnr(want: Array, have: Array) -> float:
    noise, power = float(np.sum((want - have) ** 2)), float(np.sum(np.square(want, dtype=np.float64)))
    return float(10 * np.log10(max(power, TINY) / max(noise, TINY)))
