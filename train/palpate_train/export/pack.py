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
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core import storage
from palpate.core.clock import SystemClock
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate_train.answer.fit_window import MOST_REFUSED, highest_count
from palpate_train.answer.rules import ALL, Asked, present
from palpate_train.answer.stranger_limits import MOST_UNKNOWN
from palpate_train.data import extras, repeats
from palpate_train.data.readers import counted
from palpate_train.data.sets import Dataset
from palpate_train.export import card, fit_rules
from palpate_train.export.contents import Content, ExportRefused, files_of, means_file
from palpate_train.metrics import bundle_score
from palpate_train.metrics.score import REFUSED, UNKNOWN
from palpate_train.models.methods import model_inputs
from palpate_train.onnx_tools.graph_builder import run

Array = NDArray[Any]
RUNTIME = "0.2.0"
"""The first version of the box that reads such a manifest."""
LICENCE = "licence"
"""Entry of `about` with the licence of the data."""


class PackOptions(TypedDict, total=False):
    """Options of a bundle.

    full_scale: the sensor's highest raw count if that is not the maximum of its type. pitch_mm:
    distance between taxels; without it the box cannot say how far a contact is from the trained
    positions. proven (True): measure how many broken taxels the box may bridge, and which rules
    pay, which takes most of the time; without it the box refuses broken taxels and has all other
    rules. asked: rules that stay or are left out in any case.
    """

    full_scale: float | None
    pitch_mm: float | None
    proven: bool
    asked: Asked


def pack(
    content: Content,
    target: Path,
    name: str,
    version: str,
    commit: str,
    **options: Unpack[PackOptions],
) -> bundle.Manifest:
    """Check `content` and put it at `target`, whole or not at all; an older bundle there is
    replaced.

    commit: of the code, for the manifest. Raises ExportRefused if a check fails, and BundleError if
    a label or the target cannot be used.
    """
    pitch_mm, proven = options.get("pitch_mm"), options.get("proven", True)
    asked = options.get("asked", ALL)
    files = files_of(content)
    manifest = _manifest(content, files, (name, version, commit), options.get("full_scale"))
    manifest = fit_rules.from_counts(manifest, content, pitch_mm)
    logits = run(content.model, model_inputs(content.input, content.held_out))
    with _replacing(target) as folder:
        packed = bundle.from_files(files | {bundle.MANIFEST: manifest.json()}, name)
        held_out, protocol = content.held_out, f"held-out {content.held_out_by}"
        figures = judge(packed, held_out, logits, protocol)
        chosen = fit_rules.from_answers(content, packed, proven, asked)
        if set(present(packed)) - set(present(chosen)):
            figures = judge(chosen, held_out, logits, protocol)
        files |= {bundle.MEANS: means_file(chosen.classes)} if chosen.classes else {}
        if set(refused := Classifier(chosen, SystemClock()).refusals()) - {Status.OK}:
            golden = chosen.golden, chosen.golden_logits
            files[bundle.GOLDEN] = bundle.golden_file(*golden, refused)
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


def _manifest(
    content: Content,
    files: dict[str, bytes],
    named: tuple[str, str, str],
    full_scale: float | None,
) -> bundle.Manifest:
    """The manifest without figures, with the rules from features. named: name, version and
    commit."""
    name, version, commit = named
    train = content.train
    top = highest_count(train) if full_scale is None else float(full_scale)
    return bundle.Manifest(
        name=name,
        version=version,
        format=content.train.format,
        input=content.input,
        labels=content.train.materials,
        displays={name: text for name, text in train.displays.items() if name in train.materials},
        thresholds=bundle.Thresholds(contact=None, full_scale=top),
        runtime=RUNTIME,
        early=content.early,
        known=content.known,
        disturbances=content.disturbances,
        files={k: bundle.file_entry(v) for k, v in files.items()},
        made=_made(content, commit),
    )


def _made(content: Content, commit: str) -> dict[str, Any]:
    """The entry `made` of a manifest."""
    made = {
        "commit": commit,
        "set": content.train.source,
        "sweeps": repeats.sketch(content.train, content.held_out),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
        "torch": metadata.version("torch") if extras.installed("torch") else None,
        "onnxruntime": onnxruntime.__version__,
    }
    about = {name: value for name, value in content.about.items() if name != LICENCE}
    return made | about | {"data": card.data(content.train, content.about.get(LICENCE, ""))}


def judge(packed: bundle.Bundle, held_out: Dataset, logits: Array, protocol: str) -> dict[str, Any]:
    """Figures of a bundle on `held_out`, run as the box runs it. logits: [N, K] of the graph, for
    the same sweeps.

    Raises ExportRefused if the box gives another label than the graph, or refuses too many sweeps.
    """
    box = Classifier(packed, SystemClock(), slides=False)
    box.self_test(checks=False)
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
            f"squared distance {known.balanced:.4g}); record more positions, so that it learns how "
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
    """A new folder next to `target`, which replaces it if the block succeeds and is removed if it
    fails."""
    check_target(target)
    try:
        with storage.folder(target.resolve()) as new:
            yield new
    except OSError as e:
        raise ExportRefused(
            f"the bundle cannot be written to {target}: {e}; name another folder with --out"
        ) from e
