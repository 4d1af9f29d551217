"""The room where a trained model becomes a bundle. In: a graph, its sweeps, a folder. Out: the folder, or a refusal.

Nothing leaves that does not do on this machine, through the box's own classifier, what was trained.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray

from appliance.bundle import bundle
from appliance.core import provenance, storage
from appliance.core.clock import SystemClock
from appliance.core.errors import BundleError, FormatError
from appliance.core.types import Frames, Status, Sweep
from appliance.inference.classifier import Classifier, softmax
from train.calibration.posthoc import calibrate
from train.data.sets import Dataset
from train.export.contact_positions import place_of
from train.metrics.score import figure
from train.models.compact.fit import Fit
from train.models.linear_head import hold_out
from train.models.methods import Method, Model, model_inputs
from train.onnx_tools.graph_builder import run

Array = NDArray[Any]
MOST_REFUSED, MOST_UNKNOWN = 0.05, 0.15
"""Shares of held-out sweeps that the box may refuse (stuck taxels, say), and call unknown, of which its limit makes some
.05; more means that thresholds or limit do not fit."""
RUNTIME = "0.2.0"
"""The first version of the box that reads such a manifest."""
REFUSED, UNKNOWN = -1, -2
"""What `score` gives instead of a label."""


class ExportRefused(BundleError):
    """A model that changed on its way to the box, or would not be one there."""


@dataclass(frozen=True)
class Content:
    """What goes into a bundle. model: `sweep` or `features` -> `logits`, and what `early` and `known` need. input: as in
    the manifest.

    train, held: what it was trained on and what it was not, parted by `held_by`. about: how it was made, figures: how
    it did, for the manifest. early, known: for the manifest, with the file means.npz where there is `known`.
    reference: the float form of a model in int8. made: the fit of one of our own networks, which `pack` completes.
    """

    model: onnx.ModelProto
    input: str
    train: Dataset
    held: Dataset
    held_by: str
    about: dict[str, Any]
    figures: dict[str, Any] = field(default_factory=dict)
    early: bundle.Early | None = None
    known: bundle.Known | None = None
    means: bytes = b""
    reference: onnx.ModelProto | None = None
    made: Fit | None = None


def pack(
    content: Content, target: Path, name: str, version: str, commit: str, full_scale: float | None = None,
    pitch_mm: float | None = None,
) -> bundle.Manifest:  # fmt: skip
    """Check `content` and put it at `target`, whole or not at all; an older bundle there is replaced.

    commit: of the code, for the manifest. full_scale: the sensor's highest digit where it is not its type's. pitch_mm: from
    taxel to taxel; where it is not known, the box cannot say how far a skin has moved.
    Raises ExportRefused where a check fails, and BundleError where a label or the target cannot be used.
    """
    content = completed(content)
    train, held = content.train, content.held
    logits = run(content.model, model_inputs(content.input, train))
    golden = golden_sweeps(train, logits, named_by_means(content, train) if content.known else logits)
    files = {bundle.MODEL: content.model.SerializeToString(), bundle.GOLDEN: golden}
    files |= {bundle.MEANS: content.means} if content.known else {}
    limits = thresholds(train, full_scale)
    manifest = bundle.Manifest(
        name=name, version=version, format=train.format, input=content.input, labels=train.materials,
        thresholds=limits, place=place_of(train, limits.contact, pitch_mm), runtime=RUNTIME, early=content.early, known=content.known, files={k: bundle.file_entry(v) for k, v in files.items()},
        made={"commit": commit, "set": train.source, "machine": platform.machine(), "cpus": os.cpu_count(),
              "torch": torch.__version__, "onnxruntime": onnxruntime.__version__} | content.about,
    )  # fmt: skip
    with _aside(target) as folder:
        for file, data in files.items():
            (folder / file).write_bytes(data)
        (folder / bundle.MANIFEST).write_bytes(manifest.json())
        figures = judge(
            folder, held, run(content.model, model_inputs(content.input, held)), f"held-out {content.held_by}"
        )
        manifest = replace(manifest, figures=figures | content.figures)
        (folder / bundle.MANIFEST).write_bytes(manifest.json())
        bundle.load(folder)
    return manifest


def trained(method: Method, sweeps: Dataset, seed: int) -> Content:
    """`method` trained on all but a fifth of the positions (else recordings) of `sweeps`, which judge it.

    Raises FormatError for a method whose features the box does not compute.
    """
    return train_content(method, sweeps, seed)[1]


def train_content(method: Method, sweeps: Dataset, seed: int) -> tuple[Model, Content]:
    """The model that `trained` trains, and its content."""
    if not method.runs_on_the_box:
        raise FormatError(
            f"method {method.name!r} looks at the features {method.input!r} of prior work, which the box does not compute; "
            "compare it with evaluate, and pack another"
        )
    train, held_out, held_by = hold_out(sweeps, seed)
    model = method.train(train, model_inputs(method.input, train), seed)
    about = {"method": method.name, "seed": seed, "ran": getattr(model, "ran", "")}
    forms = getattr(model, "forms", {})
    reference = forms["float"].graph() if "float" in forms else None
    made = getattr(model, "made", None)
    return model, Content(model.graph(), method.input, train, held_out, held_by, about, reference=reference, made=made)


def pack_to_measure(content: Content, target: Path, full_scale: float | None = None) -> bundle.Manifest:
    """Pack `content` under its method's name, so that every command that measures a method measures the same bundle."""
    return pack(content, target, content.about["method"], "1", provenance.commit(), full_scale)


