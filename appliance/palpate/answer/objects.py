"""Fuses the sweeps of one object, and finds where an object ends without NEW OBJECT."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.pipeline import Context, Refusal
from palpate.core.config import ClassifierConfig
from palpate.core.status import LEAST_PROBABILITY, Reason, Remark
from palpate.core.types import Status, Sweep

Array = NDArray[Any]

STRONG = 10.0
"""Least Bayes factor for another object: strong evidence (Jeffreys 1961, appendix B). Decision 6
compares it with other rules."""
UNLIKE = 0.8
"""Largest difference of the distances of two sweeps of one object, see `unlike`. It parts up to
0.7 % of known sweeps in ten sets, 1.2 % in one, and as many are answered. Of strangers after a
known fabric without NEW OBJECT 16 and 19 % become surer than alone, in place of 24 and 30 %. With
0.5 it is 13 and 14 %, and 1.3 points fewer are answered in one set."""
ALIKE = 0.5
"""The same for two doubtful sweeps that are judged together. Over eleven sets .6 points fewer of
known second sweeps are answered and 1.8 of unknown ones; without NEW OBJECT, .1 fewer unknown ones
after a known material, and 1.0 of known ones after an unknown one. With 0.8: .7, 2.5; .4, 2.6."""


def softmax(logits: NDArray[Any]) -> NDArray[np.float64]:
    """Probabilities of logits along the last axis, in float64 (paper, eq. 10)."""
    z = np.asarray(logits, np.float64)
    e = np.exp(z - np.maximum.reduce(z, axis=-1, keepdims=True))
    result: NDArray[np.float64] = e / np.add.reduce(e, axis=-1, keepdims=True)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class EnrolledLabels:
    """The rule that protects trained labels from enrolled ones.

    which: bool [K], the labels that were enrolled. least: as Known.enrolled; 0 for no rule.
    """

    which: NDArray[np.bool_]
    least: float = 0.0

    def decided(self, p: NDArray[np.float64]) -> NDArray[np.float64]:
        """The probabilities `p` [..., K] for an answer. Below the least probability the enrolled
        labels get 0, and the trained ones are as without them.

        It is applied to the sweeps of an object together: several sweeps that each are not enough
        may be enough.
        """
        if not (self.least and self.which.any()):
            return p
        trained = np.where(self.which, 0, p)
        total = trained.sum(axis=-1, keepdims=True)
        return np.where(1 - total >= self.least, p, trained / np.maximum(total, 1 - self.least))


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Sums over the sweeps of one object. Time and memory do not depend on the number of sweeps.

    sweeps: their number. probabilities: float64 [K], fused; a single sweep keeps its own. sums:
    float64 [K], of log probabilities, or the votes for each label. order: labels in the order of
    their first vote.
    """

    sweeps: int
    probabilities: NDArray[np.float64]
    sums: NDArray[np.float64]
    order: tuple[int, ...] = ()

    @classmethod
    def of(cls, own: NDArray[np.float64], fusion: str, before: Evidence | None = None) -> Evidence:
        """The evidence `before`, if there is any, and one more sweep with the probabilities `own`
        float64 [K].

        fusion: "product" (Bayes with independent sweeps; Tulbure and Baeuml 2018), or "vote"
        (paper, sec. V.D): the most frequent label wins. If two labels are equally frequent, the
        label that occurred first wins, so with two sweeps the first decides.
        """
        sweeps, order = (before.sweeps if before else 0) + 1, before.order if before else ()
        if fusion == "product":
            sums = np.log(np.maximum(own, LEAST_PROBABILITY))
        else:
            label = int(own.argmax())
            sums = (np.arange(len(own)) == label).astype(np.float64)
            order = order if label in order else (*order, label)
        if not before:
            return cls(sweeps, own, sums, order)
        sums = before.sums + sums
        if fusion == "product":
            return cls(sweeps, softmax(sums), sums)
        votes = sums / sweeps
        # max() keeps the first of equals; argmax must agree
        votes[max(order, key=lambda k: votes[k])] += 1e-9
        return cls(sweeps, votes, sums, order)


@dataclass(frozen=True, slots=True, eq=False)
class FusedSweeps:
    """The sweeps of the present object.

    object: its number, as in Sweep; 0 before the first NEW OBJECT. evidence: of the fused sweeps.
    last, end_ns: number and end of the last sweep that had probabilities, whether it was fused or
    refused; an unknown one changes the number alone. far: as of Context, of the last fused sweep.
    doubtful: the last sweep, if it was that; `far` is then Context.doubtful.
    """

    object: int = 0
    evidence: Evidence | None = None
    last: int = 0
    end_ns: int = 0
    far: Array = field(default_factory=lambda: np.empty(0))
    doubtful: FusedSweeps | None = None

    def ended(self, start_ns: int, rule: ClassifierConfig) -> bool:
        """Whether a sweep that starts at `start_ns` comes after a pause, or after `max_sweeps`
        sweeps."""
        paused = 0 < rule.object_s * 1e9 < start_ns - self.end_ns
        if rule.conflict == "fuse" or not (rule.max_sweeps and self.evidence):
            return paused
        return paused or rule.max_sweeps <= self.evidence.sweeps


