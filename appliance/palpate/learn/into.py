"""Teaches new materials into the delivered bundle in service: its model and its materials stay.

Each new material is the mean of its sweeps in the embedding (inference/enrolment.py), so this needs
seconds, and nothing of `train`. `palpate enrol` is the same with the sweeps of one material.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle import bundle, enrolled
from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.config import Config
from palpate.core.errors import BundleError, ConfigError, FormatError
from palpate.core.statistics import wilson
from palpate.core.types import Status, load, sidecar
from palpate.deployment.signed import SignedBundle
from palpate.inference import advice, enrolment
from palpate.inference.classifier import Classifier, softmax
from palpate.inference.enrolment import Enrolment
from palpate.inference.novelty import ClassDistances
from palpate.inference.objects import EnrolledLabels
from palpate.learn.process import News

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class NewSweeps:
    """Recorded sweeps of materials that a bundle has not been trained on. windows: raw counts [n,
    T, R, C] or [n, T, R, C, A] of each material; files: their numbers, likewise. no_slides: news of
    sweeps that are not learnt from, each with its number and a text."""

    windows: Mapping[str, Array]
    files: Mapping[str, list[int]]
    no_slides: list[dict[str, Any]]


def check_settings(settings: Config) -> None:
    """Raises ConfigError if the box would refuse a bundle with enrolled labels."""
    if settings.classifier.early:
        raise ConfigError("early answers cannot name enrolled labels; set classifier.early = false")


def delivered(running: SignedBundle) -> bool:
    """Whether new materials are taught into this bundle: a person has signed it, and it has an
    embedding."""
    return bundle.SIGNATURE in running.files and running.bundle.classes is not None


def trained(running: Bundle) -> tuple[str, ...]:
    """The labels that a bundle was trained on."""
    return tuple(name for name in running.manifest.labels if name not in running.enrolled)


def recorded(running: Bundle, folder: Path, forgotten: Mapping[str, int]) -> NewSweeps:
    """The sweeps in `folder` of new materials and of the format of the bundle. forgotten: see
    TeachingState."""
    check, known = enrolment.slide_check(running), trained(running)
    windows: dict[str, list[Array]] = {}
    files: dict[str, list[int]] = {}
    seen, no_slides = Counter[str](), []
    for number, material, taxels in _usable(running, folder):
        if material in known or number <= forgotten.get(material, -1):
            continue
        seen[material] += 1
        if why := check(taxels):
            text = f"sweep {seen[material]} of {material} is not learnt from: {why}"
            no_slides.append({"number": number, "text": text})
            continue
        windows.setdefault(material, []).append(taxels)
        files.setdefault(material, []).append(number)
    return NewSweeps({name: np.stack(of) for name, of in windows.items()}, files, no_slides)


def _usable(running: Bundle, folder: Path) -> Iterator[tuple[int, str, Array]]:
    """Number, material and window of each sweep without a fault."""
    wanted = running.format
    for path in sorted(folder.glob("sweep-*.npy")):
        try:
            sweep, format = load(path)
            status = Status(sidecar(path)["verdict"]["status"])
        except (FormatError, KeyError, TypeError, ValueError):
            continue  # damaged: training reports it
        taxels, number = sweep.frames.taxels, path.stem.rpartition("-")[2]
        whole = format == wanted and taxels.shape == (wanted.window, *wanted.shape)
        good = sweep.status is Status.OK and not status.faulty and number.isdecimal()
        if sweep.material and whole and good:
            yield int(number), sweep.material, taxels


def taught(
    running: SignedBundle, windows: Mapping[str, Array], forgotten: tuple[str, ...] = ()
) -> Enrolment:
    """The bundle with these materials. One that was enrolled before is learnt anew, and a forgotten
    one is left out. Raises BundleError and FormatError as `enrolment.enrol`."""
    new = _without(running, {*windows, *forgotten})
    warnings, disagreements = list[str](), list[str]()
    made: Enrolment | None = None
    for label, of in windows.items():
        made = enrolment.enrol(new, label, of)
        new, warnings = made.bundle, [*warnings, *made.warnings]
        disagreements += [made.disagreement] if made.disagreement else []
    if made is None:
        raise BundleError(
            f"bundle {new.manifest.name} {new.manifest.version} gets no new material; record one "
            "that it does not have yet"
        )
    warnings = [*dict.fromkeys(warnings)]
    return replace(made, warnings=tuple(warnings), disagreement="; ".join(disagreements))


def _without(running: SignedBundle, labels: set[str]) -> Bundle:
    """The bundle without these enrolled labels."""
    old = running.bundle
    added = old.added
    if added is None or not labels & {*added.labels}:
        return old
    signed = {
        name: data
        for name, data in running.files.items()
        if name not in (bundle.ENROLMENT, bundle.ENROLMENT_SIGNATURE)
    }
    new = bundle.from_files(signed, old.manifest.name)
    kept = [k for k, label in enumerate(added.labels) if label not in labels]
    for k in kept:
        mean, n, spread = added.means[k], int(added.sweeps[k]), float(added.spread[k])
        new = enrolled.with_label(new, added.labels[k], mean, n, spread, added.golden[k])
    still = replace(
        added,
        labels=tuple(added.labels[k] for k in kept),
        means=added.means[kept],
        sweeps=added.sweeps[kept],
        spread=added.spread[kept],
        golden=added.golden[kept],
    )
    return replace(new, added=still if kept else None)


def assessed(running: SignedBundle, sweeps: NewSweeps) -> News:
    """The answers to sweeps of new materials, each left out in turn, among all labels: news of
    type `assessed`, as of palpate_train.teach. Raises BundleError if no material has two sweeps."""
    many = {name: of for name, of in sweeps.windows.items() if len(of) > 1}
    if not many:
        raise BundleError("no new material has two sweeps; record another of it")
    old = _without(running, {*many})
    p, answers = _judged(old, many)
    right = sum(of.count(name) for name, of in answers.items())
    total = sum(map(len, answers.values()))
    low, high = wilson(right, total)
    wrong = Counter((name, one) for name, of in answers.items() for one in of if one != name)
    suspects = _suspects(p, answers, sweeps)
    worst = max(wrong, key=wrong.__getitem__) if wrong else None
    labels = len(old.manifest.labels) + len(many)
    said = (
        f"{100 * right / total:.0f} % of {total} sweeps of new materials are named rightly among "
        f"{labels} if they are left out [{100 * low:.0f}, {100 * high:.0f}]"
    )
    return {
        "type": "assessed",
        "accuracy": round(right / total, 4),
        "low": low,
        "high": high,
        "sweeps": total,
        "materials": {name: len(of) for name, of in many.items()},
        "left_out": ["recording"],
        "confused": [*worst, float(wrong[worst])] if worst else None,
        "suspects": suspects,
        "no_slides": sweeps.no_slides,
        "advice": _advice(low, worst, many, [one["text"] for one in suspects]),
        "text": f"{said}; most often confused: {' and '.join(worst)}" if worst else said,
    }


def _judged(
    old: Bundle, many: Mapping[str, Array]
) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """For each new material the probabilities [n, K] of its left-out sweeps, and the answers of the
    box to them."""
    run, names = Classifier(old, SystemClock()), [*old.manifest.labels, *many]
    outputs = {
        name: enrolment.network_outputs(run, enrolment.cleaned(run, of))
        for name, of in many.items()
    }
    p = {name: _left_out(old, outputs, name) for name in outputs}
    late = {*old.enrolled, *many}
    rule = EnrolledLabels(np.array([name in late for name in names]), enrolment.LEAST)
    return p, {name: [names[k] for k in rule.decided(of).argmax(axis=1)] for name, of in p.items()}


def _suspects(
    p: Mapping[str, Array], answers: Mapping[str, list[str]], sweeps: NewSweeps
) -> list[dict[str, Any]]:
    """Sweeps that are surely of another material, where the others of their own are named
    rightly. p: [n, K] of each new material, before the least probability of new labels."""
    return [
        {
            "sweep": f"sweep-{sweeps.files[name][i]:06d}",
            "number": i + 1,
            "material": name,
            "looks_like": answers[name][i],
            "text": advice.suspicion(i + 1, name, answers[name][i]),
        }
        for name, of in p.items()
        for i in np.flatnonzero(of.max(axis=1) >= advice.SURE).tolist()
        if answers[name][i] != name and answers[name].count(name) >= advice.RIGHT * (len(of) - 1)
    ]


def _left_out(old: Bundle, outputs: Mapping[str, tuple[Array, Array]], of: str) -> Array:
    """Probabilities [n, K] of all labels for the sweeps of a material, each left out in turn.

    outputs: as of `enrolment.network_outputs`, of each material.
    """
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


def _advice(
    low: float, worst: tuple[str, str] | None, many: Mapping[str, Array], suspects: list[str]
) -> str:
    """What to record next, or that it is enough."""
    if said := advice.first(suspects, low):
        return said
    if worst:
        return advice.more(worst[0])
    fewest = min(many, key=lambda name: len(many[name]))
    return f"nothing was confused, but few sweeps are recorded: {advice.MORE} more of {fewest}"
