"""Answers of a bundle to a sweep set, through the classifier of the box.

A sweep is classified correctly if the box gives its material with status ok.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.types import Frames, Status, Sweep, Verdict
from palpate.inference.classifier import Classifier, EarlyExit
from palpate_train.data.sets import Dataset, digest
from palpate_train.metrics.score import (
    REFUSED,
    UNKNOWN,
    Answers,
    interval,
    outcomes,
    provenance,
    score_entry,
)

Array = NDArray[Any]
CLUSTERS = ("position", "session", "object")
"""Groups whose sweeps succeed or fail together; the first that has several values is resampled for
the interval."""


def verdicts(
    classifier: Classifier,
    sweeps: Dataset,
    *,
    fused: bool = False,
    lost: int = 0,
    early: EarlyExit | None = None,
) -> Iterator[tuple[int, Verdict]]:
    """The box's verdict on each sweep with the sweep's number, recording by recording. fused: the
    sweeps of a recording count as sweeps of one object. lost: frames of each sweep that never
    arrived. early: gives the verdict as soon as it can."""
    format = sweeps.format
    t_ns, seq = (
        (np.arange(format.window) * format.period_ns).astype(np.int64),
        np.arange(format.window),
    )
    recording = np.unique(sweeps.group("recording"), return_inverse=True)[1]
    for i in np.argsort(recording, kind="stable").tolist():
        frames = Frames(t_ns, seq, sweeps.samples[i])
        object = fused * int(recording[i] + 1)
        given = Sweep(i, 0, int(t_ns[-1]), Status.OK, frames, object=object, lost=lost)
        yield i, (early and first_answer(early, given)) or classifier(given)


def first_answer(early: EarlyExit, whole: Sweep) -> Verdict | None:
    """The early answer to a window whose frames come one after the other; None if it needs them
    all."""
    frames, parts = whole.frames, early.steps + 1
    for step in range(1, parts):
        seen = slice(-(-step * len(frames) // parts))
        part = Frames(frames.t_ns[seen], frames.seq[seen], frames.taxels[seen])
        if verdict := early(replace(whole, frames=part, share=step / parts)):
            return verdict
    return None


def answers_to(classifier: Classifier, sweeps: Dataset, logits: Array) -> Answers:
    """The box's answers to `sweeps`, by sweep and by recording. logits: [N, K] of the network for
    the same sweeps."""
    fused, decided = labels_of(classifier, sweeps, fused=True)
    labels, ok = labels_of(classifier, sweeps)
    return Answers(labels, ok, np.where(decided, fused, UNKNOWN), logits.argmax(1))


def outcomes_of(
    classifier: Classifier, sweeps: Dataset, *, fused: bool = False, lost: int = 0
) -> dict[str, Array]:
    """The outcome of each sweep, as score.outcomes. fused, lost: as for `labels_of`."""
    known = classifier.bundle.manifest.labels
    numbers = [known.index(m) if m in known else len(known) for m in sweeps.materials]
    named, sure = labels_of(classifier, sweeps, fused=fused, lost=lost)
    return outcomes(named, sure, np.array(numbers)[sweeps.labels])


def labels_of(
    classifier: Classifier, sweeps: Dataset, *, fused: bool = False, lost: int = 0
) -> tuple[Array, Array]:
    """The box's labels, int64 [N] into the bundle's, or REFUSED or UNKNOWN; and bool [N],
    whether their status is ok. fused: each sweep gets the answer to its whole recording. lost: as
    for `verdicts`."""
    labels = classifier.bundle.manifest.labels
    recording = np.unique(sweeps.group("recording"), return_inverse=True)[1]
    answers, ok = np.full(len(sweeps), REFUSED), np.zeros(len(sweeps), bool)
    for i, verdict in verdicts(classifier, sweeps, fused=fused, lost=lost):
        if verdict.label:
            answered = recording == recording[i] if fused else i
            answers[answered] = labels.index(verdict.label)
            ok[answered] = verdict.status is Status.OK
        elif verdict.status is Status.UNKNOWN and not fused:
            answers[i] = UNKNOWN
    return answers, ok


@dataclass(frozen=True, eq=False)
class BundleScore:
    """The answers of a bundle to the sweeps of a set.

    about: name, version and id of the bundle. right: bool [n], of the sweeps whose material it has.
    clusters, by: the groups [n] that the interval resamples, and their name; None and "" if sweeps
    are independent. answered: for each material the answers and their counts: a label, or a status
    in parentheses. statuses: counts. unsure_right: number of unsure answers with the right label.
    recordings: whether the fused answer to each recording is right; None if no recording has
    several sweeps. foreign: as `answered`, of materials that the bundle does not have. displaced:
    descriptions of displacements, of the sweeps whose contact lies outside the trained positions,
    with their counts.
    """

    about: dict[str, str]
    sweeps: Dataset
    right: Array
    clusters: Array | None
    by: str
    answered: dict[str, Counter[str]]
    statuses: Counter[str]
    unsure_right: int
    recordings: Array | None
    foreign: dict[str, Counter[str]]
    displaced: Counter[str]

    def json(self) -> dict[str, Any]:
        """The figures for scripts, with their provenance."""
        result: dict[str, Any] = {
            "bundle": self.about,
            "set": self.sweeps.source,
            "digest": digest(self.sweeps),
            "sweeps": len(self.sweeps),
            "classified_correctly": score_entry(self.right)
            | {"interval": interval(self.right, self.clusters)},
            "interval_by": self.by,
            "statuses": self.statuses,
            "unsure_right": self.unsure_right,
            "answers": self.answered,
            "not_in_the_bundle": self.foreign,
            "moved": self.displaced.total(),
        }
        if self.recordings is not None:
            result["recordings"] = score_entry(self.recordings) | {
                "interval": interval(self.recordings)
            }
        return result | provenance()

    def short(self) -> str:
        """The figures in a line, to compare two bundles."""
        counts = ", ".join(f"{status} {n}" for status, n in self.statuses.most_common())
        return f"{self.right.sum()} of {len(self.right)} classified correctly ({counts})"

    def text(self) -> str:
        """The figures for a person, as lines."""
        by = "" if self.clusters is None else f", by {self.by} ({len(np.unique(self.clusters))})"
        lines = [
            f"{self.about['name']} {self.about['version']}, {self.about['id']}, on "
            f"{self.sweeps.source}: "
            f"{len(self.sweeps)} sweeps of {len(self.answered) + len(self.foreign)} materials",
            f"classified correctly: {_share(self.right, self.clusters)}, 95 % interval{by}",
        ]
        if self.recordings is not None:
            lines.append(f"recordings, their sweeps fused: {_share(self.recordings)}")
        sure = (
            f" ({self.unsure_right} of them with the right label)"
            if self.statuses[Status.UNSURE]
            else ""
        )
        counts = [
            f"{status} {n}{sure * (status == Status.UNSURE)}"
            for status, n in self.statuses.most_common()
        ]
        lines.append(f"answers: {', '.join(counts)}")
        if self.displaced:
            most = self.displaced.most_common(1)[0][0]
            lines.append(
                f"outside the trained positions: {self.displaced.total()} sweeps, most "
                f"often {most}; "
                "record there, too, or align the skin"
            )
        wide = max(map(len, (*self.answered, *self.foreign)))
        for material, given in self.answered.items():
            others = ", ".join(
                f"{answer} {n}" for answer, n in given.most_common() if answer != material
            )
            lines.append(
                f"  {material:<{wide}}  {given[material]:>4} of {given.total():<4}  "
                f"{others}".rstrip()
            )
        for material, given in self.foreign.items():
            named = ", ".join(f"{answer} {n}" for answer, n in given.most_common())
            lines.append(f"  {material:<{wide}}  not in the bundle, not counted: {named}")
        return "\n".join(lines)


def score(classifier: Classifier, sweeps: Dataset) -> BundleScore:
    """Run `sweeps` through the box's classifier. Raises FormatError if their format is not the
    bundle's, or if it has none of their materials."""
    manifest = classifier.bundle.manifest
    present = [sweeps.materials[k] for k in np.unique(sweeps.labels)]
    if sweeps.format != manifest.format:
        raise FormatError(
            f"{sweeps.source} is of {sweeps.format}, the bundle of {manifest.format}; name a set "
            "of its format"
        )
    if not set(present) & set(manifest.labels):
        raise FormatError(
            f"{sweeps.source} has {', '.join(present)}, the bundle {', '.join(manifest.labels)}; "
            "none is the same: "
            "name another set, or --rename OLD=NEW"
        )
    material = np.array(sweeps.materials)[sweeps.labels]
    known = np.isin(material, manifest.labels)
    given = np.empty(len(sweeps), object)
    statuses, displaced, unsure_right = Counter[str](), Counter[str](), 0
    for i, verdict in verdicts(classifier, sweeps):
        statuses[str(verdict.status)] += 1
        given[i] = verdict.label if verdict.status is Status.OK else f"({verdict.status})"
        unsure_right += verdict.status is Status.UNSURE and verdict.label == material[i]
        displaced.update([] if verdict.displacement is None else [verdict.displacement])
    by_material = {name: Counter(given[material == name].tolist()) for name in present}
    clusters, by = _clusters(sweeps)
    return BundleScore(
        {"name": manifest.name, "version": manifest.version, "id": classifier.bundle.id},
        sweeps,
        (given == material)[known],
        None if clusters is None else clusters[known],
        by,
        {name: found for name, found in by_material.items() if name in manifest.labels},
        statuses,
        unsure_right,
        _recordings(classifier, sweeps.take(known)),
        {name: found for name, found in by_material.items() if name not in manifest.labels},
        displaced,
    )


def _clusters(sweeps: Dataset) -> tuple[Array | None, str]:
    """The groups [N] of sweeps that succeed or fail together, and the name of the group."""
    for name in CLUSTERS:
        if name in sweeps.groups and len(np.unique(sweeps.groups[name])) > 1:
            return sweeps.groups[name], name
    recording = sweeps.group("recording")
    return (recording, "recording") if len(np.unique(recording)) < len(sweeps) else (None, "")


def _recordings(classifier: Classifier, sweeps: Dataset) -> Array | None:
    """Whether the last fused answer to each recording is right, bool [G]; None if every recording
    has one sweep. An unknown sweep is not fused and keeps the last answer."""
    first = np.unique(sweeps.group("recording"), return_index=True)[1]
    if len(first) == len(sweeps):
        return None
    right: Array = outcomes_of(classifier, sweeps, fused=True)["right"][first]
    return right


def _share(right: Array, clusters: Array | None = None) -> str:
    low, high = (100 * end for end in interval(right, clusters))
    return f"{right.sum()} of {len(right)}: {100 * right.mean():.1f} % [{low:.1f}, {high:.1f}]"
