"""A fit as a bundle in int8, or in float if its int8 model does not answer as the float model
does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

import numpy as np
import onnx
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core import provenance
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.inference.classifier import Classifier
from palpate_train.answer.rules import ALL
from palpate_train.data import extras
from palpate_train.data.sets import Dataset
from palpate_train.export import fit_rules, pack
from palpate_train.export.contents import Content, ExportRefused, content_of
from palpate_train.export.pack import PackOptions
from palpate_train.metrics import bundle_score, tolerances
from palpate_train.models.method_fit import MethodFit
from palpate_train.models.methods import Model, model_inputs
from palpate_train.models.recipe.fitted import Fit, FittedModel, finished
from palpate_train.onnx_tools import parity
from palpate_train.onnx_tools.graph_builder import run, with_head
from palpate_train.onnx_tools.parity import AccuracyLoss, AnswerDifference

Array = NDArray[Any]
MOST_TORCH_DIFFERENCE = 0.01
"""Largest difference of a logit between PyTorch and the float graph, which add the same numbers in
another order."""
CHANCE = 0.05
"""Level of significance of the one-sided sign test on the sweeps on which both precisions differ,
that int8 is not worse. The loss of accuracy by int8 is limited as expected from float's
probabilities (AnswerDifference.expected_loss), for any number of sweeps; and as counted, if the
probability is below this. Counting alone is not enough: two uncertain sweeps of a hundred that
change their label are two points lost or won."""
LEAST_AGREEMENT, MOST_PROBABILITY_DIFFERENCE, MOST_MEAN_DIFFERENCE = 0.96, 0.3, 0.025
"""Least share of held-out sweeps with equal labels, of which one may always differ; largest change
of a probability, and largest mean change. The worst of 14 fits of four sizes to five sets had
0.974, 0.199 and 0.015."""


def export(
    fit: Fit | MethodFit,
    target: Path,
    name: str,
    version: str,
    commit: str,
    **options: Unpack[PackOptions],
) -> bundle.Manifest:
    """Compare the precisions of `fit`, and pack it; see pack.pack.

    If int8 of our recipe differs too much, the bundle holds the float model, whose trunk is
    calibrated for that, and `made` says why; another method has no form in float to keep instead.
    Raises FormatError if nothing was held out to judge the bundle by, and ExportRefused if another
    check fails.
    """
    if isinstance(fit, Fit):
        left_out = options.get("asked", ALL).left_out
        content = _quantized(fit, options.get("pitch_mm"), left_out)
    else:
        content = content_of(fit)
        if fit.reference is not None:
            content = checked(content, fit.reference)
    return pack.pack(content, target, name, version, commit, **options)


def _quantized(fit: Fit, pitch_mm: float | None, left_out: Sequence[str]) -> Content:
    """The content of a bundle of our recipe, in int8 or else in float. Raises FormatError."""
    if fit.about["held_out_by"] == "nothing":
        raise FormatError(fit.uncalibrated)
    (reference, model), about = graphs(fit), fit.about
    if fit.architecture.channels:
        about = about | {"torch_difference": _torch_difference(fit, reference)}
    content = Content(
        model, "raw", fit.train, fit.held, about["held_out_by"], about, contacts=fit.contacts
    )
    try:
        content = checked(content, reference)
    except ExportRefused as e:
        content = replace(content, model=reference, about=about | {"float_because": str(e)})
        fit = finished(fit.in_float())
    return fit_rules.from_features(content, fit, pitch_mm, left_out)


def _torch_difference(fit: Fit, reference: onnx.ModelProto) -> float:
    """The largest difference of a logit between stages in PyTorch and the float graph; the other
    features exist in the graph alone. Raises ExportRefused above MOST_TORCH_DIFFERENCE."""
    with extras.needed_for("the check of trained stages"):
        import torch

        from palpate_train.models.recipe.stages import network_of

    network, counts = network_of(fit), torch.from_numpy(fit.held.samples.astype(np.float32))
    features = run(fit.trunk(int8=False), fit.held.samples)
    with torch.no_grad():
        features[:, : sum(fit.architecture.channels)] = network.features(network.prepare(counts))
    wanted = features @ fit.weights["head.weight"].T + fit.weights["head.bias"]
    difference = float(np.abs(wanted - parity.logits(reference, fit.held.samples)).max())
    if not difference <= MOST_TORCH_DIFFERENCE:
        raise ExportRefused(
            f"the float graph differs from pytorch by {difference:.3g} in a logit (limit "
            f"{MOST_TORCH_DIFFERENCE}); "
            "fit again; if it stays, compare models/recipe/graph.py with stages.py"
        )
    return difference


def graphs(fit: Fit) -> tuple[onnx.ModelProto, onnx.ModelProto]:
    """(float, int8): `sweep` -> `logits`, each with a head fitted to the features of its own
    trunk."""
    reference = with_head(
        fit.trunk(int8=False), fit.weights["head.weight"], fit.weights["head.bias"]
    )
    return reference, with_head(fit.trunk(), *fit.int8_head())


def checked(content: Content, reference: onnx.ModelProto) -> Content:
    """`content`, whose model is int8, with a comparison with the float model `reference`. Raises
    ExportRefused as `check`."""
    held_out = content.held_out
    apart, lost = parity.measure(
        content.model,
        reference,
        model_inputs(content.input, held_out),
        held_out.labels,
        held_out.group(content.held_out_by),
    )
    check(apart, lost)
    figures = content.figures | {"parity": asdict(apart) | asdict(lost)}
    return replace(content, figures=figures)


def check(apart: AnswerDifference, lost: AccuracyLoss) -> None:
    """Raises ExportRefused, with the number, its limit and a remedy, if int8 differs too much from
    float."""
    largest, mean = apart.probability_difference, apart.probability_mean
    why = ""
    if lost.lost > tolerances.LOST and lost.chance < CHANCE:
        why = (
            f"is right on {lost.int8_right} of {lost.total} held-out sweeps, float on "
            f"{lost.float_right}: {100 * lost.lost:.2f} points lost (limit {100 * tolerances.LOST})"
        )
    elif not apart.expected_loss <= tolerances.LOST:
        why = (
            f"loses {100 * apart.expected_loss:.2f} points on held-out sweeps, by float's own "
            f"probabilities (limit {100 * tolerances.LOST})"
        )
    elif not (largest <= MOST_PROBABILITY_DIFFERENCE and mean <= MOST_MEAN_DIFFERENCE):
        why = (
            f"moves a probability of held-out sweeps by up to {largest:.3f} (limit "
            f"{MOST_PROBABILITY_DIFFERENCE}), by {mean:.3f} on average (limit "
            f"{MOST_MEAN_DIFFERENCE})"
        )
    elif round(lost.total * (1 - apart.agreement)) > max(1, (1 - LEAST_AGREEMENT) * lost.total):
        why = (
            f"agrees with float on {apart.agreement:.3f} of {lost.total} held-out sweeps (limit "
            f"{LEAST_AGREEMENT})"
        )
    if why:
        raise ExportRefused(
            f"int8 {why}; drop training sweeps that are unlike all others, or record more"
        )


def box_answers(model: Model, sweeps: Dataset) -> tuple[Array, Array] | None:
    """The box's answers to `sweeps`, as `export` and `score` give them, see fold.AsTheBox; None for
    a model that is not a fit. Raises FormatError or BundleError if export refuses the model."""
    if not isinstance(model, FittedModel):
        return None
    own = model.fit.train.materials
    with TemporaryDirectory() as folder:
        pack_fold(model.fit, target := Path(folder) / "bundle")
        classifier = Classifier(bundle.load(target), SystemClock())
        found, sure = bundle_score.labels_of(classifier, sweeps)
    labels = [sweeps.materials.index(own[k]) if k >= 0 else int(k) for k in found]
    return np.array(labels, int), sure


def pack_fold(fit: Fit, target: Path) -> None:
    """Calibrate `fit` and export it with all rules of the answer. Its materials get names that any
    bundle may have: they change no answer. Raises FormatError or BundleError if export refuses."""
    names = tuple(f"m{number}" for number in range(len(fit.train.materials)))
    sides = {side: replace(getattr(fit, side), materials=names) for side in ("train", "held")}
    export(finished(replace(fit, **sides)), target, "fold", "1", provenance.commit(), proven=False)


def text(manifest: bundle.Manifest) -> str:
    """What int8 changes in the answers, in words; "" for a model in float."""
    if (found := manifest.figures.get("parity")) is None:
        return ""
    return (
        f"int8 against float: {100 * found['agreement']:.1f} % of {found['total']} labels equal, "
        f"a probability differs by up to {found['probability_difference']:.3f}; right on "
        f"{found['int8_right']}, float on {found['float_right']}"
    )
