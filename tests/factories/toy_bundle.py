"""A bundle whose answers are known by arithmetic, and windows for it.

Its embedding is made of two taxels: z = (mean of taxel 1.1, mean of taxel 1.2) / 10 - 10. Its
materials "a", "b" and "c" lie at (0, 0), (6, 0) and (0, 6). With several axes it uses the normal
axis.
"""

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.answer.contact import ContactPositions, DisplacementRule
from palpate.answer.disturbance import Disturbances
from palpate.answer.early import Early
from palpate.answer.pipeline import Context, Stage
from palpate.answer.unknown import Known
from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle, Manifest, Thresholds
from palpate.core.types import EPOCH_BITS, Frames, Status, Sweep, SweepFormat
from palpate.inference.classifier import Classifier

FORMAT = SweepFormat(2, 2, 100.0, 20, "int16")
THREE_AXES = replace(FORMAT, axes=3)
MEANS = np.array([[0, 0], [6, 0], [0, 6]], np.float32)
KNOWN = Known(strict=9.0, balanced=9.0, loose=9.0, temperature=2.0)
DISPLACEMENT = DisplacementRule(limit=4.0, temperature=3.0, unsure=0.75)
"""Rule for displaced sweeps, with the arrays of `displaced_arrays`."""
IN_PLACE = ContactPositions(1.0, (0.5,), (0.5,), 0.25)
"""The contact of a sweep with a small embedding is in the middle. A larger embedding displaces it
by up to this limit.
"""
LIMITS = Thresholds(contact=10, full_scale=32767, unsure=0.5)
OUTPUTS = ("logits", "embedding")


def window(z1: float, z2: float, format: SweepFormat = FORMAT) -> np.ndarray:
    """Raw counts [T, R, C] with the embedding in tenths; shear is a tenth of the load."""
    level = np.full((format.rows, format.cols), 100.0)
    level[0, :2] += 10 * z1, 10 * z2
    ripple = np.where(np.arange(format.window) % 2, 1, -1)[:, None, None]
    normal = level + ripple
    shear = [0.1 * level + 2 * ripple] * (format.axes - 1)
    counts = np.rint(np.stack([*shear, normal], axis=-1)).reshape(-1, *format.shape)
    return counts.astype(format.numpy_type)


def sweep(
    z1: float, z2: float, number: int = 1, object: int = 0, format: SweepFormat = FORMAT
) -> Sweep:
    """A valid sweep with this embedding."""
    frames = frames_of(window(z1, z2, format))
    return Sweep(number, 0, 0, Status.OK, frames, object=object)


def sweep_of(taxels: np.ndarray, **more: Any) -> Sweep:
    """A valid sweep with this window."""
    return Sweep(1, 0, 0, Status.OK, frames_of(taxels), **more)


def frames_of(taxels: np.ndarray, epoch: int = 0) -> Frames:
    """Frames with these counts, numbered from 0."""
    n = np.arange(len(taxels))
    return Frames(n, n + (epoch << EPOCH_BITS), taxels)


def model(
    outputs: Sequence[str] = OUTPUTS,
    steps: int = 3,
    format: SweepFormat = FORMAT,
    scale: float = 0.1,
    labels: int = 3,
) -> bytes:
    """The graph: row d of early heads is (d + 1) times the logits; extras are copies."""
    onnx = pytest.importorskip("onnx", reason="onnx comes with the desktop's tools (make test)")
    node, array = onnx.helper.make_node, onnx.numpy_helper.from_array
    values = format.rows * format.cols * format.axes
    pick = np.zeros((values, 2), np.float32)
    pick[format.axes - 1, 0] = pick[2 * format.axes - 1, 1] = scale
    bias = -(MEANS[:labels] ** 2).sum(1) / 2
    constants = {
        "axes": np.array([1]),
        "flat": np.array([1, values]),
        "pick": pick,
        "shift": np.float32([-10, -10]),
        "weights": MEANS[:labels].T / KNOWN.temperature,
        "bias": bias / np.float32(KNOWN.temperature),
        "one": np.array([1, 1, labels]),
        "steps": np.arange(1, steps + 1, dtype=np.float32)[None, :, None],
        "each": np.ones((1, steps, 1), np.float32),
        "place": np.array([1, 1, 2]),
    }
    nodes = [
        node("Cast", ["sweep"], ["float"], to=1),
        node("ReduceMean", ["float", "axes"], ["mean"], keepdims=0),
        node("Reshape", ["mean", "flat"], ["taxels"]),
        node("Gemm", ["taxels", "pick", "shift"], ["embedding"]),
        node("Gemm", ["embedding", "weights", "bias"], ["logits"]),
        node("Reshape", ["logits", "one"], ["row"]),
        node("Mul", ["row", "steps"], ["early"]),
    ]
    shapes = {"logits": [1, labels], "embedding": [1, 2], "early": [1, steps, labels]}
    if "early_embedding" in outputs:
        nodes += [
            node("Reshape", ["embedding", "place"], ["z"]),
            node("Mul", ["z", "each"], ["early_embedding"]),
        ]
        shapes["early_embedding"] = [1, steps, 2]
    for name in set(outputs) - shapes.keys():
        nodes.append(node("Identity", ["logits"], [name]))
    value = onnx.helper.make_tensor_value_info
    kind = onnx.helper.np_dtype_to_tensor_dtype(format.numpy_type)
    given = value("sweep", kind, [1, format.window, *format.shape])
    made = [value(name, 1, shapes.get(name, [1, labels])) for name in outputs]
    held = [array(values, name) for name, values in constants.items()]
    graph = onnx.helper.make_graph(nodes, "toy", [given], made, held)
    opsets = [onnx.helper.make_opsetid("", 18)]
    made = onnx.helper.make_model(graph, opset_imports=opsets, ir_version=9)
    return bytes(made.SerializeToString())