def contradicts(own: NDArray[np.float64], fused: NDArray[np.float64]) -> bool:
    """Whether a sweep with the probabilities `own` float64 [K] is of another object than the sweeps
    whose fused probabilities are `fused` float64 [K].

    Compares two cases: the sweep is of this object, or of an object whose material is drawn anew
    from K equally frequent ones. The ratio of their likelihoods is K * sum(fused * own). It is near
    1 if the sweep or the sweeps before it are quite unsure.
    """
    return bool(len(own) * (fused @ own) < 1 / STRONG)


def unlike(far: Array, last: Array, most: float = UNLIKE) -> bool:
    """Whether a sweep is of another object than the last one, by their distances [K] (Context.far),
    though its label may be the same: a stranger lies elsewhere. An unfinished sweep has none."""
    return bool(len(far) and len(last) and ((far - last) ** 2).mean() > most**2)


class ObjectSweeps:
    """Fuses the sweeps of one object after the other. labels: [K], for messages. rule: how they are
    fused, and when an object ends."""

    def __init__(
        self, labels: Sequence[str], rule: ClassifierConfig, enrolled: EnrolledLabels
    ) -> None:
        self.rule, self.enrolled = rule, enrolled
        self.present = FusedSweeps()
        self._labels = labels

    def fuses(self, sweep: Sweep) -> bool:
        """Whether a sweep is judged with others of its object."""
        return sweep.object > 0 and self.rule.fuse != "none"

    def earlier(self, sweep: Sweep) -> FusedSweeps:
        """The sweeps before this one of its object."""
        same = self.fuses(sweep) and sweep.object == self.present.object
        return self.present if same else FusedSweeps(sweep.object)

    def joined(self, context: Context) -> Array | None:
        """The mean of Context.doubtful of a doubtful sweep and of the sweep before it, if that is
        doubtful, too, and of one object; None if not. The context gets `own` and `after`: a replay
        finds by them what the answer may depend on."""
        earlier, own = self.earlier(context.sweep), context.doubtful
        context.own, context.after = softmax(context.logits), earlier.last
        last = earlier.doubtful
        if last is None or last.ended(context.sweep.start_ns, self.rule):
            return None
        if self.rule.conflict != "fuse" and unlike(own, last.far, ALIKE):
            return None
        return (own + last.far) / 2

    def doubted(self, context: Context) -> None:
        """Remember a sweep that is unknown and doubtful."""
        sweep = context.sweep
        last = FusedSweeps(sweep.object, end_ns=sweep.stop_ns, far=context.doubtful)
        self.present = replace(self.earlier(sweep), last=sweep.id, doubtful=last)

    def apply(self, context: Context) -> Refusal | None:
        """Fuse a sweep with the earlier sweeps of its object; refuse it if it contradicts them."""
        sweep, own, earlier = context.sweep, context.probabilities, self.earlier(context.sweep)
        before = None if earlier.ended(sweep.start_ns, self.rule) else earlier.evidence
        conflict = self._conflict(context, before, earlier.far)
        context.own, context.after = own, earlier.last
        if conflict and self.rule.conflict == "refuse":
            self.present = replace(earlier, last=sweep.id, end_ns=sweep.stop_ns)
            return Refusal(Status.CONFLICT, conflict)
        votes = self.rule.fuse == "vote"  # each sweep votes for the label that it is given
        kept = Evidence.of(
            self.enrolled.decided(own) if votes else own,
            self.rule.fuse,
            None if conflict else before,
        )
        now = FusedSweeps(sweep.object, kept, sweep.id, sweep.stop_ns, context.far)
        if len(context.doubtful):  # replace() takes time
            now = replace(now, doubtful=replace(now, far=context.doubtful))
        self.present = now
        fused = kept.probabilities
        context.scores = fused if votes else self.enrolled.decided(fused)
        context.fused, context.remark = kept.sweeps, conflict
        context.final = 0 < self.rule.max_sweeps <= kept.sweeps
        return None

    def _conflict(self, context: Context, before: Evidence | None, far: Array) -> Remark | None:
        """A remark if the sweep contradicts the sweeps `before` with the distances `far`, or is
        unlike them; None if it can be fused with them."""
        if not before or self.rule.conflict == "fuse":
            return None
        own, fused = context.probabilities, before.probabilities
        if not (contradicts(own, fused) or unlike(context.far, far)):
            return None
        label, before_it = (
            self._labels[int(self.enrolled.decided(p).argmax())] for p in (own, fused)
        )
        return Remark(Reason.ANOTHER_OBJECT, {"label": label, "before": before_it})


class GivesNumbers:
    """Refuses a sweep for which the network gives no number: float32 counts can overflow it."""

    def apply(self, context: Context) -> Refusal | None:
        """Turn the logits into probabilities."""
        context.probabilities = softmax(context.logits)
        if not math.isnan(context.probabilities[0]):  # all are NaN or none
            return None
        return Refusal(Status.UNKNOWN, Remark(Reason.NO_NUMBER))


class Certain:
    """Gives an answer below a probability another status than ok: `unsure` asks for one more sweep,
    `undecided` is final. least: for a contact in place and for a displaced one."""

    def __init__(self, least: float, displaced: float) -> None:
        self._least = least, displaced

    def apply(self, context: Context) -> Refusal | None:
        """Refuse an uncertain answer."""
        if max(context.scores.tolist()) < self._least[context.displacement.off]:
            status = Status.UNDECIDED if context.final else Status.UNSURE
            return Refusal(status, context.remark)
        return None
