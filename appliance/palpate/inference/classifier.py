"""Classifies the sweeps of a bundle's format.

Each window is checked, classified, and fused with the other sweeps of its object. The graph takes
the raw counts; nothing is scaled here. Broken taxels are bridged by their neighbours, as far as the
bundle tolerates it. A faulty window or an unknown material gets a status with the reason instead of
a label.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle.bundle import GOLDEN_TOLERANCE, Bundle
from palpate.bundle.manifest import MEANS
from palpate.core.errors import BundleError
from palpate.core.observer import Observer
from palpate.core.types import Frames, Status, Sweep, SweepFormat, Verdict, entries
from palpate.inference.novelty import ClassDistances, UnknownSweeps
from palpate.inference.objects import LEAST_PROBABILITY as LEAST_PROBABILITY
from palpate.inference.objects import EnrolledLabels, FusedSweeps, ObjectRule, ObjectSweeps
from palpate.inference.objects import fuse as fuse
from palpate.inference.objects import softmax as softmax
from palpate.inference.session import ModelRunner
from palpate.inference.taxel_watch import TaxelWatch
from palpate.signal import disturbances, features
from palpate.signal.contact import Displacement, displacement
from palpate.signal.hum import HumFilter
from palpate.signal.slide import NO_PATTERN, NO_PITCH, Slide, SlideMeter
from palpate.signal.vibration import PARTS, vibration
from palpate.signal.window_check import MANY_FULL, Finding

if TYPE_CHECKING:
    from palpate.core.clock import Clock


STILL = f"{NO_PATTERN}, as with a finger that rests"
_NONE, _NO_SLIDE, _IN_PLACE = np.empty(0), Slide(), Displacement()


def enrolled_labels(bundle: Bundle) -> EnrolledLabels:
    """The enrolled labels of a bundle, and its rule for them."""
    known, names = bundle.manifest.known, bundle.enrolled
    which = np.array([label in names for label in bundle.manifest.labels])
    return EnrolledLabels(which, (known and known.enrolled) or 0.0)


def _degraded(finding: Finding) -> str:
    return finding.degraded and f"degraded: {finding.degraded}"


@dataclass(frozen=True, slots=True)
class Touched:
    """Where and how the finger touched in a sweep. hum: that was removed, in counts. full: share of
    the counts at full scale. disturbed: values of the disturbances by name."""

    displacement: Displacement = _IN_PLACE
    slide: Slide = _NO_SLIDE
    hum: float = 0.0
    full: float = 0.0
    disturbed: Mapping[str, float] = field(default_factory=dict)


class Classifier(Observer):
    """Runs one bundle in one thread.

    Sweeps with the same `object` number above 0 are fused, until the object ends (ObjectRule).
    Without NEW OBJECT each sweep is answered by itself. The sweeps of an object are a sequential
    test: `unsure` asks for one more sweep, until the probability is at least `min_probability` (ok)
    or `max_sweeps` were fused (undecided, the final answer).

    If the contact is displaced and the bundle has a rule for displacement, the rule's distances,
    limit, temperature and least probability apply. An unknown sweep is not fused: it has no
    probabilities, and one touch beside the object must not invalidate the other sweeps.

    fusion: "product", "vote" (see `fuse`) or "none". min_probability: 0 means the bundle's
    thresholds.unsure. max_sweeps, conflict, object_s: as in ObjectRule; by default only NEW OBJECT
    ends an object. slides: whether answers have the speed of the slide; without it they take less
    time. Raises BundleError if onnxruntime refuses the model. `bundle.load` has compared its inputs
    and outputs with the manifest.

    taxels: the broken taxels. As an observer of the loop it searches the stream for them; without a
    stream they are found in each window alone.
    """

    def __init__(
        self,
        bundle: Bundle,
        clock: Clock,
        fusion: str = "product",
        min_probability: float = 0.0,
        max_sweeps: int = 0,
        conflict: str = "fuse",
        object_s: float = 0.0,
        slides: bool = True,
    ) -> None:
        self.bundle = bundle
        self.min_probability = min_probability or bundle.manifest.thresholds.unsure
        self._clock = clock
        self._objects = ObjectSweeps(
            bundle.manifest.labels,
            fusion,
            ObjectRule(max_sweeps, conflict, object_s),
            enrolled_labels(bundle),
        )
        self.tare = bundle.manifest.tare
        self.taxels = TaxelWatch(bundle.manifest)
        known, classes = bundle.manifest.known, bundle.classes
        allowed = bundle.manifest.disturbances
        self._hum = HumFilter(bundle.format) if allowed and allowed.hum else None
        self._means = (
            ClassDistances(classes, known, bundle.manifest.labels, disturbances=allowed)
            if known and classes
            else None
        )
        self._unknown = UnknownSweeps(self._means) if self._means else None
        rule, place = bundle.manifest.displacement, bundle.manifest.contact
        self._pitch_mm = place.pitch_mm if place and slides else None
        limits = bundle.manifest.sliding
        self._pattern = limits.pattern if limits else None
        # the height of a pattern, and taxels a second, do not depend on the pitch
        measured = self._pattern or allowed
        self._slide = SlideMeter(bundle.format, self._pitch_mm or (1.0 if measured else None))
        self._displaced_means = (
            ClassDistances(classes, known, bundle.manifest.labels, rule, allowed)
            if rule and known and classes
            else None
        )
        self._outputs = ("logits", *("embedding",) * (self._means is not None))
        # early heads get a session of their own
        self._model = ModelRunner(bundle.model, *self._outputs)

    @property
    def rule(self) -> dict[str, Any]:
        """The classifier's settings under their names in the site file. They are written to
        sidecars, and a replay applies them again."""
        return {
            "fuse": self._objects.fusion,
            "min_probability": self.min_probability,
            **entries(self._objects.rule),
        }

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
        network, *z = self._run(self._outputs, taxels)
        return self._means.joined(network, z[0]) if self._means else network

    def early(self, taxels: NDArray[Any]) -> NDArray[np.float32]:
        """Logits float32 [D, K0] after each step of one window of raw counts [T, R, C] or [T, R, C,
        A]; the model must have this output.

        Frames that have not arrived yet may have any value; rows that depend on them are
        meaningless.
        """
        return self.unfinished(taxels, "early")[0]

    def unfinished(self, taxels: NDArray[Any], *outputs: str) -> list[NDArray[np.float32]]:
        """As `early`, with other outputs of the model that have a row for each step."""
        return self._run(outputs, taxels)

    def prepare(self, *outputs: str) -> None:
        """Open the session of these outputs now, so that the first sweep does not wait for it."""
        self._model.prepare(*outputs)

    def network(self, taxels: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The model's own logits [K0] of the trained labels, and the embedding [r], of one window;
        the model must have both outputs."""
        logits, z = self._run(("logits", "embedding"), taxels)
        return logits, z

    def embedding(self, taxels: NDArray[Any]) -> NDArray[np.float32]:
        """Embedding float32 [r] of one window of raw counts [T, R, C] or [T, R, C, A]; the model
        must have this output."""
        return self._run(("embedding",), taxels)[0]

    def test(self) -> str:
        """The result of `self_test` in words."""
        return f"{len(self.bundle.golden)} golden sweeps differ by {self.self_test():.2g}"

    def self_test(self) -> float:
        """Run the golden sweeps; returns the largest difference of a probability.

        Raises BundleError if a label differs or the difference is above GOLDEN_TOLERANCE.
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
        return worst

    def _test_means(self, means: ClassDistances) -> None:
        """Raises BundleError if the class means and the model's own logits give a golden sweep
        different labels: then they do not belong together."""
        trained = len(self.bundle.golden) - len(self.bundle.enrolled)
        for golden in self.bundle.golden[:trained]:
            logits, z = self.network(golden)
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
        finding = Finding(sweep.status)
        if sweep.status is Status.OK:
            sweep, finding = self.repaired(sweep)
        if finding.status is not Status.OK:
            return self._verdict(sweep, finding)
        taxels, hum = self.without_hum(sweep.frames.taxels)
        if hum:
            sweep = replace(sweep, frames=replace(sweep.frames, taxels=taxels))
        touch = replace(self._touch(sweep, finding.mean), hum=hum, full=finding.full)
        touch = replace(touch, disturbed=self._disturbed(sweep, touch, finding.mean))
        logits, novelty = self._classify(sweep, touch)
        if novelty:
            finding = replace(finding, status=Status.UNKNOWN, detail=novelty)
            return self._verdict(sweep, finding, touch=touch)
        return self.conclude(sweep, softmax(logits), touch, finding.degraded)

    def repaired(self, sweep: Sweep) -> tuple[Sweep, Finding]:
        """A sweep with frames, its broken taxels bridged, and the result of its check."""
        taxels, finding = self.taxels.repaired(sweep.frames.taxels, self.tare)
        if not finding.degraded:
            return sweep, finding
        return replace(sweep, frames=replace(sweep.frames, taxels=taxels)), finding

    def without_hum(self, taxels: NDArray[Any]) -> tuple[NDArray[Any], float]:
        """One window of raw counts [T, R, C] or [T, R, C, A] without the hum of the mains, and the
        amplitude of this hum in counts."""
        allowed = self.bundle.manifest.disturbances
        if not (self._hum and allowed and allowed.hum):
            return taxels, 0.0
        return self._hum(taxels, allowed.hum)

    def conclude(
        self,
        sweep: Sweep,
        scores: NDArray[np.float64],
        touch: Touched | None = None,
        degraded: str = "",
    ) -> Verdict:
        """The verdict on a valid sweep with the probabilities `scores` float64 [K], fused with the
        other sweeps of the object.

        touch: result of `_touch`; None: it is computed here. degraded: as in Finding.
        """
        if touch is None:
            touch = self._touch(sweep, sweep.frames.taxels.mean(axis=0, dtype=np.float64))
        if math.isnan(scores[0]):  # all are NaN or none; float32 counts can overflow the network
            finding = Finding(Status.UNKNOWN, "the model gives no number", degraded)
            return self._verdict(sweep, finding, touch=touch)
        if far := self._too_far(touch.displacement):
            return self._verdict(sweep, Finding(Status.UNKNOWN, far, degraded), touch=touch)
        # bridged taxels move with their neighbours, which hides the pattern
        patterned = bool(degraded) or self._patterned(sweep, touch.slide)
        named = int(self._objects.enrolled.decided(scores).argmax())
        if rests := self._rests(sweep, touch, named) if patterned else STILL:
            return self._verdict(sweep, Finding(Status.NO_SLIDE, rests, degraded), touch=touch)
        fused = self._objects.put(sweep, scores)
        if fused.refused:
            finding = Finding(Status.CONFLICT, fused.conflict, degraded)
            return self._verdict(sweep, finding, own=scores, touch=touch, after=fused.after)
        status = Status.OK
        if fused.scores.max() < self.least(displaced=bool(touch.displacement.text)):
            status = Status.UNDECIDED if fused.final else Status.UNSURE
        finding = Finding(status, fused.conflict, degraded)
        return self._verdict(sweep, finding, fused.scores, fused.fused, scores, touch, fused.after)

    def least(self, *, displaced: bool) -> float:
        """Least probability for status ok. displaced: whether the contact is displaced."""
        rule = self.bundle.manifest.displacement
        return max(self.min_probability, rule.unsure if displaced and rule else 0)

    def forget(self) -> None:
        """Forget the sweeps of the present object; the next sweep begins another object."""
        self._objects.present = FusedSweeps()

    def conclude_if_ok(
        self, sweep: Sweep, scores: NDArray[np.float64], degraded: str = ""
    ) -> Verdict | None:
        """The verdict of `conclude` on an unfinished sweep if its status is ok; otherwise None, and
        the sweep is not counted."""
        before = self._objects.present
        verdict = self.conclude(sweep, scores, degraded=degraded)
        if verdict.status is Status.OK:
            return verdict
        self._objects.present = before
        return None

    def _run(self, outputs: tuple[str, ...], taxels: NDArray[Any]) -> list[NDArray[np.float32]]:
        """The named outputs of the graph for one window, without the leading axis of length 1."""
        graph_input = features.graph_input(
            self.bundle.manifest.input, taxels, self.bundle.format.rate_hz
        )
        return self._model(outputs, graph_input)

    def _classify(self, sweep: Sweep, touch: Touched) -> tuple[NDArray[np.float32], str]:
        """Logits [K] of one window, and a message with its distance from the known materials, ""
        if the material is known.

        Changes caused by a displacement of the contact, or by disturbances of the sweep, do not
        make a material unknown.
        """
        means = self._means
        if touch.displacement.text and self._displaced_means:
            means = self._displaced_means
        if means is None:
            return self.logits(sweep.frames.taxels), ""
        network, z = self.network(sweep.frames.taxels)
        logits, allowed = means.joined(network, z), self.bundle.manifest.disturbances
        if untried := allowed.untried(touch.disturbed) if allowed else "":
            return logits, untried
        novelty = means.novelty(z, touch.disturbed)
        if novelty and means is self._means and self._unknown:
            alike = self._unknown.put(sweep.id, z)
            novelty += f"; as sweep {alike}" * (alike > 0)
        return logits, novelty

    def _disturbed(
        self, sweep: Sweep, touch: Touched, mean: NDArray[np.float64] | None
    ) -> dict[str, float]:
        """The disturbances of a sweep by name, if the bundle allows something for them. mean:
        counts of the window, see Finding."""
        m, taxels = self.bundle.manifest, sweep.frames.taxels
        if not m.disturbances:
            return {}
        found = {
            "lost": sweep.lost / len(taxels),
            "hum": disturbances.hum(touch.hum),
            "noise": disturbances.noise(taxels),
            "speed": disturbances.speed(touch.slide.taxels_s),
        }
        if mean is not None:
            tare = self.tare if m.unloaded else np.zeros_like(self.tare)
            found["load"] = disturbances.load(mean, tare)
        return found

    def _touch(self, sweep: Sweep, mean: NDArray[np.float64] | None) -> Touched:
        """The displacement of the contact from its positions in training, and the slide, which is
        measured in whole windows only. mean: counts [R, C] or [R, C, A] of the window."""
        m, taxels = self.bundle.manifest, sweep.frames.taxels
        slide = self._slide(taxels) if len(taxels) == m.format.window else _NO_SLIDE
        if not self._pitch_mm:
            slide = Slide(height=slide.height, why=NO_PITCH, taxels_s=slide.taxels_s)
        if mean is None or m.contact is None or m.thresholds.contact is None:
            return Touched(slide=slide)
        return Touched(displacement(mean, self.tare, m.thresholds.contact, m.contact), slide)

    def _patterned(self, sweep: Sweep, slide: Slide) -> bool:
        """False if a whole window lacks the pattern that passed in all training sweeps."""
        whole = len(sweep.frames) == self.bundle.format.window and not self._slide.why
        return not (self._pattern and whole and slide.height < self._pattern)

    def _rests(self, sweep: Sweep, touch: Touched, label: int) -> str:
        """A message if the finger rests in a part of the window so far, where a slide over the
        label with this number vibrates more; else "". A load beyond that of training counts as that
        of training: vibrations grow less than it."""
        m, taxels = self.bundle.manifest, sweep.frames.taxels
        parts = PARTS * len(taxels) // m.format.window
        if m.sliding is None or not parts or len(taxels) < 2 * parts:
            return ""
        beyond = m.disturbances.beyond("load", touch.disturbed) if m.disturbances else 0.0
        found = m.sliding.resting(vibration(taxels, self.tare, parts) + beyond, label)
        if not found:
            return ""
        where = " ".join(map(str, found))
        return f"hardly any vibration in part {where} of {PARTS}, less than {m.labels[label]} gives"

    def _too_far(self, displaced: Displacement) -> str:
        """A message if the contact is displaced further than any training copy, else ""."""
        rule = self.bundle.manifest.displacement
        if not (rule and rule.farthest_mm and displaced.mm > rule.farthest_mm):
            return ""
        return f"named up to {rule.farthest_mm:.1f} mm"

    def _verdict(
        self,
        sweep: Sweep,
        finding: Finding,
        scores: NDArray[np.float64] = _NONE,
        fused: int = 0,
        own: NDArray[np.float64] = _NONE,
        touch: Touched = Touched(),
        after: int = 0,
    ) -> Verdict:
        label, best, second = "", 0.0, 0.0
        if len(scores):
            order = np.argsort(-scores, kind="stable")  # the first of equal scores, as argmax does
            label = self.bundle.manifest.labels[order[0]]
            best, second = scores[order[:2]]
        now = self._clock.now_ns()
        return Verdict(
            sweep=sweep.id,
            time_ns=now,
            status=finding.status,
            label=label,
            probability=float(best),
            margin=float(best - second),
            scores=scores,
            fused=fused,
            lost=sweep.lost,
            latency_ns=now - sweep.complete_ns,
            bundle=self.bundle.id,
            detail=self._detail(finding, touch),
            share=sweep.share,
            own=own,
            displacement=touch.displacement.text,
            degraded=finding.degraded,
            after=after,
            speed_mm_s=sweep.speed_mm_s,
            force_n=sweep.force_n,
            measured_mm_s=touch.slide.speed_mm_s,
            direction=touch.slide.direction or None,
        )

    def _detail(self, finding: Finding, touch: Touched) -> str:
        """The displacement, a speed outside of training if the answer is uncertain, the finding."""
        trained = self.bundle.manifest.speeds
        uncertain = finding.status in (Status.UNSURE, Status.UNDECIDED, Status.UNKNOWN)
        untrained = trained.outside(touch.slide) if trained and uncertain else ""
        hum = f"hum of {touch.hum:.2g} counts removed" if touch.hum else ""
        full = f"{touch.full:.0%} of the counts at full scale" if touch.full > MANY_FULL else ""
        texts = touch.displacement.text, untrained, finding.detail, hum, full, _degraded(finding)
        return "; ".join(filter(None, texts))
