"""Classifies the sweeps of a bundle's format by the stages of its answer.

The graph takes the raw counts; nothing is scaled here. A faulty window or an unknown material gets
a status with the reason instead of a label.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.early import EarlyNetwork
from palpate.answer.objects import (
    EnrolledLabels,
    FusedSweeps,
    ObjectSweeps,
    softmax,
)
from palpate.answer.pipeline import Context, Stage, StageInputs, run
from palpate.answer.taxels import TaxelWatch
from palpate.answer.unknown import ClassDistances, EarlyDistances, KnownMaterial
from palpate.answer.window import MANY_FULL
from palpate.bundle.bundle import GOLDEN_TOLERANCE, Bundle
from palpate.bundle.manifest import MEANS
from palpate.core.config import UNTIL_NEW_OBJECT, ClassifierConfig
from palpate.core.errors import BundleError
from palpate.core.observer import Observer
from palpate.core.types import Frames, Status, Sweep, SweepFormat, Verdict
from palpate.inference.session import ModelRunner, graph_input

if TYPE_CHECKING:
    from palpate.core.clock import Clock


RULE = ("fuse", "min_probability", "max_sweeps", "conflict", "object_s", "strangers")
"""The settings of the classifier that a sidecar holds as `rule`."""
UNCERTAIN = Status.UNSURE, Status.UNDECIDED, Status.UNKNOWN


def enrolled_labels(bundle: Bundle) -> EnrolledLabels:
    """The enrolled labels of a bundle, and its rule for them."""
    known, names = bundle.manifest.known, bundle.enrolled
    which = np.array([label in names for label in bundle.manifest.labels])
    return EnrolledLabels(which, (known and known.enrolled) or 0.0)


def class_distances(
    bundle: Bundle, strangers: str, *, displaced: bool = False
) -> ClassDistances | None:
    """The distances of a bundle, None without class means; those for displaced contacts likewise
    None without a rule for them. strangers: see ClassDistances."""
    m, classes = bundle.manifest, bundle.classes
    if not (m.known and classes) or (displaced and not m.displacement):
        return None
    rule = m.displacement if displaced else None
    return ClassDistances(classes, m.known, m.labels, rule, m.disturbances, strangers)


class Classifier(Observer):
    """Runs one bundle in one thread.

    Sweeps with the same `object` number above 0 are fused, until the object ends (FusedSweeps).
    Without NEW OBJECT each sweep is answered by itself. The sweeps of an object are a sequential
    test: `unsure` asks for one more sweep, until the probability is at least `min_probability` (ok)
    or `max_sweeps` were fused (undecided, the final answer).

    If the contact is displaced and the bundle has a rule for displacement, the rule's distances,
    limit, temperature and least probability apply. An unknown sweep is not fused: one touch next to
    the object must not invalidate the other sweeps.

    settings: a min_probability of 0 becomes the bundle's thresholds.unsure. slides: whether answers
    have the speed of the slide; without it they take less time. model: of a classifier with the
    same model. Raises BundleError if onnxruntime refuses the model. `bundle.load` has compared its
    inputs and outputs with the manifest.

    taxels: the broken taxels. As an observer of the loop it searches the stream for them; without a
    stream they are found in each window alone.
    """

    def __init__(
        self,
        bundle: Bundle,
        clock: Clock,
        settings: ClassifierConfig = UNTIL_NEW_OBJECT,
        slides: bool = True,
        model: ModelRunner | None = None,
    ) -> None:
        self.bundle, self._clock = bundle, clock
        least = settings.min_probability or bundle.manifest.thresholds.unsure
        self.settings = replace(settings, min_probability=least)
        labels, enrolled = bundle.manifest.labels, enrolled_labels(bundle)
        self._objects = ObjectSweeps(labels, self.settings, enrolled)
        m = bundle.manifest
        self.tare = m.tare
        self.taxels = TaxelWatch(m.format, m.thresholds, m.bridging, m.tare)
        self._means = class_distances(bundle, settings.strangers)
        self._outputs = ("logits", *("embedding",) * (self._means is not None))
        # early heads get a session of their own
        self.model_runner = model or ModelRunner(bundle.model, *self._outputs)
        given = StageInputs(
            *(labels, m.format, m.thresholds.contact, bool(m.unloaded), slides, least),
            enrolled.decided,
        )
        self._parts = m.stages(given, self.taxels, self._objects)
        network: list[Stage] = [NetworkStage(self, *self._outputs)]
        if self._means:
            displaced = class_distances(bundle, settings.strangers, displaced=True)
            network.append(KnownMaterial(self._means, displaced, self._objects))
        self._stages = self.stages(*network)

    def stages(self, *network: Stage) -> list[Stage]:
        """All stages in their order. network: give the logits and refuse unknown materials."""
        cleaning, measuring, judging = self._parts
        return [*cleaning, *measuring, *network, *judging]

    @property
    def rule(self) -> dict[str, Any]:
        """The classifier's settings under their names in the site file. They are written to
        sidecars, and a replay applies them again."""
        return {name: getattr(self.settings, name) for name in RULE}

    @property
    def format(self) -> SweepFormat:
        return self.bundle.format

    @property
    def model(self) -> str:
        return self.bundle.id

    def about(self) -> dict[str, Any]:
        """Entries for sidecars, so that a replay applies the same rule. tare: [R, C] raw counts.
        broken: silent and noisy taxels over the stream, [2, R, C]; absent if there are none."""
        broken = self.taxels.broken
        entries = {"tare": self.tare.tolist(), "bundle": self.bundle.id, "rule": self.rule}
        return entries | ({"broken": broken.kinds.tolist()} if broken else {})

    @property
    def degraded(self) -> str:
        """The taxels that are broken over the stream, "" if there are none."""
        return self.taxels.broken.text if self.taxels.broken else ""

    def frames(self, frames: Frames) -> None:
        """Search the frames of the stream for broken taxels."""
        self.taxels.put(frames, self.tare)

    def describe(self) -> list[object]:
        """The bundle's name, version, id and format."""
        return [
            self.bundle.manifest.name,
            self.bundle.manifest.version,
            self.bundle.id,
            self.bundle.format,
        ]

    def set_tare(self, taxels: NDArray[Any]) -> str:
        """Set the tare to the mean of frames [n, R, C], raw counts of the unloaded skin."""
        self.tare = taxels.mean(axis=0, dtype=np.float64)
        return f"largest {self.tare.max():.1f} raw counts"

    def logits(self, taxels: NDArray[Any]) -> NDArray[np.float32]:
        """Logits float32 [K] of one window of raw counts [T, R, C] or [T, R, C, A]."""
        network, *z = self.outputs(taxels, *self._outputs)
        return self._means.joined(network, z[0]) if self._means else network

    def outputs(self, taxels: NDArray[Any], *names: str) -> list[NDArray[np.float32]]:
        """The named outputs of the graph for one window of raw counts [T, R, C] or [T, R, C, A],
        without the leading axis of length 1."""
        m = self.bundle.manifest
        return self.model_runner(names, graph_input(m.input, taxels, m.format.rate_hz))

    def test(self) -> str:
        """The result of `self_test` in words."""
        return f"{len(self.bundle.golden)} golden sweeps differ by {self.self_test():.2g}"

    def self_test(self, *, checks: bool = True) -> float:
        """Run the golden sweeps; returns the largest difference of a probability.

        Raises BundleError if a label differs or the difference is above GOLDEN_TOLERANCE, and with
        `checks` if a sweep is refused that export did not refuse so: the network may be right where
        numpy, which computes all checks, is not.
        """
        computed = softmax(np.stack([self.logits(g) for g in self.bundle.golden]))
        expected = softmax(self.bundle.golden_logits)
        worst = float(np.abs(computed - expected).max())
        wrong = np.flatnonzero(computed.argmax(1) != expected.argmax(1))
        if len(wrong) or not worst <= GOLDEN_TOLERANCE:
            raise BundleError(
                f"golden sweeps {wrong.tolist()} get another label and probabilities differ "
                f"by {worst:.3g} "
                f"(limit {GOLDEN_TOLERANCE}): this machine does not run the model as it was "
                "exported"
            )
        if self._means:
            self._test_means(self._means)
        for k, now in enumerate(self.refusals() if checks else ()):
            before = next(iter(self.bundle.golden_refusals[k : k + 1]), Status.OK)
            if now not in (Status.OK, before):
                raise BundleError(
                    f"golden sweep {k} is refused as {now}, at export it was {before}: numpy "
                    "computes otherwise on this machine; install the locked version"
                )
        return worst

    def refusals(self) -> list[Status]:
        """The status of each golden sweep of trained labels that the stages refuse, ok for a sweep
        with a label. The stream does not count: neither its tare nor its broken taxels."""
        m, present, found = self.bundle.manifest, self._objects.present, []
        taxels = TaxelWatch(m.format, m.thresholds, m.bridging, m.tare)
        stages = [taxels, *(one for one in self._stages if one is not self.taxels)]
        for golden in self.bundle.golden[: len(self.bundle.golden) - len(self.bundle.enrolled)]:
            status = run(stages, self._context(golden, m.tare)).status
            found.append(Status.OK if status.classified else status)
        self._objects.present = present
        return found

    def _test_means(self, means: ClassDistances) -> None:
        """Raises BundleError if the class means and the model's own logits give a golden sweep
        different labels: then they do not belong together."""
        trained = len(self.bundle.golden) - len(self.bundle.enrolled)
        for golden in self.bundle.golden[:trained]:
            logits, z = self.outputs(golden, "logits", "embedding")
            by_logits, by_means = (
                logits.argmax(),
                means.logits(means.distances(z))[: len(logits)].argmax(),
            )
            if by_logits != by_means:
                labels = self.bundle.manifest.labels
                raise BundleError(
                    f"{MEANS} and the model's own logits call a golden sweep {labels[by_means]!r} "
                    f"and {labels[by_logits]!r}: they are not of one training; export the bundle "
                    "again"
                )

    def __call__(self, sweep: Sweep) -> Verdict:
        """The verdict on one sweep. A sweep with another status than ok keeps it and is not
        classified."""
        return self.verdict(self.judged(sweep, self._stages))

    def judged(self, sweep: Sweep, stages: Sequence[Stage]) -> Context:
        """The findings of the stages in one sweep; none if its status is not ok."""
        whole = len(sweep.frames) == self.bundle.manifest.format.window
        context = Context(sweep, sweep.frames.taxels, self.tare, whole, sweep.status)
        return run(stages, context) if sweep.status is Status.OK else context

    def unfinished(self, sweep: Sweep, stages: Sequence[Stage]) -> Context:
        """As `judged`; if the status is not ok, the sweep is not counted for its object."""
        before = self._objects.present
        context = self.judged(sweep, stages)
        if context.status is not Status.OK:
            self._objects.present = before
        return context

    def cleaned(self, taxels: NDArray[Any]) -> NDArray[Any]:
        """One window of raw counts [T, R, C] or [T, R, C, A] as the network sees it: broken taxels
        are bridged, and hum is removed."""
        context = self._context(taxels, self.tare)
        for stage in self._parts.cleaning:
            stage.apply(context)
        return context.taxels

    def rehearse(self) -> None:
        """Answer a golden sweep, as if there had been none. The result is dropped."""
        present = self._objects.present
        try:
            self.verdict(run(self._stages, self._context(self.bundle.golden[0], self.tare)))
        finally:
            self._objects.present = present

    def _context(self, taxels: NDArray[Any], tare: NDArray[Any]) -> Context:
        """The context of a whole window without a sweep."""
        none = Sweep(0, 0, 0, Status.OK, Frames.empty(self.format))
        return Context(none, taxels, tare, whole=True)

    def forget(self) -> None:
        """Forget the sweeps of the present object; the next sweep begins another object."""
        self._objects.present = FusedSweeps()

    def after(self, sweep: Sweep) -> int:
        """Number of the last sweep of the same object that had probabilities, 0 for none."""
        return self._objects.earlier(sweep).last

    def verdict(self, context: Context) -> Verdict:
        """The verdict on a judged sweep."""
        sweep, scores, label, best, second = context.sweep, context.scores, "", 0.0, 0.0
        if len(scores):
            label = self.bundle.manifest.labels[scores.argmax()]
            *_, second, best = sorted(scores.tolist())
        return Verdict.of(
            *(sweep, context.status, self._clock.now_ns(), self.bundle.id),
            label=label,
            probability=best,
            margin=best - second,
            scores=scores,
            fused=context.fused,
            detail=self._detail(context),
            own=context.own,
            displacement=context.displacement.text if context.displacement.off else None,
            degraded=context.degraded,
            after=context.after,
            measured_mm_s=context.slide.speed_mm_s,
            direction=context.slide.direction,
        )

    def _detail(self, context: Context) -> str:
        """The displacement, a speed outside of training if the answer is uncertain, the subject of
        the status, and what was removed or bridged."""
        trained, uncertain = self.bundle.manifest.speeds, context.status in UNCERTAIN
        hum, full, degraded = context.hum, context.full, context.degraded
        texts = (
            context.displacement.text,
            trained.outside(context.slide) if trained and uncertain else "",
            context.remark.text if context.remark else "",
            f"hum of {hum:.2g} counts removed" if hum else "",
            f"{full:.0%} of the counts at full scale" if full > MANY_FULL else "",
            f"degraded: {degraded}" if degraded else "",
        )
        return "; ".join(filter(None, texts))


