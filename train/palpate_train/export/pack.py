"""Packing of a trained model as a bundle.

A model is refused unless the box's classifier, on this machine, gives the answers of the trained
model.
"""

from __future__ import annotations

import contextlib
import os
import platform
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray

from palpate.answer.disturbance import Disturbances
from palpate.answer.early import Early
from palpate.answer.objects import softmax
from palpate.answer.unknown import Classes, DisplacementRule, Known, shaped_distances
from palpate.bundle import arrays, bundle
from palpate.core import provenance, storage
from palpate.core.clock import SystemClock
from palpate.core.errors import BundleError
from palpate.inference.classifier import Classifier
from palpate_train.answer import fit_displacement, fit_early, fit_slide, fit_taxels, rules
from palpate_train.answer.fit_contact import Contacts
from palpate_train.answer.fit_slide import trained_speeds
from palpate_train.answer.rules import ALL, RULES, Asked, present
from palpate_train.data import extras, repeats
from palpate_train.data.readers import counted
from palpate_train.data.sets import Dataset
from palpate_train.export import card, trial
from palpate_train.metrics import bundle_score
from palpate_train.metrics.answers import REFUSED, UNKNOWN
from palpate_train.models.method_fit import MethodFit
from palpate_train.models.methods import model_inputs
from palpate_train.onnx_tools.graph_builder import run, run_output, slim

Array = NDArray[Any]
MOST_REFUSED, MOST_UNKNOWN = 0.05, 0.15
"""Largest shares of held-out sweeps that the box may refuse (because of stuck taxels, for
instance), and call unknown. Its limit makes it call about 5 % unknown; more means that thresholds
or limit do not fit."""
RUNTIME = "0.2.0"
"""The first version of the box that reads such a manifest."""
FEWEST = 5
"""Number of training sweeps of a material below which that is the reason why none is recognised."""
COARSEST = 8
"""Largest step to which golden sweeps are rounded, in usual changes of a number from frame to
frame. Larger steps save little more."""
LICENCE = "licence"
"""Entry of `about` with the licence of the data."""
NEAR = 0.1
"""Largest change of a golden sweep's probability by rounding, so that its label stays about as
certain."""


class ExportRefused(BundleError):
    """The model answers differently in its bundle than on the desktop, or the box could not use
    it."""


@dataclass(frozen=True)
class Content:
    """The content of a bundle.

    model: `sweep` or `features` -> `logits`, and the outputs that `early` and `known` need. input:
    as in the manifest. train, held_out: the training sweeps and the others, split by the group
    `held_out_by`. about: description of the training; figures: its results; both for the manifest.
    early, known, displacement, disturbances: for the manifest. classes: of the embedding, if there
    is `known`. contacts: of the training sweeps; None
    to find them. unseen: the same content with heads that did not see the held-out sweeps; None if
    no part of the model has seen them.
    """

    model: onnx.ModelProto
    input: str
    train: Dataset
    held_out: Dataset
    held_out_by: str
    about: dict[str, Any]
    figures: dict[str, Any] = field(default_factory=dict)
    early: Early | None = None
    known: Known | None = None
    displacement: DisplacementRule | None = None
    disturbances: Disturbances | None = None
    classes: Classes | None = None
    contacts: Contacts | None = None
    unseen: Content | None = None


def pack(
    content: Content,
    target: Path,
    name: str,
    version: str,
    commit: str,
    full_scale: float | None = None,
    pitch_mm: float | None = None,
    proven: bool = True,
    asked: Asked = ALL,
) -> bundle.Manifest:
    """Check `content` and put it at `target`, whole or not at all; an older bundle there is
    replaced.

    commit: of the code, for the manifest. full_scale: the sensor's highest raw count if that is not
    the maximum of its type. pitch_mm: distance between taxels; without it the box cannot say how
    far a contact is from the trained positions. proven: measure how many broken taxels the box may
    bridge, and which rules pay, which takes most of the time; without it the box refuses broken
    taxels and has all other rules. asked: rules that stay or are left out in any case. Raises
    ExportRefused if a check fails, and BundleError if a label or the target cannot be used.
    """
    content = _early_checked(content)
    files = _files(content)
    manifest = _manifest(content, files, (name, version, commit), full_scale, pitch_mm)
    manifest = limited(manifest, content.train)
    logits = run(content.model, model_inputs(content.input, content.held_out))
    with _replacing(target) as folder:
        packed = bundle.from_files(files | {bundle.MANIFEST: manifest.json()}, name)
        held_out, protocol = content.held_out, f"held-out {content.held_out_by}"
        figures = judge(packed, held_out, logits, protocol)
        chosen = _chosen(content, packed, proven, asked)
        if present(chosen) != present(packed):
            figures = judge(chosen, held_out, logits, protocol)
        files |= {bundle.MEANS: means_file(chosen.classes)} if chosen.classes else {}
        manifest = replace(
            chosen.manifest,
            files={k: bundle.file_entry(files[k]) for k in chosen.manifest.files},
            figures=figures | content.figures | chosen.manifest.figures,
        )
        for file in manifest.files:
            (folder / file).write_bytes(files[file])
        (folder / bundle.MANIFEST).write_bytes(manifest.json())
        (folder / card.NAME).write_text(card.text(manifest, pitch_mm), encoding="utf-8")
        bundle.load(folder)
    return manifest


