"""What a trunk needs to hold, and how its heads see it: chosen by groups that were held out. In:
features. Out: a Choice.

Candidates differ in the filters, in how these are pooled, in the spectrum, in whether heads see
augmented copies, and in whether trained stages join in. Each is judged by the cross entropy of
sweeps whose group it did not see, its temperature being the best for them, and every group counts
the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.inference.classifier import softmax
from train.calibration.heads import HeadData, HeadPart, HeadPlan
from train.data.splitters import InnerPart
from train.metrics.temperature import weighted_platt_temperature

Array = NDArray[Any]
TINY = 1e-12
ERRORS = 2.0
"""Standard errors by which a candidate must be better than the first: it is the best of about
ten."""
MOST_LOST, MOST_WORSE = 0.005, 0.02
"""Share of the sweeps, and cross entropy, that fewer filters may cost."""
Columns = tuple[int, ...]


@dataclass(frozen=True)
class ScoredPlan:
    """One candidate. losses: cross entropy [n] of each held-out sweep; logits [n, K] are of the
    temperature that is best."""

    plan: HeadPlan
    logits: Array
    losses: Array


class HeldOutScores:
    """Judges candidates on held-out parts. known: what heads are fitted to, for each part the same
    sweeps in the same order; their features may differ, where a trunk was trained without the part.
    copied: augmented copies of the held-out sweeps are judged too, and count as much as these.

    labels, clusters: of all that is judged [n], the latter numbers of parts. own: bool [n], which
    are sweeps, not copies.
    """

    def __init__(
        self,
        known: Sequence[HeadData],
        parts: Sequence[InnerPart],
        classes: int,
        copied: bool = False,
    ) -> None:
        self._known, self._parts, self._classes = known, parts, classes
        of, labels = known[0].source, known[0].labels
        self._copies = [part.out[of] & copied for part in parts]
        numbers = range(len(parts))
        self.labels = np.concatenate(
            [np.append(labels[parts[i].out], labels[of][self._copies[i]]) for i in numbers]
        )
        sizes = [(int(parts[i].out.sum()), int(self._copies[i].sum())) for i in numbers]
        self.own = np.concatenate([np.repeat([True, False], pair) for pair in sizes])
        self.clusters = np.repeat(numbers, [sum(pair) for pair in sizes])
        kind = np.array([part.group for part in parts])[self.clusters] + np.where(
            self.own, "", "\n"
        )
        _, member, counts = np.unique(kind, return_inverse=True, return_counts=True)
        self.weights = 1 / counts[member] / len(counts)
        self._logits: dict[tuple[Columns, bool], Array] = {}

    def score(self, parts: Sequence[HeadPart]) -> ScoredPlan:
        """The candidate that adds the logits of `parts`, each scaled to the same size; what factors
        they had does not count."""
        logits = [self._of(part) for part in parts]
        factors = [
            1 / max(float(np.abs(x - x.mean(axis=1, keepdims=True)).mean()), TINY) for x in logits
        ]
        total = np.sum([x * f for x, f in zip(logits, factors, strict=True)], axis=0)
        temperature = weighted_platt_temperature(total, self.labels, self.weights)
        plan = HeadPlan(
            tuple(replace(p, factor=f / temperature) for p, f in zip(parts, factors, strict=True))
        )
        return ScoredPlan(plan, total / temperature, self._losses(total / temperature))

    def loss(self, judged: ScoredPlan) -> float:
        """Mean cross entropy, every group counting the same."""
        return float(self.weights @ judged.losses)

    def accuracy(self, judged: ScoredPlan) -> float:
        """Share of held-out sweeps that are named rightly, every group counting the same."""
        return float(self.weights @ self._right(judged))

    def better(self, one: ScoredPlan, other: ScoredPlan) -> bool:
        """Whether `one` has less loss and names more sweeps rightly, by more than ERRORS standard
        errors of the paired difference.

        The error is that over held-out parts, or over sweeps where it is larger: a few parts may
        agree by chance. Loss alone is no reason: that of a sum of discriminants changes with how
        sure each is.
        """
        gain = self._lost(other, one)
        by_part = np.bincount(self.clusters, gain)
        return self.loss(one) < self.loss(other) and bool(
            gain.sum() > ERRORS * max(map(_error, (gain, by_part)))
        )

    def holds(self, one: ScoredPlan, other: ScoredPlan) -> bool:
        """Whether held-out sweeps show that `one` loses no more than MOST_LOST of those that
        `other` names rightly, and MOST_WORSE of its cross entropy: a standard error of the paired
        difference is added, at least one sweep."""
        lost = self._lost(one, other)
        worse = self.loss(one) - self.loss(other)
        return bool(
            max(lost.sum(), 0) + max(_error(lost), 1 / len(lost)) <= MOST_LOST
            and worse <= MOST_WORSE
        )

    def _lost(self, one: ScoredPlan, other: ScoredPlan) -> Array:
        """What each sweep [n] adds to the accuracy of `other` less that of `one`."""
        lost: Array = self.weights * (self._right(other).astype(float) - self._right(one))
        return lost

    def _right(self, judged: ScoredPlan) -> Array:
        right: Array = judged.logits.argmax(axis=1) == self.labels
        return right

    def _losses(self, logits: Array) -> Array:
        losses: Array = -np.log(
            np.maximum(softmax(logits)[np.arange(len(logits)), self.labels], TINY)
        )
        return losses

    def _of(self, part: HeadPart) -> Array:
        """Logits [n, K] of one discriminant for the held-out sweeps."""
        key = part.columns, part.copies
        if key not in self._logits:
            self._logits[key] = np.concatenate(
                [self._tested(part, i) for i in range(len(self._parts))]
            )
        return self._logits[key]

    def _tested(self, part: HeadPart, number: int) -> Array:
        known, out = self._known[number], self._parts[number].out
        weight, bias = replace(part, factor=1.0).fit(known.take(~out).given(), self._classes)
        return (
            np.concatenate([known.features[out], known.copied[self._copies[number]]]) @ weight.T
            + bias
        )


def _error(x: Array) -> float:
    """Standard error of the sum of `x` [n]."""
    return float(np.sqrt(len(x) / max(len(x) - 1, 1) * ((x - x.mean()) ** 2).sum()))


def choose(
    scores: HeldOutScores,
    kinds: Sequence[Array],
    pools: Sequence[Array],
    levels: Array,
    bands: Array,
    log: Callable[[str], None],
    always_copies: bool = False,
) -> ScoredPlan:
    """The candidate with the least loss, where it is `better` than the usual one; else the usual
    one.

    What the sweeps are too few to tell apart is not chosen among. The usual one adds three
    discriminants for each kind of filters: all see their magnitudes, one their shares and the
    spectrum as well, one the distribution of counts and the spectrum. An average is seldom worse
    than the better of two, and no held-out part need show which that is. Whether magnitudes are
    enough is chosen first; then whether all see the spectrum and copies, or the spectrum is enough
    alone. kinds: filters [n] of each kind. pools: the features [F] of every filter's magnitude,
    then of its share. levels, bands: numbers of the features of the distribution and of the
    spectrum, which may be none. always_copies: only candidates whose discriminants all see
    augmented copies are there, as held-out sweeps cannot show what these are for.
    """

    def judged(named: str, parts: Sequence[HeadPart]) -> ScoredPlan:
        log(f"choosing: {named}")
        return scores.score(parts)

    def best(of: Sequence[ScoredPlan]) -> ScoredPlan:
        return min(of, key=scores.loss)

    sizes, shares = (filter_groups(kinds, pools[:n], always_copies) for n in (1, 2))
    usual = [
        *sizes,
        *_with(shares, bands),
        *(_with(sizes, np.append(levels, bands)) if len(levels) else ()),
    ]
    plain = [judged("magnitudes, shares, distribution", usual), judged("magnitudes", sizes)]
    first = best(plain).plan.parts
    seen = {"without more of the spectrum": list(first)}
    if len(bands):
        seen |= {
            "with the spectrum": _with(first, bands),
            "the spectrum alone": [HeadPart(tuple(bands.tolist()), always_copies)],
        }
    more = [
        judged(
            f"{name}{', with copies' * copies}", [replace(part, copies=copies) for part in parts]
        )
        for name, parts in seen.items()
        for copies in sorted({always_copies, True})
        if copies != always_copies or name != "without more of the spectrum"
    ]
    chosen = best([*plain, *more])
    return chosen if scores.better(chosen, plain[0]) else plain[0]


def _with(parts: Sequence[HeadPart], more: Array) -> list[HeadPart]:
    """`parts`, each of which sees the features `more` too."""
    return [replace(p, columns=tuple(dict.fromkeys([*p.columns, *more.tolist()]))) for p in parts]


def with_fewer_filters(
    scores: HeldOutScores,
    chosen: ScoredPlan,
    filters: Array,
    least: int,
    log: Callable[[str], None],
) -> ScoredPlan:
    """`chosen` with half of its filters, a quarter and so on, at least `least`, as long as held-out
    parts show that this `holds`. filters: of each feature [F] the number of its filter, -1 where it
    has none."""
    full, used = chosen, np.unique(filters[chosen.plan.columns()])
    used = used[used >= 0]
    while len(used) >= 2 * least:
        used = used[::2]
        log(f"choosing: {len(used)} filters")
        kept = (filters < 0) | np.isin(filters, used)
        parts = [
            replace(p, columns=tuple(c for c in p.columns if kept[c])) for p in full.plan.parts
        ]
        less = scores.score(parts)
        if not scores.holds(less, full):
            break
        chosen = less
    return chosen


def filter_groups(
    kinds: Sequence[Array], pools: Sequence[Array], copies: bool = False
) -> list[HeadPart]:
    """A discriminant for each of `kinds`, filters [n] that are pooled in some ways."""
    return [
        HeadPart(tuple(np.concatenate([pool[filters] for pool in pools]).tolist()), copies)
        for filters in kinds
    ]
