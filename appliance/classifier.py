"""Bundle + Sweep -> Verdict: looks at the window before the network does, runs it, fuses the sweeps of one object.

The graph takes the raw digits; nothing is scaled here. What is refused is refused by status, with its reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from . import features
from .bundle import GOLDEN_TOLERANCE, Bundle, Thresholds
from .errors import BundleError
from .sweep import Status, Sweep, Verdict

if TYPE_CHECKING:
    from .clock import Clock


LEAST_PROBABILITY = 1e-12
"""What a probability counts as at least when sweeps are fused: one that is sure beyond float64 cannot veto all others."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What a look at the window found: ok, or why it is refused, and where."""

    status: Status
    detail: str = ""


def _places(mask: Any) -> str:
    return "taxel " + " ".join(f"{r + 1}.{c + 1}" for r, c in np.argwhere(mask))


def inspect(taxels: NDArray[Any], tare: NDArray[np.float64], limits: Thresholds) -> Finding:
    """Look at a window [T, R, C] before it is classified; `tare` [R, C] is the unloaded skin in digits.

    A loaded taxel always moves: one that is constant is stuck. A silent taxel is dead where every direct neighbour is
    loaded; at the edge of the contact it may be silent by right. One that gives no numbers is dead anywhere.
    """
    series = np.ascontiguousarray(taxels.reshape(len(taxels), -1).T)  # [R*C, T]: three times as fast to reduce
    still = (series.min(axis=1) == series.max(axis=1)).reshape(tare.shape)
    load = series.mean(axis=1, dtype=np.float64).reshape(tare.shape) - tare
    if not np.isfinite(load).all():  # of a float skin: whatever the network makes of it is no answer
        return Finding(Status.DEAD_TAXEL, _places(~np.isfinite(load)))
    loaded = load >= limits.contact
    if not loaded.any():
        return Finding(Status.NO_CONTACT, f"strongest taxel {load.max():.1f} digits")
    full = (series >= limits.full_scale).mean(axis=1).reshape(tare.shape)
    stuck = still & loaded & (full < 1)
    if stuck.any():
        return Finding(Status.STUCK_TAXEL, _places(stuck))
    if full.mean() > limits.saturated:
        return Finding(Status.SATURATED, _places(full > 0))
    padded = np.ones((tare.shape[0] + 2, tare.shape[1] + 2), bool)
    padded[1:-1, 1:-1] = loaded
    dead = still & ~loaded & padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    if dead.sum() > limits.dead_taxels:
        return Finding(Status.DEAD_TAXEL, _places(dead))
    return Finding(Status.OK)


def softmax(logits: NDArray[Any]) -> NDArray[np.float64]:
    """Eq. 10 of the paper over the last axis, in float64."""
    z = np.asarray(logits, np.float64)
    e = np.exp(z - z.max(axis=-1, keepdims=True))
    result: NDArray[np.float64] = e / e.sum(axis=-1, keepdims=True)
    return result


def fuse(scores: list[NDArray[np.float64]], how: str) -> NDArray[np.float64]:
    """Fuse the probabilities [K] of several sweeps of one object into one [K].

    `product` (Bayes with independent sweeps; Tulbure and Baeuml 2018) is the default. `vote` is the paper's sec. V.D:
    the most frequent label wins, of equally frequent ones the one seen first: two sweeps never differ from the first.
    """
    if how == "product":
        return softmax(np.log(np.maximum(scores, LEAST_PROBABILITY)).sum(axis=0))
    labels = [int(np.argmax(s)) for s in scores]
    votes = np.bincount(labels, minlength=len(scores[0])) / len(labels)
    votes[max(labels, key=lambda k: votes[k])] += 1e-9  # max() keeps the first of equals; argmax must agree
    return votes