def npz(**arrays: np.ndarray) -> bytes:
    """The bytes of an .npz file."""
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    return packed.getvalue()


def npy(array: np.ndarray) -> bytes:
    """The bytes of an .npy file."""
    packed = io.BytesIO()
    np.save(packed, array)
    return packed.getvalue()


def means(**changes: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of means.npz."""
    made = {"means": MEANS, "bias": -(MEANS**2).sum(1) / 2, "sweeps": np.zeros(3, np.int64)}
    made |= {"spread": np.ones(3, np.float32), "shapes": np.zeros((3, 0, 0), np.float16)}
    return made | changes


def early_arrays(steps: int = 3) -> dict[str, np.ndarray]:
    """Arrays of means.npz for unfinished sweeps: as at the end, variance 1."""
    return {
        "early_means": np.tile(MEANS, (steps, 1, 1)),
        "early_shapes": np.tile(np.eye(2, dtype=np.float16), (steps, 1, 1)),
    }


def displaced_arrays() -> dict[str, np.ndarray]:
    """Further arrays of means.npz, for displaced sweeps.

    At the trained positions "a" scatters twice as far in the second direction as the others.
    Displaced sweeps scatter ten times as far in the first direction; their means are 0.1 further
    there, after `displaced_turn`.
    """
    shapes = np.stack([np.eye(1)] * 3).astype(np.float16)
    turn = np.diag([0.1, 1]).astype(np.float32)
    at = (MEANS @ turn + [0.1, 0]).astype(np.float32)
    return {
        "shapes": shapes * np.float16([0.5, 1, 1])[:, None, None],
        "displaced_turn": turn,
        "displaced_means": at,
        "displaced_shapes": shapes,
    }


def files(
    *,
    known: Known | None = KNOWN,
    early: Early | None = None,
    outputs: Sequence[str] = OUTPUTS,
    format: SweepFormat = FORMAT,
    arrays: dict[str, np.ndarray] | None = None,
    displacement: DisplacementRule | None = None,
    contact: ContactPositions | None = None,
    disturbances: Disturbances | None = None,
    **graph: float,
) -> dict[str, bytes]:
    """The files of a toy bundle by name."""
    arrays = means() if arrays is None else arrays
    at = np.stack([window(2.5, 0.5, format), window(0.5, 3.5, format)])
    z = np.zeros((2, arrays["means"].shape[1]), np.float32)
    z[:, :2] = [[2.5, 0.5], [0.5, 3.5]]
    logits = (z @ arrays["means"].T + arrays["bias"]) / KNOWN.temperature
    content = {
        bundle.MODEL: model(outputs, format=format, **graph),
        bundle.GOLDEN: npz(changes=bundle.arrays.changes(at), logits=logits),
    }
    if known:
        content[bundle.MEANS] = npz(**arrays)
    manifest = Manifest(
        "toy",
        "1",
        format,
        "raw",
        tuple("abcdef"[: logits.shape[1]]),
        LIMITS,
        {k: bundle.file_entry(v) for k, v in content.items()},
        figures={"LOPO": {"accuracy": 1.0}},
        made={"seed": 1},
        early=early,
        known=known,
        displacement=displacement,
        contact=contact,
        disturbances=disturbances,
    )
    return content | {bundle.MANIFEST: manifest.json()}


def put(folder: Path, content: dict[str, bytes]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, data in content.items():
        (folder / name).write_bytes(data)
    return folder


def load(folder: Path, **more) -> Bundle:
    """A toy bundle, written to `folder` and read from it."""
    return bundle.load(put(folder, files(**more)))


class GivenAnswer:
    """Gives `probabilities` float64 [K] where a network would compute them."""

    def __init__(self, probabilities: np.ndarray) -> None:
        self._probabilities = probabilities

    def apply(self, context: Context) -> None:
        with np.errstate(divide="ignore"):
            context.logits = np.log(self._probabilities)


def told(it: Classifier, probabilities: np.ndarray) -> list[Stage]:
    """The stages of a classifier whose network gives these probabilities to each sweep."""
    return it.stages(GivenAnswer(probabilities))
