"""Compares the float and the int8 precision of a model on labelled sweeps.

Reports how much the answers differ, how much accuracy is lost with its interval, and the range and
saturation of every quantized tensor. Graphs run as on the box, with their inner tensors as further
outputs. A bundle holds no float model; for a bundle, each tensor is only compared with its own
value before rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from math import comb
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from palpate.core.errors import FormatError
from palpate.inference.classifier import softmax
from palpate.inference.session import session
from palpate_train.metrics.score import widen
from palpate_train.onnx_tools.quantize import calibration_sweeps

Array = NDArray[Any]
PERCENTILES = (0.1, 50.0, 99.9, 100.0)
"""Percentiles of a tensor's values; the last is the largest value."""
WEIGHTED = ("Conv", "Gemm", "MatMul")
COMPARED = (*WEIGHTED, "MaxPool")
"""Kinds of nodes that both models have in the same order. Tensors are compared at their outputs."""
TINY = 1e-30
Z95 = 1.96


@dataclass(frozen=True)
class Layer:
    """One tensor that int8 rounds. kind: activations or weights.

    against: `float` if it is compared with the same tensor of the float graph, `itself` if it is
    compared with its own value before rounding, because the float graph lacks it. percentiles:
    PERCENTILES of the values before rounding. low, high: the range of int8, in steps of `step` (for
    weights the median channel's). saturated: share of values beyond that range; values that a ReLU
    cuts off do not count. sqnr_db: power of the values divided by the power of the difference, in
    decibel. For weights, a common factor that the float graph does not have is divided out first.
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


@dataclass(frozen=True)
class AnswerDifference:
    """Differences between the answers of int8 and float.

    agreement: share of equal labels. Probability and logit: the largest difference over the labels
    of each sweep; maximum and mean of it over sweeps. Each sweep's mean is subtracted from its
    logits first, which changes no answer. expected_loss: the loss of accuracy by float's own
    probabilities. For a sweep with different labels, it is the probability of float's label minus
    the probability of int8's label. If probabilities are calibrated, it equals the mean loss in
    counts of right answers, with far less variance.
    """

    agreement: float
    expected_loss: float
    probability_difference: float
    probability_mean: float
    logit_difference: float
    logit_mean: float


@dataclass(frozen=True)
class AccuracyLoss:
    """Accuracy of both precisions, as counts of `total` sweeps. lost: float's share minus int8's;
    low, high: its 95 % interval.

    chance: if both were equally good, the probability that int8 loses at least as many of the
    sweeps on which they differ.
    """

    total: int
    float_right: int
    int8_right: int
    lost: float
    low: float
    high: float
    chance: float


@dataclass(frozen=True)
class Parity:
    """The comparison of a model's two precisions on some sweeps.

    answers, accuracy: None if there is no float model. tap_sum: the largest sum of the integer taps
    of one filter and taxel in the first convolution: 0 if no offset changes the answer, -1 if no
    convolution is in int8.
    """

    sweeps: int
    int8_right: int
    answers: AnswerDifference | None
    accuracy: AccuracyLoss | None
    tap_sum: int
    layers: tuple[Layer, ...]

    def json(self) -> dict[str, Any]:
        """The comparison as scripts read it."""
        return asdict(self)

    def summary(self) -> dict[str, Any]:
        """The entry of a manifest: of the tensors only the worst."""
        figures: dict[str, Any] = {}
        for part in (self.answers, self.accuracy):
            figures |= asdict(part) if part else {}
        if not self.layers:  # no tensor is in int8
            return figures
        worst = {
            "saturated": max(x.saturated for x in self.layers),
            "sqnr_db": min(x.sqnr_db for x in self.layers),
        }
        return figures | worst | {"tap_sum": self.tap_sum}


def measure(
    int8: onnx.ModelProto,
    inputs: Array,
    labels: Array,
    reference: onnx.ModelProto | None = None,
    clusters: Array | None = None,
) -> Parity:
    """Compare `int8` with the float model `reference` on `inputs` (raw counts or features) of
    sweeps with these `labels`.

    clusters: [n], numbers of sweeps that succeed or fail together. Raises FormatError if nothing in
    `int8` is quantized.
    """
    int8_logits = logits(int8, inputs)
    right, difference, lost = int8_logits.argmax(1) == labels, None, None
    if reference is not None:
        float_logits = logits(reference, inputs)
        difference = compare(float_logits, int8_logits)
        lost = loss(float_logits.argmax(1) == labels, right, clusters)
    rounded = tuple(layers(int8, reference, calibration_sweeps(inputs)))
    if not rounded and reference is None:
        raise FormatError(
            "the model has no int8 tensors: there is nothing to compare; "
            "export a fit with palpate-train export"
        )
    return Parity(len(labels), int(right.sum()), difference, lost, tap_sum(int8), rounded)


def logits(model: onnx.ModelProto, inputs: Array) -> Array:
    """The output `logits` for each of `inputs`, float32 [n, K], in the same kind of session as on
    the box."""
    return outputs(model, ["logits"], inputs)[0]


def compare(float_logits: Array, int8_logits: Array) -> AnswerDifference:
    """Compare the logits [n, K] of both precisions for the same sweeps."""
    p, q = softmax(float_logits), softmax(int8_logits)
    label, other = float_logits.argmax(1, keepdims=True), int8_logits.argmax(1, keepdims=True)
    given_away = np.take_along_axis(p, label, 1) - np.take_along_axis(p, other, 1)
    moved = np.abs(p - q).max(1)
    centred = [x - x.mean(1, keepdims=True) for x in (float_logits, int8_logits)]
    z = np.abs(centred[0] - centred[1]).max(1)
    figures = (
        np.mean(label == other),
        given_away.mean(),
        moved.max(),
        moved.mean(),
        z.max(),
        z.mean(),
    )
    return AnswerDifference(*(float(x) for x in figures))


def loss(float_right: Array, int8_right: Array, clusters: Array | None = None) -> AccuracyLoss:
    """The loss of accuracy; booleans [n] say which answers to the same sweeps are right.

    The interval of the difference of matched proportions is that of Agresti and Min (Statistics in
    Medicine 24, 2005). It adds a half to each of the four counts, and so is valid even if both
    precisions always agree. With `clusters` it is extended to the interval of the cluster bootstrap
    (see score.interval).
    """
    difference = float_right.astype(float) - int8_right
    fewer, more = int((difference > 0).sum()), int((difference < 0).sum())
    n, worse, better = len(difference), fewer + 0.5, more + 0.5
    chance = sum(comb(fewer + more, k) for k in range(fewer, fewer + more + 1)) / 2 ** (
        fewer + more
    )
    middle = (worse - better) / (n + 2)
    reach = Z95 * np.sqrt(((worse + better) / (n + 2) - middle**2) / (n + 2))
    low, high = widen((middle - reach, middle + reach), difference, clusters)
    lost, low, high = float(difference.mean()), float(max(low, -1)), float(min(high, 1))
    return AccuracyLoss(n, int(float_right.sum()), int(int8_right.sum()), lost, low, high, chance)


def layers(
    int8: onnx.ModelProto, reference: onnx.ModelProto | None, inputs: Array
) -> Iterator[Layer]:
    """Every rounded tensor of `int8`, then its weights if there is a float model `reference` to
    compare them with."""
    constants, nodes = _constants(int8), rounding_nodes(int8)
    tensors = outputs(int8, [q.input[0] for q in nodes] + [q.output[0] for q in nodes], inputs)
    twins = [_twin(int8, reference, q.input[0]) for q in nodes]
    names = [name for name in twins if name]
    of_float = (
        dict(zip(names, outputs(reference, names, inputs), strict=True))
        if reference and names
        else {}
    )
    for q, before, after, twin in zip(nodes, tensors, tensors[len(nodes) :], twins, strict=False):
        step, zero, limits = (
            float(constants[q.input[1]]),
            int(constants[q.input[2]]),
            np.iinfo(after.dtype),
        )
        low, high = (limits.min - zero) * step, (limits.max - zero) * step
        against = "float" if twin and of_float[twin].shape == after.shape else "itself"
        want = of_float[twin] if against == "float" else before
        want = np.maximum(want, 0) if low == 0 else want  # rounding includes the ReLU
        beyond = float(np.mean((want > high + step / 2) | (want < low - step / 2)))
        sqnr = _sqnr(want, (after.astype(np.float64) - zero) * step)
        yield Layer(
            q.input[0], "activations", against, _percentiles(want), low, high, step, beyond, sqnr
        )
    if reference:
        yield from _weight_layers(int8, reference)


def _weight_layers(int8: onnx.ModelProto, reference: onnx.ModelProto) -> Iterator[Layer]:
    floats = _constants(reference)
    for node in _nodes(int8, *WEIGHTED):
        found, same = _weights(int8, node), _same(int8, reference, node)
        if found and same and same.input[1] in floats:
            want, (taps, steps) = floats[same.input[1]], found
            have = taps * steps
            have *= np.sum(want * have) / max(float(np.sum(have * have)), TINY)
            reach, step = float(np.abs(have).max()), float(np.median(steps))
            name = f"{node.output[0]} weights"
            yield Layer(
                name,
                "weights",
                "float",
                _percentiles(want),
                -reach,
                reach,
                step,
                0.0,
                _sqnr(want, have),
            )


def tap_sum(model: onnx.ModelProto) -> int:
    """See Parity."""
    for conv in _nodes(model, "Conv"):
        found = _weights(model, conv)
        return int(np.abs(found[0].sum(axis=tuple(range(2, found[0].ndim)))).max()) if found else -1
    return -1


def with_outputs(model: onnx.ModelProto, names: Sequence[str]) -> onnx.ModelProto:
    """`model` with inner tensors as further outputs."""
    shown = onnx.ModelProto()
    shown.CopyFrom(model)
    present = {out.name for out in shown.graph.output}
    shown.graph.output.extend(
        onnx.ValueInfoProto(name=name) for name in dict.fromkeys(names) if name not in present
    )
    return shown


def rounding_nodes(int8: onnx.ModelProto) -> list[onnx.NodeProto]:
    """The nodes that round their first input to integers, their first output."""
    return _nodes(int8, "QuantizeLinear")


def outputs(model: onnx.ModelProto, names: list[str], inputs: Array) -> list[Array]:
    """Tensors of `model` by name, inner tensors too, for each of `inputs`: [n, ...] each."""
    run, given = session(with_outputs(model, names).SerializeToString()), model.graph.input[0].name
    sweeps = [run.run(names, {given: one[None]}) for one in inputs]
    return [np.concatenate([tensors[i] for tensors in sweeps]) for i in range(len(names))]


def _constants(model: onnx.ModelProto) -> dict[str, Array]:
    return {c.name: numpy_helper.to_array(c) for c in model.graph.initializer}


def _nodes(model: onnx.ModelProto, *kinds: str) -> list[onnx.NodeProto]:
    return [node for node in model.graph.node if node.op_type in kinds]


def _maker(model: onnx.ModelProto, tensor: str) -> onnx.NodeProto | None:
    """The node that computes `tensor`, None for an input or a constant."""
    return next((node for node in model.graph.node if tensor in node.output), None)


def _same(
    int8: onnx.ModelProto, reference: onnx.ModelProto, node: onnx.NodeProto
) -> onnx.NodeProto | None:
    """The node of `reference` that corresponds to `node`: the node of the same kind and number,
    None if the kinds occur in different numbers."""
    mine, its = _nodes(int8, node.op_type), _nodes(reference, node.op_type)
    return its[mine.index(node)] if len(mine) == len(its) else None


def _twin(int8: onnx.ModelProto, reference: onnx.ModelProto | None, tensor: str) -> str:
    """The name in `reference` of the tensor that corresponds to `tensor` in `int8`, after its ReLU;
    "" if there is none."""
    node = _maker(int8, tensor)
    if reference is None or node is None or node.op_type not in COMPARED:
        return ""
    same = _same(int8, reference, node)
    name = same.output[0] if same else ""
    return next(
        (relu.output[0] for relu in _nodes(reference, "Relu") if relu.input[0] == name), name
    )


def _weights(model: onnx.ModelProto, node: onnx.NodeProto) -> tuple[Array, Array] | None:
    """Integer weights of `node` minus their zero point, float64, and the step of each channel in a
    shape that fits; None if the weights are float."""
    maker, constants = _maker(model, node.input[1]), _constants(model)
    if maker is None or maker.op_type != "DequantizeLinear":
        return None
    stored = constants.get(maker.input[0])
    if stored is None and not _depends_on_input(model, maker.input[0]):
        stored = outputs(model, [maker.input[0]], _nothing(model))[0]
    if stored is None:
        return None
    taps, steps = stored.astype(np.float64), constants[maker.input[1]]
    if len(maker.input) > 2:
        taps -= constants[maker.input[2]].reshape(-1, *[1] * (taps.ndim - 1) * (steps.ndim > 0))
    return taps, steps.reshape(-1, *[1] * (taps.ndim - 1))


def _depends_on_input(model: onnx.ModelProto, tensor: str) -> bool:
    """Whether `tensor` is computed from the model's input, or is the input. If not, onnxruntime
    computes it when it loads the model."""
    if tensor == model.graph.input[0].name:
        return True
    maker = _maker(model, tensor)
    return maker is not None and any(_depends_on_input(model, name) for name in maker.input)


def _nothing(model: onnx.ModelProto) -> Array:
    """An input of zeros [1, ...] in the model's type."""
    given = model.graph.input[0].type.tensor_type
    shape = [d.dim_value for d in given.shape.dim][1:]
    return np.zeros((1, *shape), helper.tensor_dtype_to_np_dtype(given.elem_type))


