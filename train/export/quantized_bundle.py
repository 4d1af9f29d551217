"""The room where a trained network becomes int8 for the box. In: a Fit. Out: its bundle, or a refusal.

Nothing leaves whose int8 form answers otherwise than what was trained.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from appliance.bundle import bundle
from appliance.core.errors import FormatError
from appliance.core.storage import put
from appliance.sim import skin
from train.data.sets import Dataset
from train.export.pack import Content, ExportRefused, pack
from train.metrics.score import provenance
from train.models import networks
from train.models.compact.fit import Fit
from train.models.compact.network import Compact
from train.models.methods import model_inputs
from train.models.neural_methods import PAPER_INT8
from train.onnx_tools import parity
from train.onnx_tools.graph_builder import with_head
from train.onnx_tools.parity import Parity
from train.onnx_tools.quantize import quantize

Array = NDArray[Any]
MOST_TORCH_DIFFERENCE = 0.01
"""Of a logit, PyTorch against the float graph: the same sums in another order."""
MOST_LOST = 0.005
"""Of accuracy on held-out sweeps, float less int8: as float's own probabilities have it (Apart.expected_loss), whatever
the number of sweeps; and as counted, where it is no chance. Counting alone cannot tell: two unsure sweeps of a hundred
that change sides are two points lost or won."""
CHANCE = 0.05
"""As likely as that may it be, were neither form better, that int8 loses so many or more of the sweeps that they differ
on (one-sided sign test); below, what was counted is believed."""
LEAST_AGREEMENT, MOST_PROBABILITY_DIFFERENCE, MOST_MEAN_DIFFERENCE = 0.96, 0.3, 0.025
"""Share of held-out sweeps with equal labels, where one sweep may always differ; how far a probability of one may move,
and that on average. Of 14 fits of four sizes to five sets the worst had .974, .199 and .015."""

SATURATED = 0.01
"""Share of a tensor's values beyond reach from which on it is named as the cause, though noise grows with every layer
behind it."""


def export(
    fit: Fit, target: Path, name: str, version: str, commit: str, full_scale: float | None = None,
    pitch_mm: float | None = None,
) -> bundle.Manifest:  # fmt: skip
    """Quantize `fit`, check it, and pack it; see pack.pack. Raises ExportRefused where a check fails."""
    reference, model = graphs(fit)
    with torch.no_grad():
        wanted = fit.network()(torch.from_numpy(fit.held.samples.astype(np.float32))).numpy()
    apart = float(np.abs(wanted - parity.logits(reference, fit.held.samples)).max())
    if not apart <= MOST_TORCH_DIFFERENCE:
        raise ExportRefused(
            f"the float graph differs from pytorch by {apart:.3g} in a logit (limit {MOST_TORCH_DIFFERENCE}); "
            f"fit again, and look at train/exact.py if it stays"
        )
    about = fit.about | {"torch_difference": apart}
    content = Content(model, "raw", fit.train, fit.held, fit.about["held_out_by"], about, made=fit)
    return pack(checked(content, reference), target, name, version, commit, full_scale, pitch_mm)


def graphs(fit: Fit) -> tuple[onnx.ModelProto, onnx.ModelProto]:
    """(float, int8): `sweep` -> `logits`, each with a head fitted on what its own trunk gives."""
    reference = with_head(fit.trunk(int8=False), fit.weights["head.weight"], fit.weights["head.bias"])
    return reference, with_head(fit.trunk(), *fit.int8_head())


def checked(content: Content, reference: onnx.ModelProto | None) -> Content:
    """`content`, whose model is int8, with how it compares with its float form `reference`; as it is where there is none.

    Raises ExportRefused where `check` does.
    """
    if reference is None:
        return content
    held = content.held
    found = parity.measure(
        content.model, model_inputs(content.input, held), held.labels, reference, held.group(content.held_by)
    )
    check(found)
    return replace(content, figures=content.figures | {"parity": found.summary()})


def check(found: Parity) -> None:
    """Raises ExportRefused, with the number, its limit and what to try, where int8 is not what float was."""
    apart, lost = found.apart, found.lost
    if apart is None or lost is None:
        raise ExportRefused("there is no float form that int8 could be compared with; export a fit")
    hint = "drop training sweeps that are unlike all others, record more, or take a larger network"
    if found.layers:
        worst = min(found.layers, key=lambda layer: (layer.saturated < SATURATED, layer.sqnr_db))
        hint = (f"{worst.tensor} suffers most ({worst.sqnr_db:.0f} dB, {worst.saturated:.1%} beyond what int8 reaches; "
                f"see palpate-train parity): {hint}")  # fmt: skip
    if lost.lost > MOST_LOST and lost.chance < CHANCE:
        raise ExportRefused(
            f"int8 is right on {lost.int8_right} of {lost.total} held-out sweeps, float on {lost.float_right}: "
            f"{100 * lost.lost:.2f} points lost (limit {100 * MOST_LOST}); {hint}"
        )
    given_away, moved, moved_mean = apart.expected_loss, apart.probability_difference, apart.probability_mean
    if not given_away <= MOST_LOST:
        raise ExportRefused(
            f"int8 loses {100 * given_away:.2f} points on held-out sweeps, by float's own probabilities "
            f"(limit {100 * MOST_LOST}); {hint}"
        )
    if not (moved <= MOST_PROBABILITY_DIFFERENCE and moved_mean <= MOST_MEAN_DIFFERENCE):
        raise ExportRefused(
            f"int8 moves a probability of held-out sweeps by up to {moved:.3f} (limit {MOST_PROBABILITY_DIFFERENCE}), "
            f"by {moved_mean:.3f} on average (limit {MOST_MEAN_DIFFERENCE}); {hint}"
        )
    if round(lost.total * (1 - apart.agreement)) > max(1, (1 - LEAST_AGREEMENT) * lost.total):
        raise ExportRefused(
            f"int8 agrees with float on {apart.agreement:.3f} of {lost.total} held-out sweeps (limit {LEAST_AGREEMENT}); {hint}"
        )


def compared(source: Path, sweeps: Dataset, file: Path | None = None) -> str:
    """The table of float against int8 on `sweeps`; source: a fit, or a bundle, which has no float form. file: JSON.

    Raises FormatError where formats or materials differ, or nothing is in int8.
    """
    if source.is_dir():
        held = bundle.load(source)
        form, materials = held.format, held.manifest.labels
        model, reference, kind = onnx.load_from_string(held.model), None, held.manifest.input
    else:
        made = Fit.load(source)
        form, materials, kind = made.train.format, made.train.materials, "raw"
        reference, model = graphs(made)
    if (form, materials) != (sweeps.format, sweeps.materials):
        raise FormatError(
            f"{source.name} is of {form} and {', '.join(materials)}; {sweeps.source} of {sweeps.format} and "
            f"{', '.join(sweeps.materials)}: name a set of the same kind"
        )
    found = parity.measure(model, model_inputs(kind, sweeps), sweeps.labels, reference, sweeps.group("recording"))
    if file:
        told = {"model": source.name, "set": sweeps.source} | found.json() | provenance()
        put(file, (json.dumps(told, indent=1) + "\n").encode(), parents=True)
    return parity.table(found)


def references(folder: Path, seed: int = 0) -> tuple[Path, Path]:
    """Write what `palpate bench` times beside the bundle: fp32.onnx and paper_int8.onnx, both with random weights.

    The first is the default bundle's network in float32, the second the paper's CNN in int8; both take its sweeps.
    """
    rng, form, classes = np.random.default_rng(seed), skin.FORMAT, len(skin.MATERIALS)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        small = Compact(form, classes, 0.1, norm=False).eval().graph()
    digits = rng.integers(0, 256, (4, form.window, form.rows, form.cols), np.uint8)
    paper = quantize(networks.paper_cnn(form, classes, rng), digits, PAPER_INT8)
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "fp32.onnx", folder / "paper_int8.onnx"
    for path, model in zip(paths, (small, paper), strict=True):
        path.write_bytes(model.SerializeToString())
    return paths