def limited(manifest: bundle.Manifest, train: Dataset) -> bundle.Manifest:
    """`manifest` with the limits that the training sweeps set: of displacement and of sliding."""
    return fit_slide.limited(fit_displacement.limited(manifest, train), train)


def _early_checked(content: Content) -> Content:
    """`content` whose early answers need a known material; see early_checks."""
    if not (content.early and content.classes):
        return content
    classes, limits = fit_early.measure(content.model, content.train, content.held_out)
    return replace(
        content,
        early=replace(content.early, limits=limits),
        classes=replace(content.classes, early=classes),
    )


def _manifest(
    content: Content,
    files: dict[str, bytes],
    named: tuple[str, str, str],
    full_scale: float | None,
    pitch_mm: float | None,
) -> bundle.Manifest:
    """The manifest without figures. named: name, version and commit."""
    contacts = content.contacts or Contacts.of(content.train)
    place, (name, version, commit) = contacts.positions(pitch_mm), named
    speeds, unmeasured = trained_speeds(content.train, place.pitch_mm if place else None)
    unknown = {"contact": contacts.limit.why, "speeds": unmeasured}
    return bundle.Manifest(
        name=name,
        version=version,
        format=content.train.format,
        input=content.input,
        labels=content.train.materials,
        displays=displays(content.train),
        thresholds=thresholds(content.train, contacts.limit.contact, full_scale),
        contact=place,
        unloaded=contacts.limit.known_tare(),
        speeds=speeds,
        runtime=RUNTIME,
        early=content.early,
        known=content.known,
        displacement=content.displacement,
        disturbances=content.disturbances,
        files={k: bundle.file_entry(v) for k, v in files.items()},
        made=_made(content, commit, unknown),
    )


def displays(sweeps: Dataset) -> dict[str, str]:
    """The display names for a manifest, which has none for materials that are not there."""
    return {name: text for name, text in sweeps.displays.items() if name in sweeps.materials}


def _chosen(content: Content, packed: bundle.Bundle, proven: bool, asked: Asked) -> bundle.Bundle:
    """`packed` with the broken taxels that it tolerates, if that is `proven`, and without the rules
    that do not pay. Heads judge that have not seen the held-out sweeps."""
    left_out, figures = list(asked.left_out), dict[str, Any]()
    if proven:
        judging, seed = packed, int(content.about.get("seed", 0))
        if content.unseen:
            files = _files(content.unseen)
            entries = {name: bundle.file_entry(data) for name, data in files.items()}
            text = replace(packed.manifest, files=entries, early=None).json()
            judging = bundle.from_files(files | {bundle.MANIFEST: text}, packed.manifest.name)
        found = fit_taxels.measure(judging, content.train, content.held_out, seed)
        packed, judging = (
            replace(of, manifest=found.written(of.manifest)) for of in (packed, judging)
        )
        left_out, figures = trial.decided(judging, content.held_out, seed, asked)
    for name in left_out:
        packed = RULES[name].without(packed)
    figures = {rules.FIGURES: figures} if figures else {}
    return replace(
        packed, manifest=replace(packed.manifest, figures=packed.manifest.figures | figures)
    )


def _files(content: Content) -> dict[str, bytes]:
    """The files of a bundle but its manifest, by name."""
    logits = run(content.model, model_inputs(content.input, content.train))
    of_means = logits_of_means(content, content.train) if content.known else logits
    golden = golden_sweeps(content.train, logits, of_means)
    files = {bundle.MODEL: slim(content.model).SerializeToString()}
    files |= {bundle.GOLDEN: golden_file(content, golden)}
    return files | ({bundle.MEANS: means_file(content.classes)} if content.classes else {})