class NetworkStage:
    """The stage that runs the network of a bundle on a whole window."""

    def __init__(self, classifier: Classifier, *outputs: str) -> None:
        self._classifier, self._outputs = classifier, outputs

    def apply(self, context: Context) -> None:
        """Compute logits, and the embedding if there are class means."""
        found = self._classifier.outputs(context.taxels, *self._outputs)
        context.logits = found[0]
        if len(found) > 1:
            context.embedding = found[1]


class EarlyExit:
    """Answers unfinished sweeps. steps: number of times in a window at which it can answer.

    Raises BundleError if the bundle has no early heads.
    """

    def __init__(self, classifier: Classifier) -> None:
        manifest = classifier.bundle.manifest
        if manifest.early is None:
            raise BundleError(
                f"bundle {manifest.name} {manifest.version} has no early heads, but "
                "classifier.early is true; set classifier.early = false, or name a bundle that was "
                "exported with them"
            )
        self._classifier, self.steps = classifier, len(manifest.early.least)
        classes, limits = classifier.bundle.classes, manifest.early.limits
        if manifest.known:  # the limits are strict already: a loose choice does not widen them
            growth = min(1.0, manifest.known.growth(classifier.settings.strangers))
            limits = tuple(growth * limit for limit in limits)
        distances = EarlyDistances(classes.early, limits) if classes and classes.early else None
        outputs = ("early", *("early_embedding",) * (distances is not None))
        classifier.model_runner.prepare(*outputs)  # now, so that the first sweep does not wait

        def network(taxels: NDArray[Any]) -> list[NDArray[np.float32]]:
            return classifier.outputs(taxels, *outputs)

        window = manifest.format.window
        self._stages = classifier.stages(EarlyNetwork(network, manifest.early, distances, window))

    def __call__(self, sweep: Sweep) -> Verdict | None:
        """The verdict on a sweep with share < 1, or None if the rest of the sweep is needed; then
        the sweep is not counted. It passes the stages of a whole window."""
        context = self.judged(sweep)
        return self._classifier.verdict(context) if context.status is Status.OK else None

    def judged(self, sweep: Sweep) -> Context:
        """The findings of the stages in a sweep with share < 1."""
        return self._classifier.unfinished(sweep, self._stages)
