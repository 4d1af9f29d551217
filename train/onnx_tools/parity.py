"""The room of float against int8. In: both graphs of a model, sweeps with labels. Out: a Parity.

It tells how far the answers are apart, what accuracy is lost and how sure that is, and for every quantized tensor its
range and what saturates.

Both graphs are run as the box runs them, once more with their inner tensors shown. A bundle holds no float form; then
the tensors alone are told, each against its own value before it is rounded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from math import comb
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from appliance.core.errors import FormatError
from appliance.inference.classifier import softmax
from appliance.inference.session import session
from train.metrics.score import widened

Array = NDArray[Any]
PERCENTILES = (0.1, 50.0, 99.9, 100.0)
"""Of a tensor's values; the last is the largest."""
WEIGHED = ("Conv", "Gemm", "MatMul")
COMPARED = (*WEIGHED, "MaxPool")
"""Kinds of nodes that both forms have in the same order; behind them tensors are compared."""
TINY = 1e-30
LAYER_SWEEPS = 96
"""On so many sweeps, evenly drawn, the tensors are looked at."""
Z95 = 1.96


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


@dataclass(frozen=True)
class Apart:
    """How far int8's answers are from float's.

    agreement: share of equal labels. Probability and logit: by sweep, the largest difference of any label's; then largest
    and mean over sweeps. Logits are compared after each sweep's mean is taken away: they mean the same then.
    expected_loss: of accuracy, by float's own probabilities: where int8 takes another label, that of float's less that
    of int8's. Where these are honest it is what counting right answers gives on average, and far less a matter of luck.
    """

    agreement: float
    expected_loss: float
    probability_difference: float
    probability_mean: float
    logit_difference: float
    logit_mean: float


@dataclass(frozen=True)
class Lost:
    """Accuracy of both, as counts of `total` sweeps. lost: float's share less int8's; low, high: its 95 % interval.

    chance: how likely it is, were neither form better, that int8 loses so many or more of the sweeps that they differ on.
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
    """All that is known of a model's two forms on some sweeps.

    apart, lost: None where there is no float form. tap_sum: the largest sum of the integer taps of one filter and taxel
    in the first convolution: 0 where no offset can move it.
    """

    sweeps: int
    int8_right: int
    apart: Apart | None
    lost: Lost | None
    tap_sum: int
    layers: tuple[Layer, ...]

    def json(self) -> dict[str, Any]:
        """What scripts read."""
        return asdict(self)

    def summary(self) -> dict[str, Any]:
        """In small, for a manifest: of the tensors the worst."""
        told = (asdict(part) for part in (self.apart, self.lost) if part)
        figures = {name: value for part in told for name, value in part.items()}
        if not self.layers:  # nothing of it is in int8
            return figures
        worst = {"saturated": max(x.saturated for x in self.layers), "sqnr_db": min(x.sqnr_db for x in self.layers)}
        return figures | worst | {"tap_sum": self.tap_sum}


def measure(
    int8: onnx.ModelProto,
    inputs: Array,
    labels: Array,
    reference: onnx.ModelProto | None = None,
    clusters: Array | None = None,
) -> Parity:
    """Compare `int8` with `reference`, its float form, on `inputs` (digits or features) of sweeps with these `labels`.

    clusters: [n], sweeps that succeed or fail together. Raises FormatError where nothing in `int8` is quantized.
    """
    have = logits(int8, inputs)
    right, apart, lost = have.argmax(1) == labels, None, None
    if reference is not None:
        want = logits(reference, inputs)
        apart, lost = compare(want, have), loss(want.argmax(1) == labels, right, clusters)
    some = inputs[np.linspace(0, len(inputs) - 1, min(LAYER_SWEEPS, len(inputs))).astype(int)]
    told = tuple(layers(int8, reference, some))
    if not told and reference is None:
        raise FormatError(
            "the model has no int8 tensors: there is nothing to compare; export a fit with palpate-train export"
        )
    return Parity(len(labels), int(right.sum()), apart, lost, tap_sum(int8), told)


def logits(model: onnx.ModelProto, inputs: Array) -> Array:
    """The output `logits` of each of `inputs`, float32 [n, K], in the box's kind of session."""
    return outputs(model, ["logits"], inputs)[0]


def compare(want: Array, have: Array) -> Apart:
    """Of float's logits `want` and int8's `have`, both [n, K]."""
    p, q = softmax(want), softmax(have)
    label, other = want.argmax(1, keepdims=True), have.argmax(1, keepdims=True)
    given_away = np.take_along_axis(p, label, 1) - np.take_along_axis(p, other, 1)
    moved = np.abs(p - q).max(1)
    z = np.abs((want - want.mean(1, keepdims=True)) - (have - have.mean(1, keepdims=True))).max(1)
    told = (np.mean(label == other), given_away.mean(), moved.max(), moved.mean(), z.max(), z.mean())
    return Apart(*(float(x) for x in told))


def loss(float_right: Array, int8_right: Array, clusters: Array | None = None) -> Lost:
    """Of booleans [n] of the same sweeps.

    The interval of the difference of matched proportions is Agresti's and Min's (Statistics in Medicine 24, 2005): a
    half is added to each of the four counts, so that it is honest where the forms never differ, too. With `clusters`
    it is the bootstrap's over these (as score.interval) where that is wider.
    """
    difference = float_right.astype(float) - int8_right
    fewer, more = int((difference > 0).sum()), int((difference < 0).sum())
    n, worse, better = len(difference), fewer + 0.5, more + 0.5
    chance = sum(comb(fewer + more, k) for k in range(fewer, fewer + more + 1)) / 2 ** (fewer + more)
    middle = (worse - better) / (n + 2)
    reach = Z95 * np.sqrt(((worse + better) / (n + 2) - middle**2) / (n + 2))
    low, high = widened((middle - reach, middle + reach), difference, clusters)
    lost = float(difference.mean())
    return Lost(
        n, int(float_right.sum()), int(int8_right.sum()), lost, float(max(low, -1)), float(min(high, 1)), chance
    )


def table(parity: Parity) -> str:
    """All of it as text."""
    lines = []
    if (apart := parity.apart) and (lost := parity.lost):
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
            f"int8 {parity.int8_right}/{parity.sweeps}; a bundle holds no float form: tensors against themselves"
        )
    told = "no offset can move it" if parity.tap_sum == 0 else f"sums up to {parity.tap_sum}"
    lines.append(f"first convolution, integer taps of a filter and taxel: {told}")
    spread = " ".join(f"{'max' if p == 100 else f'{p:g} %':>9}" for p in PERCENTILES)
    lines.append(
        f"{'tensor':<36} {'against':<8} {spread} {'int8 from':>9} {'to':>9} {'step':>9} {'saturated':>9} {'SQNR dB':>8}"
    )
    for x in parity.layers:
        values = " ".join(f"{v:>9.3g}" for v in (*x.percentiles, x.low, x.high, x.step))
        lines.append(f"{x.tensor[:36]:<36} {x.against:<8} {values} {x.saturated:>9.5f} {x.sqnr_db:>8.1f}")
    return "\n".join(lines)


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