def means_file(classes: Classes) -> bytes:
    """The file means.npz."""
    return arrays.packed(**classes.arrays())


def _made(content: Content, commit: str, unknown: dict[str, str]) -> dict[str, Any]:
    """The entry `made` of a manifest. unknown: for parts that may be unknown the reason, "" if
    they are known."""
    made = {
        "commit": commit,
        "set": content.train.source,
        "sweeps": repeats.sketch(content.train, content.held_out),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
        "torch": metadata.version("torch") if extras.installed("torch") else None,
        "onnxruntime": onnxruntime.__version__,
    }
    made |= {f"{part}_unknown_because": why for part, why in unknown.items() if why}
    about = {name: value for name, value in content.about.items() if name != LICENCE}
    return made | about | {"data": card.data(content.train, content.about.get(LICENCE, ""))}


def content_of(fit: MethodFit) -> Content:
    """The content of a bundle of this method."""
    return Content(fit.model, fit.input, fit.train, fit.held, fit.held_out_by, fit.about)


def pack_to_measure(content: Content, target: Path) -> bundle.Manifest:
    """Pack `content` under the name of its method, only to measure its cost."""
    return pack(content, target, content.about["method"], "1", provenance.commit(), proven=False)


def logits_of_means(content: Content, sweeps: Dataset) -> Array:
    """Logits [N, K] that the box computes from class means once a label is enrolled, before
    temperature scaling."""
    assert content.classes
    logits: Array = (
        _embedded(content, sweeps.samples) @ content.classes.means.T + content.classes.bias
    )
    return logits


def _unknown(content: Content, sweeps: Dataset) -> Array:
    """bool [N], the sweeps that the box calls unknown; none if the bundle has no limit of known
    materials."""
    if not (content.known and content.classes):
        return np.zeros(len(sweeps), bool)
    means, shapes = (a.astype(np.float64) for a in (content.classes.means, content.classes.shapes))
    distances = shaped_distances(_embedded(content, sweeps.samples)[:, None] - means, shapes)
    beyond: Array = distances.min(axis=1) > content.known.limit
    return beyond


def _embedded(content: Content, samples: Array) -> Array:
    """The embeddings [n, r] of raw counts [n, T, R, C]."""
    return run_output(content.model, "embedding", samples)


