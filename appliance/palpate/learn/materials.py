"""Teaches new materials into the delivered bundle in service: its model and its materials stay.

Each new material is the mean of its sweeps in the embedding (learn/enrolment.py), so this needs
seconds, and nothing of the desktop.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.objects import EnrolledLabels, softmax
from palpate.answer.unknown import ClassDistances
from palpate.bundle import bundle, enrolled
from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.errors import BundleError, ConfigError
from palpate.core.names import can_be_shown
from palpate.deployment.signed import SignedBundle
from palpate.inference.classifier import Classifier
from palpate.learn import enrolment
from palpate.learn.assessment import Assessment
from palpate.learn.enrolment import Enrolment
from palpate.sweeps import sweep_folder
from palpate.sweeps.sweep_folder import NoSlide, slides_alone

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class NewSweeps:
    """Recorded sweeps of materials that a bundle has not been trained on. windows: raw counts [n,
    T, R, C] or [n, T, R, C, A] of each material; files: their names, without suffix. no_slides:
    sweeps that are not learnt from. displays: names of materials for people, by label."""

    windows: Mapping[str, Array]
    files: Mapping[str, list[str]]
    no_slides: tuple[NoSlide, ...] = ()
    displays: Mapping[str, str] = field(default_factory=dict)


def check_settings(settings: Config) -> None:
    """Raises ConfigError if the box would refuse a bundle with enrolled labels."""
    if settings.classifier.early:
        raise ConfigError("early answers cannot name enrolled labels; set classifier.early = false")


def delivered(running: SignedBundle) -> bool:
    """Whether materials are taught into this bundle: a person signed it, it has an embedding."""
    return bundle.SIGNATURE in running.files and running.bundle.classes is not None


def trained(running: Bundle) -> tuple[str, ...]:
    return tuple(name for name in running.manifest.labels if name not in running.enrolled)


def recorded(running: Bundle, folder: Path) -> NewSweeps:
    """The sweeps in `folder` of new materials and of the format of the bundle."""
    check, known = enrolment.slide_check(running), (*trained(running), sweep_folder.NOT_THIS)
    taught = sweep_folder.taught(folder, Counter())
    ours = [one for one in taught if one.format == running.format]
    new = [one for one in ours if one.sweep.material not in known]
    slides, no_slides = slides_alone(new, [check(one.sweep.frames.taxels) for one in new])
    windows: dict[str, list[Array]] = {}
    files: dict[str, list[str]] = {}
    displays: dict[str, str] = {}
    for one in slides:
        if can_be_shown(display := one.about.get("display")):
            displays[one.sweep.material] = str(display)
        windows.setdefault(one.sweep.material, []).append(one.sweep.frames.taxels)
        files.setdefault(one.sweep.material, []).append(one.path.stem)
    return NewSweeps(
        {name: np.stack(of) for name, of in windows.items()}, files, no_slides, displays
    )


def taught(
    running: SignedBundle,
    windows: Mapping[str, Array],
    forgotten: tuple[str, ...] = (),
    displays: Mapping[str, str] = MappingProxyType({}),
) -> Enrolment:
    """The bundle with these materials. A material enrolled before is learnt anew, and a forgotten
    material is left out. displays: names for people, by label. Raises BundleError and FormatError
    as `enrolment.enrol`."""
    new = _without(running.bundle, {*windows, *forgotten})
    warnings, disagreements = list[str](), list[str]()
    made: Enrolment | None = None
    for label, of in windows.items():
        made = enrolment.enrol(new, label, of, displays.get(label, ""))
        new, warnings = made.bundle, [*warnings, *made.warnings]
        disagreements += [made.disagreement] if made.disagreement else []
    if made is None:
        name = f"{new.manifest.name} {new.manifest.version}"
        raise BundleError(f"bundle {name} gets no new material; record a material that it lacks")
    warnings = [*dict.fromkeys(warnings)]
    return replace(made, warnings=tuple(warnings), disagreement="; ".join(disagreements))


def _without(old: Bundle, labels: set[str]) -> Bundle:
    """The bundle without these enrolled labels."""
    added = old.added
    if added is None or not labels & {*added.labels}:
        return old
    kept = [k for k, label in enumerate(added.labels) if label not in labels]
    assert old.before
    return enrolled.joined(old.before, added.only(kept), old.id) if kept else old.before


def assessed(running: SignedBundle, sweeps: NewSweeps) -> Assessment:
    """Answers to sweeps of new materials, each left out in turn. Raises BundleError."""
    many = {name: of for name, of in sweeps.windows.items() if len(of) > 1}
    if not many:
        raise BundleError("no new material has two sweeps; record another of it")
    return left_out(_without(running.bundle, {*many}), many, sweeps)


def left_out(old: Bundle, many: Mapping[str, Array], sweeps: NewSweeps) -> Assessment:
    run, names = Classifier(old, SystemClock()), (*old.manifest.labels, *many)
    outputs = {
        name: enrolment.network_outputs(run, np.stack([run.cleaned(sweep) for sweep in of]))
        for name, of in many.items()
    }
    chances = np.concatenate([_left_out(old, outputs, name) for name in outputs])
    late = {*old.enrolled, *many}
    rule = EnrolledLabels(np.array([name in late for name in names]), enrolment.LEAST)
    labels = np.concatenate([np.full(len(of), names.index(name)) for name, of in many.items()])
    files = tuple(file for name in many for file in sweeps.files[name])
    named = np.eye(len(names))[rule.decided(chances).argmax(axis=1)]
    return Assessment(names, labels, files, named, chances, no_slides=sweeps.no_slides)


def _left_out(old: Bundle, outputs: Mapping[str, tuple[Array, Array]], of: str) -> Array:
    """Probabilities [n, K] of all labels for the sweeps of a material, each left out in turn.
    outputs: as of `enrolment.network_outputs`, of each material."""
    assert old.classes
    assert old.manifest.known
    known, labels = replace(old.manifest.known, enrolled=enrolment.LEAST), old.manifest.labels
    network, answers = outputs[of][0], []
    for i in range(len(network)):
        classes = old.classes
        for name, (_, z) in outputs.items():
            classes = enrolment.extended(classes, np.delete(z, i, axis=0) if name == of else z)
        means = ClassDistances(classes, known, [*labels, *outputs])
        answers.append(softmax(means.joined(network[i], outputs[of][1][i])))
    return np.stack(answers)
