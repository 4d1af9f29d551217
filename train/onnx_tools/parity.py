"""Comparison of float and int8. In: both graphs of a model, sweeps with labels. Out: a Parity.

It reports how much the answers differ, what accuracy is lost with its interval, and for every
quantized tensor its range and saturation. Graphs are run as the box runs them, with their inner
tensors as further outputs. A bundle holds no float form: then only tensors are compared, each with
its own value before rounding.
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

from appliance.core.errors import FormatError
from appliance.inference.classifier import softmax
from appliance.inference.session import session
from train.metrics.score import widen
from train.onnx_tools.quantize import calibration_sweeps

Array = NDArray[Any]
PERCENTILES = (0.1, 50.0, 99.9, 100.0)
"""Of a tensor's values; the last is the largest."""
WEIGHTED = ("Conv", "Gemm", "MatMul")
COMPARED = (*WEIGHTED, "MaxPool")
"""Kinds of nodes that both forms have in the same order; tensors are compared at their outputs."""
TINY = 1e-30
Z95 = 1.96


@dataclass(frozen=True)
class Layer:
    """One tensor that int8 rounds. kind: activations or weights.

    against: what it is compared with, `float` (the same tensor of the float graph) or `itself` (its
    value before it is rounded, where the float graph has no such tensor). percentiles: PERCENTILES
    of that. low, high: the range of int8, in steps of `step` (of weights: the median channel's).
    saturated: share of values beyond that range; what a ReLU cuts off does not count. sqnr_db:
    power of the values over that of the difference, in decibel; for weights after one common factor
    is divided out, which the float graph does not have.
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
    """How far int8's answers are from float's.

    agreement: share of equal labels. Probability and logit: of each sweep the largest difference of
    any label; then largest and mean over sweeps. Logits are compared after each sweep's mean is
    subtracted, which changes no answer. expected_loss: of accuracy, by float's own probabilities:
    where int8 gives another label, that of float's label less that of int8's. Where these are
    calibrated it is what counting right answers gives on average, with far less variance.
    """

    agreement: float
    expected_loss: float
    probability_difference: float
    probability_mean: float
    logit_difference: float
    logit_mean: float


@dataclass(frozen=True)
class AccuracyLoss:
    """Accuracy of both, as counts of `total` sweeps. lost: float's share less int8's; low, high:
    its 95 % interval.

    chance: the probability, were neither form better, that int8 loses as many or more of the sweeps
    on which they differ.
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
    """The comparison of a model's two forms on some sweeps.

    answers, accuracy: None where there is no float model. tap_sum: the largest sum of the integer taps of
    one filter and taxel in the first convolution: 0 where no offset changes the answer, -1 where
    there is no convolution in int8.
    """

    sweeps: int
    int8_right: int
    answers: AnswerDifference | None
    accuracy: AccuracyLoss | None
    tap_sum: int
    layers: tuple[Layer, ...]

    def json(self) -> dict[str, Any]:
        """What scripts read."""
        return asdict(self)

    def summary(self) -> dict[str, Any]:
        """The part for a manifest: of the tensors only the worst."""
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
    """Compare `int8` with `reference`, its float form, on `inputs` (raw counts or features) of
    sweeps with these `labels`.

    clusters: [n], sweeps that succeed or fail together. Raises FormatError where nothing in `int8`
    is quantized.
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
            "the model has no int8 tensors: there is nothing to compare; export a fit with palpate-train export"
        )
    return Parity(len(labels), int(right.sum()), difference, lost, tap_sum(int8), rounded)


def logits(model: onnx.ModelProto, inputs: Array) -> Array:
    """The output `logits` for each of `inputs`, float32 [n, K], in the box's kind of session."""
    return outputs(model, ["logits"], inputs)[0]