def golden_sweeps(sweeps: Dataset, logits: Array, logits_of_means: Array) -> Dataset:
    """One training sweep of the first and the last material.

    It is the sweep with the median probability among those that both kinds of logits recognise:
    certain enough that rounding does not change its label, and not so certain that a small fault is
    hidden. Raises ExportRefused if none is recognised.
    """
    index = []
    for label in (0, len(sweeps.materials) - 1):
        known = np.flatnonzero(
            (sweeps.labels == label)
            & (logits.argmax(1) == label)
            & (logits_of_means.argmax(1) == label)
        )
        if not len(known):
            raise ExportRefused(
                f"no training sweep of {sweeps.materials[label]!r} is recognised: "
                f"{_why(sweeps, label)}"
            )
        order = np.argsort(softmax(logits[known])[:, label], kind="stable")
        index.append(known[order[len(order) // 2]])
    return sweeps.take(np.array(index))


def golden_file(content: Content, golden: Dataset) -> bytes:
    """The file golden.npz: sweeps, and the logits of the model for exactly these.

    Sweeps are rounded because noise cannot be compressed: as coarsely as possible without a change
    of a label, a change of a probability by more than NEAR, or a known sweep that becomes unknown.
    """

    def answers(samples: Array) -> tuple[Array, ...]:
        sweeps = replace(golden, samples=samples)
        logits = run(content.model, model_inputs(content.input, sweeps))
        return (logits, logits_of_means(content, sweeps)) if content.known else (logits,)

    def same(answer: Array, exact: Array) -> bool:
        near = np.abs(softmax(answer) - softmax(exact)).max() <= NEAR
        return bool(near and (answer.argmax(1) == golden.labels).all())

    exact, unknown = answers(golden.samples), _unknown(content, golden)
    for samples in _rounded(golden.samples):
        still = _unknown(content, replace(golden, samples=samples)) <= unknown
        if still.all() and all(map(same, rounded := answers(samples), exact)):
            return bundle.golden_file(samples, rounded[0])
    return bundle.golden_file(golden.samples, exact[0])


def _rounded(samples: Array) -> Iterator[Array]:
    """Sweeps as multiples of powers of two, from COARSEST usual changes of a number from frame to
    frame down to half of that change. Sweeps of whole numbers stay whole."""
    whole = samples.dtype.kind != "f"
    usual = float(np.median(np.abs(np.diff(samples.astype(np.float64), axis=1))))
    if not usual:
        return
    step = 2.0 ** np.floor(np.log2(usual * COARSEST))
    while step >= (2 if whole else usual / 4):
        rounded = np.rint(samples / step) * step
        if whole:
            rounded = rounded.clip(np.iinfo(samples.dtype).min, np.iinfo(samples.dtype).max)
        yield rounded.astype(samples.dtype)
        step /= 2


def _why(sweeps: Dataset, label: int) -> str:
    """The reason why a material is not recognised, and the remedy."""
    of_it = sweeps.samples[sweeps.labels == label]
    if not np.ptp(of_it, axis=1).any():
        return "every taxel of its sweeps is constant; check the skin, and record it again"
    if len(of_it) < FEWEST:
        return f"there are {len(of_it)} of it; record {FEWEST} or more"
    return "they look like others; record it at more positions, or leave it out with --only"


def thresholds(
    sweeps: Dataset, contact: float | None, full_scale: float | None
) -> bundle.Thresholds:
    """The thresholds for a window; without `full_scale` the highest count of the type is the full
    scale."""
    kind = sweeps.samples.dtype
    top = np.finfo(kind).max if kind.kind == "f" else np.iinfo(kind).max
    return bundle.Thresholds(
        contact=contact, full_scale=float(top if full_scale is None else full_scale)
    )


def judge(packed: bundle.Bundle, held_out: Dataset, logits: Array, protocol: str) -> dict[str, Any]:
    """Figures of a bundle on `held_out`, run as the box runs it. logits: [N, K] of the graph, for
    the same sweeps.

    Raises ExportRefused if the box gives another label than the graph, or refuses too many sweeps.
    """
    box = Classifier(packed, SystemClock(), slides=False)
    box.self_test()
    answers = bundle_score.answers_to(box, held_out, logits)
    refused, unknown = answers.labels == REFUSED, answers.labels == UNKNOWN
    if other := int(np.sum((answers.labels != answers.network) & (answers.labels >= 0))):
        raise ExportRefused(
            f"the box labels {other} of {len(held_out)} held-out sweeps otherwise than export did"
        )
    if refused.mean() > MOST_REFUSED:
        reasons = Counter(
            str(v.status) for _, v in bundle_score.verdicts(box, held_out) if not v.label
        )
        raise ExportRefused(
            f"the box would refuse {refused.sum()} of {len(held_out)} held-out sweeps (limit "
            f"{MOST_REFUSED:.0%}), by status: "
            f"{counted(reasons)}. Drop such sweeps from the set; where they are saturated, name "
            "the skin's --full-scale"
        )
    if (known := box.bundle.manifest.known) and unknown.mean() > MOST_UNKNOWN:
        raise ExportRefused(
            f"the box would call {unknown.sum()} of {len(held_out)} held-out sweeps unknown (limit "
            f"{MOST_UNKNOWN:.0%}, "
            f"squared distance {known.limit:.4g}); record more positions, so that it learns how "
            "sweeps vary"
        )
    return answers.figures(held_out.labels, held_out.group("recording"), protocol)


def check_target(target: Path) -> None:
    """Make the folders above `target`. Raises ExportRefused if no bundle can be put there, before
    anything is computed."""
    if target.exists() and not (target / bundle.MANIFEST).is_file():
        raise ExportRefused(
            f"{target} is not a bundle and will not be replaced; name another folder with --out"
        )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent):
            pass
    except OSError as e:
        raise ExportRefused(
            f"the bundle cannot be written to {target}: {e.strerror}; name another folder with "
            "--out"
        ) from e


@contextlib.contextmanager
def _replacing(target: Path) -> Iterator[Path]:
    """A new folder beside `target`, which replaces it if the block succeeds and is removed if it
    fails."""
    check_target(target)
    try:
        with storage.folder(target.resolve()) as new:
            yield new
    except OSError as e:
        raise ExportRefused(
            f"the bundle cannot be written to {target}: {e}; name another folder with --out"
        ) from e
