"""The room of float against int8. In: both graphs of a model, sweeps with labels. Out: a Parity.

It tells how far the answers are apart, what accuracy is lost and how sure that is, and for every quantized tensor its
range and what saturates.

Both graphs are run as the box runs them, once more with their inner tensors shown. A bundle holds no float form; then
the tensors alone are told, each against its own value before it is rounded.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import comb
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.inference.classifier import softmax
from train.metrics.score import widened
from train.onnx_tools.layers import PERCENTILES, Layer, layers, outputs, tap_sum

Array = NDArray[Any]
LAYER_SWEEPS = 96
"""On so many sweeps, evenly drawn, the tensors are looked at."""
Z95 = 1.96


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
