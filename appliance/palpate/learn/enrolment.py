"""Enrolment: the box learns a material from one to ten sweeps, without training.

In the embedding the sweeps of every material have covariance 1 around their mean. A new material
therefore needs only the mean of its sweeps. The trained model and the files of the bundle do not
change; the new mean is stored in enrolment.npz (bundle/enrolled.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate.answer.slide_check import SlideCheck
from palpate.answer.unknown import ClassDistances, Classes
from palpate.bundle import bundle, enrolled
from palpate.bundle.bundle import AddedLabels, Bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import BundleError, FormatError
from palpate.inference.classifier import Classifier

Embedded = NDArray[np.float64]
LEAST = 0.7
"""Known.enrolled of an enrolment. Decision 12 compares values and rules."""


@dataclass(frozen=True, slots=True)
class Enrolment:
    """A bundle with one more label, and its enrolment.npz. warnings: for the person who enrols.
    disagreement: why the sweeps may not be of one material, "" if they agree."""

    bundle: Bundle
    file: bytes
    warnings: tuple[str, ...]
    disagreement: str


def admit(old: Bundle, label: str) -> None:
    """Raises BundleError if `label` cannot be enrolled into `old`."""
    labels = old.manifest.labels
    if label in labels:
        known = f"the bundle has {', '.join(labels)}"
        raise BundleError(f"label {label!r} is taken: {known}; choose another name")
    if not bundle.LABEL.fullmatch(label):
        allowed = "1 to 24 letters, digits, spaces, '.', '_' or '-'"
        raise BundleError(f"label {label!r} cannot be sent; use {allowed}")
    if old.classes is None:
        raise BundleError(
            f"bundle {old.manifest.name} {old.manifest.version} has no embedding, so nothing can be"
            " enrolled; export it with a method that gives one (palpate-train)"
        )


def enrol(old: Bundle, label: str, sweeps: NDArray[Any], display: str = "") -> Enrolment:
    """`old` with `label` as its last label, learned from `sweeps`: raw counts [n, T, R, C] or [n,
    T, R, C, A]. display: its name for people, "" for the label. Deterministic.

    The early heads do not have the label, so the new bundle gives no early answers. The figures of
    `old` no longer hold and are removed. Further problems do not prevent the enrolment; they are
    listed in the result. Raises BundleError as `admit`, FormatError if `sweeps` do not have the
    bundle's format, give no embedding, or are not slides.
    """
    admit(old, label)
    m, f = old.manifest, old.format
    assert old.classes
    assert m.known
    if sweeps.shape[1:] != (f.window, *f.shape) or not len(sweeps) or sweeps.dtype != f.numpy_type:
        given = f"sweeps {sweeps.dtype} {sweeps.shape} cannot be enrolled"
        raise FormatError(f"{given}; the bundle wants [n] of {f}")
    run = Classifier(old, SystemClock())
    sweeps = np.stack([run.cleaned(sweep) for sweep in sweeps])
    is_no_slide = slide_check(old)
    for number, sweep in enumerate(sweeps, 1):
        if (why := is_no_slide(sweep)) is not None:
            which = f"sweep {number} of {len(sweeps)} is not a slide over {label!r}"
            raise FormatError(f"{which}: {why}; take others")
    network, z = network_outputs(run, sweeps)
    if not np.isfinite(z).all():
        raise FormatError(
            "the model gives no number for some sweeps; look at the skin, take others"
        )
    classes = extended(old.classes, z)
    means = ClassDistances(classes, replace(m.known, enrolled=LEAST), (*m.labels, label))
    median = _median(softmax(means.joined(network, z)))
    outputs = network_outputs(run, np.append(old.golden, sweeps[median][None], axis=0))
    new, file = _added(old, (label, display), classes, sweeps[median], means.joined(*outputs))
    trained, warnings = ClassDistances(old.classes, m.known, m.labels), []
    if close := _closeness(trained, label, z):
        warnings.append(close)
    if m.early:
        why = f"early answers end with this bundle: their heads do not know {label!r}"
        warnings.append(f"{why}; set classifier.early = false")
    return Enrolment(new, file, tuple(warnings), _disagreement(trained, label, z))


def network_outputs(run: Classifier, sweeps: NDArray[Any]) -> tuple[Embedded, Embedded]:
    """The model's own logits [n, K0] and embeddings [n, r] of windows [n, T, R, C(, A)]."""
    pairs = (run.outputs(sweep, "logits", "embedding") for sweep in sweeps)
    logits, z = zip(*pairs, strict=True)
    return np.stack(logits).astype(np.float64), np.stack(z).astype(np.float64)


