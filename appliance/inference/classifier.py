"""Bundle + Sweep -> Verdict: looks at the window before the network does, runs it, fuses the sweeps of one object.

The graph takes the raw digits; nothing is scaled here. What is refused is refused by status, with its reason: a faulty
window, and a material that looks like none of those trained or enrolled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from appliance.bundle.bundle import GOLDEN_TOLERANCE, Bundle
from appliance.bundle.manifest import MEANS, Thresholds
from appliance.core.errors import BundleError
from appliance.core.types import Status, Sweep, Verdict
from appliance.inference.novelty import Means
from appliance.inference.session import run, session
from appliance.signal import features
from appliance.signal.contact import moved

if TYPE_CHECKING:
    from appliance.core.clock import Clock


_NONE = np.empty(0)
LEAST_PROBABILITY = 1e-12
"""What a probability counts as at least when sweeps are fused: one sure beyond float64 cannot veto all others."""


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
    They are a sequential test: `unsure` asks for one more sweep of the object, until the probability is at least
    `min_probability` (ok) or `max_sweeps` were fused (undecided: the answer is final). A robot that sweeps on all the same is answered
    by the same rule, with all sweeps of the object in it: more evidence is never thrown away.
    An unknown sweep takes no part in this. It has no probabilities that could be fused, and one touch beside the object
    must not undo what the object's other sweeps said.

    min_probability: 0 stands for the bundle's thresholds.unsure. max_sweeps: 0 for no limit.
    Raises BundleError where onnxruntime refuses the model; bundle.load has compared its input and outputs with the manifest.
    """

    def __init__(
        self, bundle: Bundle, clock: Clock, how: str = "product", min_probability: float = 0.0, max_sweeps: int = 0
    ) -> None:
        self.bundle = bundle
        self.min_probability = min_probability or bundle.manifest.thresholds.unsure
        self._clock, self._how, self._max_sweeps = clock, how, max_sweeps
        self._object = 0
        self._scores: list[NDArray[np.float64]] = []  # of the object's sweeps so far
        f = bundle.format
        self.tare: NDArray[np.float64] = np.zeros((f.rows, f.cols))
        self._session = session(bundle.model)
        self._input: str = self._session.get_inputs()[0].name
        known, classes = bundle.manifest.known, bundle.classes
        self._means = Means(classes, known, bundle.manifest.labels) if known and classes else None
        # onnxruntime computes them all, but makes arrays only of those that are asked for
        self._asked = ["logits"] * (not bundle.enrolled) + ["embedding"] * (self._means is not None)

    @property
    def rule(self) -> dict[str, Any]:
        """What the constructor was told, so that a recorded sweep is judged by it again."""
        return {"how": self._how, "sure": self.min_probability, "most_sweeps": self._max_sweeps}

    def logits(self, taxels: NDArray[Any]) -> NDArray[np.float32]:
        """Logits float32 [K] of one window [T, R, C] of digits."""
        return self._look(taxels)[0]

    def early(self, taxels: NDArray[Any]) -> NDArray[np.float32]:
        """Logits float32 [D, K0] after each step of one window [T, R, C] of digits, of a model that has this output.

        Frames that have not come yet may hold anything: the rows that need them mean nothing.
        """
        return self._run(["early"], taxels)[0]

    def embedding(self, taxels: NDArray[Any]) -> NDArray[np.float32]:
        """Embedding float32 [r] of one window [T, R, C] of digits, of a model that has this output."""
        return self._run(["embedding"], taxels)[0]

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
        if self._means:
            self._test_means(self._means)
        return worst

    def _test_means(self, means: Means) -> None:
        """Raises BundleError where the class means are not of the model: they name a golden sweep otherwise than its own
        logits, which know a little more of how materials vary."""
        for golden in self.bundle.golden:
            logits, z = self._run(["logits", "embedding"], golden)
            named, near = logits.argmax(), means.logits(means.distances(z))[: len(logits)].argmax()
            if named != near:
                labels = self.bundle.manifest.labels
                raise BundleError(
                    f"{MEANS} and the model's own logits call a golden sweep {labels[near]!r} and {labels[named]!r}: they "
                    "are not of one training; export the bundle again"
                )

    def __call__(self, sweep: Sweep) -> Verdict:
        """The verdict on one sweep. A sweep that the recorder refused keeps its status and is not classified."""
        finding = Finding(sweep.status)
        if sweep.status is Status.OK:
            finding = inspect(sweep.frames.taxels, self.tare, self.bundle.manifest.thresholds)
        if finding.status is not Status.OK:
            return self._verdict(sweep, finding)
        logits, strange = self._look(sweep.frames.taxels)
        if strange:
            return self._verdict(sweep, Finding(Status.UNKNOWN, strange))
        return self.conclude(sweep, softmax(logits))

    def conclude(self, sweep: Sweep, scores: NDArray[np.float64]) -> Verdict:
        """The verdict on a sound sweep with the probabilities `scores` [K], fused with its object's other sweeps."""
        if math.isnan(scores[0]):  # softmax leaves all or none; digits of a float skin can overflow the network
            return self._verdict(sweep, Finding(Status.UNKNOWN, "the model gives no number"))
        if sweep.object == 0 or sweep.object != self._object or self._how == "none":
            self._object, self._scores = sweep.object, []
        own, self._scores = scores, [*self._scores, scores]
        fused = len(self._scores)
        if fused > 1:
            scores = fuse(self._scores, self._how)
        status = Status.OK
        if scores.max() < self.min_probability:
            status = Status.UNDECIDED if 0 < self._max_sweeps <= fused else Status.UNSURE
        return self._verdict(sweep, Finding(status), scores, fused, own)

    def conclude_if_ok(self, sweep: Sweep, scores: NDArray[np.float64]) -> Verdict | None:
        """As `conclude` where that gives ok; else None, and the sweep does not count: it goes on."""
        before = self._object, self._scores
        verdict = self.conclude(sweep, scores)
        if verdict.status is Status.OK:
            return verdict
        self._object, self._scores = before
        return None

    def _run(self, outputs: list[str], taxels: NDArray[Any]) -> list[NDArray[np.float32]]:
        """These outputs of the graph for one window, without the leading 1."""
        given = features.given(self.bundle.manifest.input, taxels, self.bundle.format.rate_hz)
        return [out[0] for out in run(self._session, outputs, {self._input: given[None]})]

    def _look(self, taxels: NDArray[Any]) -> tuple[NDArray[np.float32], str]:
        """Logits [K] of one window, and how strange it is: "" where it looks like a material that is known."""
        gives = self._run(self._asked, taxels)
        if self._means is None:
            return gives[0], ""
        distances = self._means.distances(gives[-1])
        logits = self._means.logits(distances) if len(self._asked) == 1 else gives[0]
        return logits, self._means.strange(distances)

    def _moved(self, sweep: Sweep) -> str:
        """How far the contact lies from where training had it."""
        m = self.bundle.manifest
        return moved(sweep.frames.taxels, self.tare, m.thresholds.contact, m.place) if m.place else ""

    def _verdict(
        self, sweep: Sweep, finding: Finding, scores: NDArray[np.float64] = _NONE, fused: int = 0,
        own: NDArray[np.float64] = _NONE,
    ) -> Verdict:  # fmt: skip
        label, best, second = "", 0.0, 0.0
        moved = self._moved(sweep) if len(own) or finding.status is Status.UNKNOWN else ""
        if len(scores):
            order = np.argsort(-scores, kind="stable")  # of equals the first, as argmax has it
            label, best, second = self.bundle.manifest.labels[order[0]], scores[order[0]], scores[order[1]]
        now = self._clock.now_ns()
        return Verdict(
            sweep=sweep.id, time_ns=now, status=finding.status, label=label, probability=float(best),
            margin=float(best - second), scores=scores, fused=fused, lost=sweep.lost,
            latency_ns=now - sweep.complete_ns, bundle=self.bundle.id,
            detail="; ".join(filter(None, (moved, finding.detail))), share=sweep.share, own=own, moved=moved,
        )  # fmt: skip