def completed(content: Content) -> Content:
    """`content` with all that stands on the trunk of what was `made`: early answers where its sweeps support them, and
    what is known. As it is where nothing was held out, or not all its materials were trained."""
    made = content.made
    if made is None or made.train.materials != content.train.materials:
        return content
    try:
        done = calibrate(made)
    except FormatError:  # too few groups: nothing could judge
        return content
    rule = done.rule
    told = {"early": {"share": rule.share, "lost": rule.lost, "n": rule.n} if rule.early else rule.why}
    return replace(
        content, model=done.graph(made.trunk(tenths=bool(rule.early))), early=rule.early, known=done.known(),
        means=done.means(), about=content.about | told,
    )  # fmt: skip


def named_by_means(content: Content, sweeps: Dataset) -> Array:
    """Logits [N, K] as the box computes them from class means where a label is enrolled, not cooled."""
    embedding = onnx.ModelProto()
    embedding.CopyFrom(content.model)
    kept = [output for output in embedding.graph.output if output.name == "embedding"]
    del embedding.graph.output[:]
    embedding.graph.output.extend(kept)
    with np.load(io.BytesIO(content.means)) as means:
        named: Array = run(embedding, sweeps.samples) @ means["means"].T + means["bias"]
    return named


def golden_sweeps(sweeps: Dataset, logits: Array, also: Array) -> bytes:
    """An .npz of one training sweep of the first and the last material, and their logits.

    Of those that are recognised, by the logits `also` too, it is the one whose probability is the median: neither so sure that a small fault does
    not show, nor so unsure that rounding turns it. Raises ExportRefused where none is recognised.
    """
    index = []
    for label in (0, len(sweeps.materials) - 1):
        known = np.flatnonzero((sweeps.labels == label) & (logits.argmax(1) == label) & (also.argmax(1) == label))
        if not len(known):
            raise ExportRefused(f"no training sweep of {sweeps.materials[label]!r} is recognised; train longer")
        order = np.argsort(softmax(logits[known])[:, label], kind="stable")
        index.append(known[order[len(order) // 2]])
    packed = io.BytesIO()
    np.savez_compressed(packed, samples=sweeps.samples[index], logits=logits[index])
    return packed.getvalue()


def thresholds(sweeps: Dataset, full_scale: float | None) -> bundle.Thresholds:
    """What a window must reach: a tenth of the weakest contact in training, the strongest taxel's mean."""
    weakest = float(sweeps.samples.mean(axis=1, dtype=np.float64).max(axis=(1, 2)).min())
    kind = sweeps.samples.dtype
    top = np.finfo(kind).max if kind.kind == "f" else np.iinfo(kind).max
    # below the weakest also where a tared skin was pulled, and its digits are negative
    contact = weakest - 0.9 * abs(weakest)
    return bundle.Thresholds(contact=contact, full_scale=float(top if full_scale is None else full_scale))


def score(classifier: Classifier, sweeps: Dataset, *, fused: bool = False) -> Array:
    """Labels that the box gives, int64 [N] into the bundle's, or REFUSED or UNKNOWN.

    fused: each sweep gets what the box says after all of its recording.
    """
    form, labels = sweeps.format, classifier.bundle.manifest.labels
    t_ns, seq = (np.arange(form.window) * form.period_ns).astype(np.int64), np.arange(form.window)
    recording = np.unique(sweeps.group("recording"), return_inverse=True)[1]
    given = np.full(len(sweeps), REFUSED)
    for i in np.argsort(recording, kind="stable"):
        frames = Frames(t_ns, seq, sweeps.samples[i])
        verdict = classifier(Sweep(int(i), 0, int(t_ns[-1]), Status.OK, frames, object=fused * int(recording[i] + 1)))
        if verdict.label:
            given[recording == recording[i] if fused else i] = labels.index(verdict.label)
        elif verdict.status is Status.UNKNOWN and not fused:
            given[i] = UNKNOWN
    return given


def figures(classifier: Classifier, sweeps: Dataset, protocol: str) -> dict[str, Any]:
    """Accuracy by sweep, and by recording where one holds several; what the box refuses or does not know is wrong."""
    right = score(classifier, sweeps) == sweeps.labels
    told = {protocol: figure(int(right.sum()), len(sweeps))}
    first = np.unique(sweeps.group("recording"), return_index=True)[1]
    if len(first) < len(sweeps):
        right = (score(classifier, sweeps, fused=True) == sweeps.labels)[first]
        told[f"{protocol}, by recording"] = figure(int(right.sum()), len(first))
    return told


def judge(folder: Path, held: Dataset, logits: Array, protocol: str) -> dict[str, Any]:
    """Figures of the bundle in `folder` on `held`, run as the box runs it; `logits` [N, K]: what export saw there.

    Raises ExportRefused where the box gives another label than export, or refuses too many sweeps.
    """
    box = Classifier(bundle.load(folder), SystemClock())
    box.self_test()
    given = score(box, held)
    refused, unknown = given == REFUSED, given == UNKNOWN
    if other := int(np.sum((given != logits.argmax(1)) & (given >= 0))):
        raise ExportRefused(f"the box labels {other} of {len(held)} held-out sweeps otherwise than export did")
    if refused.mean() > MOST_REFUSED:
        raise ExportRefused(
            f"the box would refuse {refused.sum()} of {len(held)} held-out sweeps (limit {MOST_REFUSED:.0%}); "
            f"see their thresholds {box.bundle.manifest.thresholds}, and drop sweeps with stuck taxels from the set"
        )
    if unknown.mean() > MOST_UNKNOWN:
        raise ExportRefused(
            f"the box would call {unknown.sum()} of {len(held)} held-out sweeps unknown (limit {MOST_UNKNOWN:.0%}, "
            f"squared distance {box.bundle.manifest.known}); record more positions, so that it learns how sweeps vary"
        )
    return figures(box, held, protocol)


@contextlib.contextmanager
def _aside(target: Path) -> Iterator[Path]:
    """A new folder beside `target` that takes its place when the block ends well, and vanishes when it does not."""
    if target.exists() and not (target / bundle.MANIFEST).is_file():
        raise ExportRefused(f"{target} is no bundle and will not be replaced; name another folder with --out")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with storage.folder(target.resolve()) as new:
            yield new
    except OSError as e:
        raise ExportRefused(f"the bundle cannot be written to {target}: {e}; name another folder with --out") from e