def slide_check(old: Bundle) -> SlideCheck:
    """The check whether a window is a slide, on the skin of a bundle. Patterns are expected where
    training measured them. They must be higher than for an answer (SlideLimits.pattern), with whose
    limit mains hum and noise that all taxels share would be learned."""
    m = old.manifest
    limits, patterned = m.sliding, m.speeds is not None
    return SlideCheck(m.format, m.tare, m.thresholds.contact, limits, patterned=patterned)


def extended(classes: Classes, z: NDArray[np.float64]) -> Classes:
    """`classes` with one more label, from the embeddings `z` float64 [n, r] of its sweeps.

    The new mean is the mean of the sweeps. The spread is computed from the sweeps and one assumed
    sweep at squared distance r, the average for trained labels. It is at least 1, the spread of
    trained labels, because materials that were not in training scatter more in the embedding. For
    the other values see `enrolled.extended`.
    """
    n, r = z.shape
    mean = z.mean(axis=0)
    spread = max(1.0, (r + ((z - mean) ** 2).sum()) / (r * n))
    return enrolled.extended(classes, mean, n, spread)


def _added(
    old: Bundle,
    called: tuple[str, str],
    classes: Classes,
    golden: NDArray[Any],
    logits: NDArray[np.float32],
) -> tuple[Bundle, bytes]:
    """`old` with the last label of `classes`, and the enrolment.npz of all enrolled labels.
    called: the label and its name for people."""
    (label, display), last = called, slice(-1, None)
    learnt = classes.means[last], classes.sweeps[last], classes.spread[last]
    one = AddedLabels(old.base, (label,), *learnt, golden[None], logits, LEAST, (display,))
    added = old.added.plus(one) if old.added else one
    file = enrolled.file(added)
    return enrolled.joined(old.before or old, added, bundle.identity(file)), file


def _median(scores: NDArray[np.float64]) -> int:
    """Index of the sweep to keep as golden, given probabilities `scores` float64 [n, K].

    It has the median probability of the last label among the sweeps that get this label, or among
    all sweeps if none gets it. As at export, a fault changes the label of such a sweep and a
    rounding error does not.
    """
    correct = np.flatnonzero(scores.argmax(axis=1) == scores.shape[1] - 1)
    pick = correct if len(correct) else np.arange(len(scores))
    return int(pick[np.argsort(scores[pick, -1], kind="stable")[len(pick) // 2]])


def files(old: Mapping[str, bytes], new: Enrolment, signature: bytes | None) -> dict[str, bytes]:
    """The files of the enrolled bundle: the original ones, the enrolment, its signature."""
    added = {bundle.ENROLMENT: new.file}
    return original(old) | added | ({bundle.ENROLMENT_SIGNATURE: signature} if signature else {})


def original(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files of a bundle without its enrolment."""
    added = bundle.ENROLMENT, bundle.ENROLMENT_SIGNATURE
    return {name: data for name, data in files.items() if name not in added}


def _disagreement(means: ClassDistances, label: str, z: NDArray[np.float64]) -> str:
    """Why the sweeps with the embeddings `z` [n, r] may not be of one material, "" where they
    agree.

    The threshold is the limit beyond which a sweep is of an unknown material. It was tested on sets
    of five sweeps of simulated materials that were left out of training: of sets of one material
    one in eleven disagrees, of sets with a sweep of another material four in five.
    """
    n, r = z.shape
    away = ((z - z.mean(axis=0)) ** 2).sum(axis=1)
    spread = away.sum() / max(1, n - 1)
    if spread <= means.loose:
        return ""
    usual = f"a trained material has {r}, limit {means.loose:.1f}"
    return (
        f"the sweeps of {label!r} disagree: they lie {spread:.1f} from their mean (squared; {usual}"
        f"), number {away.argmax() + 1} most of all; take others"
    )


def _closeness(means: ClassDistances, label: str, z: NDArray[np.float64]) -> str:
    """A warning if the sweeps with embeddings `z` [n, r] will often get a label of `means`."""
    n, r = z.shape
    # minus the expected squared error of a mean of n sweeps
    to_old = means.distances(z.mean(axis=0)) - r / n
    k = int(to_old.argmin())
    if to_old[k] >= min(means.loose, means.closest_pair()[0]):
        return ""
    close = f"squared distance {max(to_old[k], 0):.1f}, limit {means.loose:.1f}"
    return f"{label!r} lies close to {means.labels[k]!r} ({close}) and will often be called that"