def compare(float_logits: Array, int8_logits: Array) -> AnswerDifference:
    """Of the logits of both forms for the same sweeps, [n, K] each."""
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
    """Of booleans [n] of the same sweeps.

    The interval of the difference of matched proportions is that of Agresti and Min (Statistics in
    Medicine 24, 2005): a half is added to each of the four counts, so that it is valid where the
    forms never differ, too. With `clusters` it is the cluster bootstrap's (as score.interval) where
    that is wider.
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
    """Every rounded tensor of `int8`, then its weights where there is `reference`, its float form,
    to compare with."""
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
        want = np.maximum(want, 0) if low == 0 else want  # rounding does the ReLU as well
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
    """Tensors of `model` by name, inner ones too, for each of `inputs`: [n, ...] each."""
    run, given = session(with_outputs(model, names).SerializeToString()), model.graph.input[0].name
    sweeps = [run.run(names, {given: one[None]}) for one in inputs]
    return [np.concatenate([tensors[i] for tensors in sweeps]) for i in range(len(names))]


def _constants(model: onnx.ModelProto) -> dict[str, Array]:
    return {c.name: numpy_helper.to_array(c) for c in model.graph.initializer}


def _nodes(model: onnx.ModelProto, *kinds: str) -> list[onnx.NodeProto]:
    return [node for node in model.graph.node if node.op_type in kinds]


def _maker(model: onnx.ModelProto, tensor: str) -> onnx.NodeProto | None:
    """The node whose output `tensor` is, None for an input or a constant."""
    return next((node for node in model.graph.node if tensor in node.output), None)


def _same(
    int8: onnx.ModelProto, reference: onnx.ModelProto, node: onnx.NodeProto
) -> onnx.NodeProto | None:
    """The node of `reference` that does what `node` does: the one with the same number, where its
    kind is as frequent."""
    mine, its = _nodes(int8, node.op_type), _nodes(reference, node.op_type)
    return its[mine.index(node)] if len(mine) == len(its) else None


def _twin(int8: onnx.ModelProto, reference: onnx.ModelProto | None, tensor: str) -> str:
    """The name in `reference` of what `tensor` is in `int8`, after its ReLU; "" where there is no
    such tensor."""
    node = _maker(int8, tensor)
    if reference is None or node is None or node.op_type not in COMPARED:
        return ""
    same = _same(int8, reference, node)
    name = same.output[0] if same else ""
    return next(
        (relu.output[0] for relu in _nodes(reference, "Relu") if relu.input[0] == name), name
    )


def _weights(model: onnx.ModelProto, node: onnx.NodeProto) -> tuple[Array, Array] | None:
    """Integer weights of `node` less their zero point, float64, and the step of each channel,
    shaped to fit; None where they are float."""
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
    """Whether `tensor` is, or is computed from, the model's input: else onnxruntime computes it
    when it loads the model."""
    if tensor == model.graph.input[0].name:
        return True
    maker = _maker(model, tensor)
    return maker is not None and any(_depends_on_input(model, name) for name in maker.input)


def _nothing(model: onnx.ModelProto) -> Array:
    """One input of zeros [1, ...] of the model's type."""
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
    """All of it as text."""
    lines = []
    if (apart := parity.answers) and (lost := parity.accuracy):
        lines.append(
            f"labels equal {apart.agreement:.4f}, expected loss {100 * apart.expected_loss:.2f} points; a probability differs by up to {apart.probability_difference:.4f} "
            f"(mean of sweeps {apart.probability_mean:.4f}), a logit by up to {apart.logit_difference:.3f} ({apart.logit_mean:.3f})"
        )
        lines.append(
            f"float {lost.float_right}/{lost.total}, int8 {lost.int8_right}/{lost.total}: lost {100 * lost.lost:.2f} points "
            f"[{100 * lost.low:.2f}, {100 * lost.high:.2f}]"
        )
    else:
        lines.append(
            f"int8 {parity.int8_right}/{parity.sweeps}; a bundle holds no float form: tensors are compared with themselves"
        )
    taps = (
        "zero, so no offset changes the answer"
        if parity.tap_sum == 0
        else f"up to {parity.tap_sum}"
    )
    lines.append(f"first convolution, sum of the integer taps of a filter and taxel: {taps}")
    percentiles = " ".join(f"{'max' if p == 100 else f'{p:g} %':>9}" for p in PERCENTILES)
    lines.append(
        f"{'tensor':<36} {'against':<8} {percentiles} {'int8 from':>9} {'to':>9} {'step':>9} {'saturated':>9} {'SQNR dB':>8}"
    )
    for x in parity.layers:
        values = " ".join(f"{v:>9.3g}" for v in (*x.percentiles, x.low, x.high, x.step))
        lines.append(
            f"{x.tensor[:36]:<36} {x.against:<8} {values} {x.saturated:>9.5f} {x.sqnr_db:>8.1f}"
        )
    return "\n".join(lines)
