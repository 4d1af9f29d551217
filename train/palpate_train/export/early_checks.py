"""The check of unknown materials in unfinished sweeps, so that an early answer needs a known
material, as the answer to a whole sweep does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import onnx
from onnx import TensorProto, helper

from palpate.bundle import arrays
from palpate.bundle.bundle import EarlyClasses, file_entry
from palpate.bundle.manifest import MANIFEST, MEANS, MODEL, Manifest
from palpate.core.errors import FormatError
from palpate.core.storage import put_all
from palpate_train.calibration.early_exit import early_classes, early_limits
from palpate_train.data.sets import Dataset
from palpate_train.export.bridging import measurable
from palpate_train.export.bundle_graph import STEPS
from palpate_train.onnx_tools.graph_builder import run_output


def measure(
    model: onnx.ModelProto, train: Dataset, held_out: Dataset
) -> tuple[EarlyClasses, tuple[float, ...]]:
    """The classes of unfinished sweeps and the limit of each step, from the output STEPS of
    `model`. The limits are found on held-out sweeps."""
    classes = early_classes(run_output(model, STEPS, train.samples), train.labels)
    return classes, early_limits(classes, run_output(model, STEPS, held_out.samples))


def exposed(model: onnx.ModelProto) -> onnx.ModelProto:
    """`model` with the output STEPS, which older bundles compute but do not give. Raises
    FormatError if it has no early heads of bundle_graph."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    found = {name: node for node in model.graph.node for name in node.output}
    shapes = {value.name: value.type.tensor_type.shape.dim for value in model.graph.output}
    if STEPS in shapes:
        return made
    try:
        rows = found[found["head.steps"].input[0]].input[0]
        sizes = [1, shapes["early"][1].dim_value, shapes["embedding"][1].dim_value]
    except KeyError as e:
        raise FormatError(
            f"the model has no {e}, so it gives no early answers; export it from a fit"
        ) from e
    for node in made.graph.node:
        for names in (node.input, node.output):
            renamed = [STEPS if name == rows else name for name in names]
            del names[:]
            names.extend(renamed)
    made.graph.output.append(helper.make_tensor_value_info(STEPS, TensorProto.FLOAT, sizes))
    onnx.checker.check_model(made, full_check=True)
    return made


def write(folder: Path, trained_on: Dataset, fresh: Dataset) -> Manifest:
    """Add the check to the bundle in `folder`: an output of its model, class means and limits.
    Logits and embedding stay as they are.

    trained_on: its training sweeps. fresh: sweeps that it has not seen. Raises FormatError as
    bridging.measurable, and if the bundle has no early answers or detects no unknown materials.
    """
    measurable(folder, trained_on)
    loaded = measurable(folder, fresh)
    early, classes = loaded.manifest.early, loaded.classes
    if early is None or classes is None:
        raise FormatError(
            f"bundle {loaded.id} lacks early answers or a limit of known materials; export it from "
            "a fit"
        )
    model = exposed(onnx.load_from_string(loaded.model))
    steps, limits = measure(model, trained_on, fresh)
    files = {
        MODEL: model.SerializeToString(),
        MEANS: arrays.packed(**replace(classes, early=steps).arrays()),
    }
    manifest = replace(
        loaded.manifest,
        early=replace(early, limits=limits),
        files=loaded.manifest.files | {name: file_entry(data) for name, data in files.items()},
    )
    files |= {MANIFEST: manifest.json()}
    put_all({folder / name: data for name, data in files.items()})
    return manifest


def text(manifest: Manifest) -> str:
    """Whether early answers need a known material, in words; "" without early answers."""
    if manifest.early is None:
        return ""
    if not manifest.early.limits:
        return "early answers: unknown materials are not detected before the end of a sweep"
    return f"early answers: only of known materials, at each of {len(manifest.early.limits)} steps"
