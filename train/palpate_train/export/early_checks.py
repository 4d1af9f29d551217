"""The check of unknown materials in unfinished sweeps, so that an early answer needs a known
material, as the answer to a whole sweep does."""

from __future__ import annotations

import onnx

from palpate.answer.unknown import EarlyClasses
from palpate.bundle.manifest import Manifest
from palpate_train.calibration.early_exit import early_classes, early_limits
from palpate_train.data.sets import Dataset
from palpate_train.export.bundle_graph import STEPS
from palpate_train.onnx_tools.graph_builder import run_output


def measure(
    model: onnx.ModelProto, train: Dataset, held_out: Dataset
) -> tuple[EarlyClasses, tuple[float, ...]]:
    """The classes of unfinished sweeps and the limit of each step, from the output STEPS of
    `model`. The limits are found on held-out sweeps."""
    classes = early_classes(run_output(model, STEPS, train.samples), train.labels)
    return classes, early_limits(classes, run_output(model, STEPS, held_out.samples))


def text(manifest: Manifest) -> str:
    """Whether early answers need a known material, in words; "" without early answers."""
    if manifest.early is None:
        return ""
    if not manifest.early.limits:
        return "early answers: unknown materials are not detected before the end of a sweep"
    return f"early answers: only of known materials, at each of {len(manifest.early.limits)} steps"