def _percentiles(values: Array) -> tuple[float, ...]:
    return tuple(float(x) for x in np.percentile(values, PERCENTILES))


def _sqnr(want: Array, have: Array) -> float:
    noise, power = (
        float(np.sum((want - have) ** 2)),
        float(np.sum(np.square(want, dtype=np.float64))),
    )
    return float(10 * np.log10(max(power, TINY) / max(noise, TINY)))


def table(parity: Parity) -> str:
    """The whole comparison as text."""
    lines = []
    if (apart := parity.answers) and (lost := parity.accuracy):
        lines.append(
            f"labels equal {apart.agreement:.4f}, "
            f"expected loss {100 * apart.expected_loss:.2f} points; "
            f"a probability differs by up to {apart.probability_difference:.4f} "
            f"(mean of sweeps {apart.probability_mean:.4f}), "
            f"a logit by up to {apart.logit_difference:.3f} ({apart.logit_mean:.3f})"
        )
        lines.append(
            f"float {lost.float_right}/{lost.total}, int8 {lost.int8_right}/{lost.total}: "
            f"lost {100 * lost.lost:.2f} points "
            f"[{100 * lost.low:.2f}, {100 * lost.high:.2f}]"
        )
    else:
        lines.append(
            f"int8 {parity.int8_right}/{parity.sweeps}; a bundle holds no float model: "
            "tensors are compared with themselves"
        )
    taps = (
        "zero, so no offset changes the answer"
        if parity.tap_sum == 0
        else f"up to {parity.tap_sum}"
    )
    lines.append(f"first convolution, sum of the integer taps of a filter and taxel: {taps}")
    percentiles = " ".join(f"{'max' if p == 100 else f'{p:g} %':>9}" for p in PERCENTILES)
    lines.append(
        f"{'tensor':<36} {'against':<8} {percentiles} {'int8 from':>9} {'to':>9} {'step':>9} "
        f"{'saturated':>9} {'SQNR dB':>8}"
    )
    for x in parity.layers:
        values = " ".join(f"{v:>9.3g}" for v in (*x.percentiles, x.low, x.high, x.step))
        lines.append(
            f"{x.tensor[:36]:<36} {x.against:<8} {values} {x.saturated:>9.5f} {x.sqnr_db:>8.1f}"
        )
    return "\n".join(lines)