class Classifier:
    """Runs one bundle in one thread.

    Sweeps with the same `object` number above 0 are fused: a robot that never says NEW OBJECT gets each by itself.
    Raises BundleError where onnxruntime refuses the model or its input and output are not the manifest's.
    """

    def __init__(self, bundle: Bundle, clock: Clock, how: str = "product") -> None:
        self.bundle = bundle
        self._clock = clock
        self._how = how
        self._object = 0
        self._scores: list[NDArray[np.float64]] = []  # of the object's sweeps so far
        f = bundle.format
        self.tare: NDArray[np.float64] = np.zeros((f.rows, f.cols))
        self._session = session(bundle.model)
        self._input = _check_signature(self._session, bundle)

    def logits(self, taxels: NDArray[Any]) -> NDArray[np.float32]:
        """Logits float32 [K] of one window [T, R, C] of digits."""
        kind = self.bundle.manifest.input
        given = features.given(kind, taxels, self.bundle.format.rate_hz)
        result: NDArray[np.float32] = self._session.run(None, {self._input: given[None]})[0][0]
        return result

    def self_test(self) -> float:
        """Run the golden sweeps; the largest difference of a probability. Raises BundleError where a label differs."""
        have = softmax(np.stack([self.logits(g) for g in self.bundle.golden]))
        want = softmax(self.bundle.golden_logits)
        worst = float(np.abs(have - want).max())
        wrong = np.flatnonzero(have.argmax(1) != want.argmax(1))
        if len(wrong) or not worst <= GOLDEN_TOLERANCE:
            raise BundleError(
                f"golden sweeps {wrong.tolist()} get another label and probabilities differ by {worst:.3g} "
                f"(limit {GOLDEN_TOLERANCE}): this machine does not run the model as it was exported"
            )
        return worst

    def __call__(self, sweep: Sweep) -> Verdict:
        """The verdict on one sweep. A sweep that the recorder refused keeps its status and is not classified."""
        finding = Finding(sweep.status)
        if sweep.status is Status.OK:
            finding = inspect(sweep.frames.taxels, self.tare, self.bundle.manifest.thresholds)
        if finding.status is not Status.OK:
            return self._verdict(sweep, finding, np.empty(0), 0)
        if sweep.object == 0 or sweep.object != self._object or self._how == "none":
            self._object, self._scores = sweep.object, []
        self._scores.append(softmax(self.logits(sweep.frames.taxels)))
        fused = len(self._scores)
        scores = fuse(self._scores, self._how) if fused > 1 else self._scores[0]
        if scores.max() < self.bundle.manifest.thresholds.unsure:
            finding = Finding(Status.UNSURE)
        return self._verdict(sweep, finding, scores, fused)

    def _verdict(self, sweep: Sweep, finding: Finding, scores: NDArray[np.float64], fused: int) -> Verdict:
        label, best, second = "", 0.0, 0.0
        if len(scores):
            order = np.argsort(scores)
            label, best, second = self.bundle.manifest.labels[order[-1]], scores[order[-1]], scores[order[-2]]
        now = self._clock.now_ns()
        return Verdict(
            sweep=sweep.id, time_ns=now, status=finding.status, label=label, probability=float(best),
            margin=float(best - second), scores=scores, fused=fused, lost=sweep.lost,
            latency_ns=now - sweep.complete_ns, bundle=self.bundle.id, detail=finding.detail,
        )  # fmt: skip


def session(model: bytes) -> ort.InferenceSession:
    """One thread, no spinning, errors only, telemetry off: a quiet session that leaves the core to the sensor."""
    ort.disable_telemetry_events()
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    options.enable_cpu_mem_arena = False
    try:
        return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as e:  # onnxruntime raises its own classes, which share no base but Exception
        raise BundleError(f"onnxruntime {ort.__version__} refuses the model: {str(e).strip()[:200]}") from e


def _check_signature(run: ort.InferenceSession, bundle: Bundle) -> str:
    """The name of the one input, after its shape and type were compared with the manifest."""
    m, f = bundle.manifest, bundle.format
    if m.input == "raw":
        tensor = {
            "uint8": "tensor(uint8)",
            "int16": "tensor(int16)",
            "uint16": "tensor(uint16)",
            "float32": "tensor(float)",
        }
        want = [([1, f.window, f.rows, f.cols], tensor[f.dtype])]
    else:
        want = [([1, len(features.compute(m.input, bundle.golden[0], f.rate_hz))], "tensor(float)")]
    have = [(i.shape, i.type) for i in run.get_inputs()]
    gives = [(o.shape, o.type) for o in run.get_outputs()]
    if have != want or gives != [([1, len(m.labels)], "tensor(float)")]:
        raise BundleError(
            f"the model takes {have} and gives {gives}; the manifest asks for {want} and {len(m.labels)} logits"
        )
    name: str = run.get_inputs()[0].name
    return name
