"""The room where a Fit becomes a bundle. In: a Fit, a folder. Out: the folder with manifest, int8 model, golden sweeps.

Nothing leaves that does not do on this machine, through the box's own classifier, what was trained.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

from appliance import bundle
from appliance.classifier import Classifier, session, softmax
from appliance.clock import SystemClock
from appliance.errors import BundleError
from appliance.sim import skin
from appliance.sweep import Frames, Status, Sweep

from . import networks
from .fit import Fit, closed_form_head, figure
from .sets import SweepSet

Array = NDArray[Any]
CALIBRATION_SWEEPS = 96
PERCENTILE = 99.9
"""Of the values that int8 must reach: with their full range one outlier sweep takes the resolution from all others."""
MOST_LOGIT_DIFFERENCE = 0.01
"""PyTorch against the float graph: the same sums in another order."""
LEAST_AGREEMENT = 0.95
MOST_PROBABILITY_DIFFERENCE = 0.5
"""Float against int8 on held-out sweeps: share of equal labels, and how far any probability may move."""
MOST_REFUSED = 0.05
"""Share of held-out sweeps that the box may refuse (stuck taxels, say); more means that its thresholds do not fit."""


class ExportRefused(BundleError):
    """A model that changed on its way to the box, or would not be one there."""


@dataclass(frozen=True)
class Parity:
    """What export did to the answers on held-out sweeps; the limits stand above."""

    logit_difference: float
    agreement: float
    probability_difference: float

    def check(self) -> None:
        """Raises ExportRefused, with the numbers, where a limit is passed or a number is none."""
        if not self.logit_difference <= MOST_LOGIT_DIFFERENCE:
            raise ExportRefused(
                f"the float graph differs from pytorch by {self.logit_difference:.3g} in a logit "
                f"(limit {MOST_LOGIT_DIFFERENCE}); fit again, and look at train/networks.py if it stays"
            )
        far = not self.probability_difference <= MOST_PROBABILITY_DIFFERENCE
        if far or self.agreement < LEAST_AGREEMENT:
            raise ExportRefused(
                f"int8 agrees with float on {self.agreement:.3f} of the held-out sweeps (limit {LEAST_AGREEMENT}) "
                f"and moves a probability by up to {self.probability_difference:.3f} "
                f"(limit {MOST_PROBABILITY_DIFFERENCE}); train on sweeps that are more like those held out"
            )


def export(
    fit: Fit, target: Path, name: str, version: str, commit: str, full_scale: float | None = None
) -> bundle.Manifest:
    """Quantize `fit`, check it, and put the bundle at `target`, whole or not at all; an older bundle there is replaced.

    commit: of the code, for the manifest. full_scale: the sensor's highest digit where it is not its type's.
    Raises ExportRefused where a check fails, and BundleError where a label or the target cannot be used.
    """
    model, parity = quantized(fit)
    golden = golden_sweeps(fit.train, run(model, fit.train.samples))
    files = {bundle.MODEL: model.SerializeToString(), bundle.GOLDEN: golden}
    manifest = bundle.Manifest(
        name=name, version=version, format=fit.train.format, input="raw", labels=fit.train.materials,
        thresholds=thresholds(fit.train, full_scale), files={k: bundle.file_entry(v) for k, v in files.items()},
        made={"commit": commit, "set": fit.train.source, "machine": platform.machine(), "cpus": os.cpu_count(),
              "torch": torch.__version__, "onnxruntime": onnxruntime.__version__} | fit.about,
    )  # fmt: skip
    with _aside(target) as folder:
        for file, content in files.items():
            (folder / file).write_bytes(content)
        (folder / bundle.MANIFEST).write_bytes(manifest.json())
        figures = judge(folder, fit.held, run(model, fit.held.samples), f"held-out {fit.about['held_out_by']}")
        manifest = replace(manifest, figures=figures | {"parity": asdict(parity)})
        (folder / bundle.MANIFEST).write_bytes(manifest.json())
        bundle.load(folder)
    return manifest


def quantized(fit: Fit) -> tuple[onnx.ModelProto, Parity]:
    """The int8 model, its head refitted on what the int8 trunk gives. Raises ExportRefused where parity is broken."""
    trunk = networks.trunk(fit.train.format, fit.scale, fit.weights, fit.keep_means)
    whole = networks.with_head(trunk, fit.weights["head.weight"], fit.weights["head.bias"])
    some = np.linspace(0, len(fit.train) - 1, min(CALIBRATION_SWEEPS, len(fit.train))).astype(int)
    int8_trunk = quantize(trunk, fit.train.samples[some])
    seen, held = run(int8_trunk, fit.train.samples), run(int8_trunk, fit.held.samples)
    model = networks.with_head(int8_trunk, *closed_form_head(seen, fit.train.labels, held, fit.held.labels))
    with torch.no_grad():
        torch_logits = fit.network()(torch.from_numpy(fit.held.samples.astype(np.float32))).numpy()
    float_logits, int8_logits = (run(m, fit.held.samples) for m in (whole, model))
    parity = Parity(
        float(np.abs(torch_logits - float_logits).max()),
        float(np.mean(float_logits.argmax(1) == int8_logits.argmax(1))),
        float(np.abs(softmax(float_logits) - softmax(int8_logits)).max()),
    )
    parity.check()
    return model, parity


def quantize(model: onnx.ModelProto, sweeps: Array, ops: Sequence[str] = ("Conv", "Relu")) -> onnx.ModelProto:
    """`model` with its nodes `ops` in int8, ranges found on `sweeps`: digits [n, T, R, C].

    Weights keep to seven bits: two products of eight overflow the 16-bit sums of an x86 without VNNI, and then the
    answer there is another than on Arm.
    """
    mine = onnx.ModelProto()
    mine.CopyFrom(model)  # onnxruntime moves the weights of what it is given to a file
    mine.metadata_props.add(key="onnx.quant.pre_process", value="onnxruntime.quant")  # nothing to simplify beforehand
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = Path(folder) / "int8.onnx"
        quantize_static(
            mine, path, _Reader(sweeps), QuantFormat.QDQ, list(ops), per_channel=True, reduce_range=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.Percentile, extra_options={"CalibPercentile": PERCENTILE},
        )  # fmt: skip
        return onnx.load(path)


class _Reader(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime ships no types
    """Hands sweeps to the calibration one by one."""

    def __init__(self, sweeps: Array) -> None:
        self._left = iter(sweeps)

    def get_next(self) -> dict[str, Array] | None:
        """The next input of the graph, None at the end."""
        sweep = next(self._left, None)
        return None if sweep is None else {"sweep": sweep[None]}


def run(model: onnx.ModelProto, sweeps: Array) -> Array:
    """What `model` gives for each of `sweeps`, float32 [n, size], in the box's own kind of session."""
    of_the_box = session(model.SerializeToString())
    return np.concatenate([of_the_box.run(None, {"sweep": sweep[None]})[0] for sweep in sweeps])


def golden_sweeps(sweeps: SweepSet, logits: Array) -> bytes:
    """An .npz of one training sweep of the first and the last material, and their logits.

    Of those that are recognised it is the one whose probability is the median: neither so sure that a small fault does
    not show, nor so unsure that rounding turns it. Raises ExportRefused where none is recognised.
    """
    index = []
    for label in (0, len(sweeps.materials) - 1):
        known = np.flatnonzero((sweeps.labels == label) & (logits.argmax(1) == label))
        if not len(known):
            raise ExportRefused(f"no training sweep of {sweeps.materials[label]!r} is recognised; train longer")
        order = np.argsort(softmax(logits[known])[:, label], kind="stable")
        index.append(known[order[len(order) // 2]])
    packed = io.BytesIO()
    np.savez_compressed(packed, samples=sweeps.samples[index], logits=logits[index])
    return packed.getvalue()


def thresholds(sweeps: SweepSet, full_scale: float | None) -> bundle.Thresholds:
    """What a window must reach: a tenth of the weakest contact in training, the strongest taxel's mean."""
    weakest = float(sweeps.samples.mean(axis=1, dtype=np.float64).max(axis=(1, 2)).min())
    kind = sweeps.samples.dtype
    top = np.finfo(kind).max if kind.kind == "f" else np.iinfo(kind).max
    # below the weakest also where a tared skin was pulled, and its digits are negative
    contact = weakest - 0.9 * abs(weakest)
    return bundle.Thresholds(contact=contact, full_scale=float(top if full_scale is None else full_scale))


def score(classifier: Classifier, sweeps: SweepSet, *, fused: bool = False) -> Array:
    """Labels that the box gives, int64 [N] into the bundle's, -1 where it refuses the sweep.

    fused: each sweep gets what the box says after all of its recording.
    """
    form, labels = sweeps.format, classifier.bundle.manifest.labels
    t_ns, seq = (np.arange(form.window) * form.period_ns).astype(np.int64), np.arange(form.window)
    recording = np.unique(sweeps.group("recording"), return_inverse=True)[1]
    given = np.full(len(sweeps), -1)
    for i in np.argsort(recording, kind="stable"):
        frames = Frames(t_ns, seq, sweeps.samples[i])
        verdict = classifier(Sweep(int(i), 0, int(t_ns[-1]), Status.OK, frames, object=fused * int(recording[i] + 1)))
        if verdict.label:
            given[recording == recording[i] if fused else i] = labels.index(verdict.label)
    return given


def figures(classifier: Classifier, sweeps: SweepSet, protocol: str) -> dict[str, Any]:
    """Accuracy by sweep, and by recording where one holds several; what the box refuses counts as wrong."""
    right = score(classifier, sweeps) == sweeps.labels
    told = {protocol: figure(int(right.sum()), len(sweeps))}
    first = np.unique(sweeps.group("recording"), return_index=True)[1]
    if len(first) < len(sweeps):
        right = (score(classifier, sweeps, fused=True) == sweeps.labels)[first]
        told[f"{protocol}, by recording"] = figure(int(right.sum()), len(first))
    return told


def judge(folder: Path, held: SweepSet, logits: Array, protocol: str) -> dict[str, Any]:
    """Figures of the bundle in `folder` on `held`, run as the box runs it; `logits` [N, K]: what export saw there.

    Raises ExportRefused where the box gives another label than export, or refuses too many sweeps.
    """
    box = Classifier(bundle.load(folder), SystemClock())
    box.self_test()
    given = score(box, held)
    refused = given < 0
    if other := int(np.sum((given != logits.argmax(1)) & ~refused)):
        raise ExportRefused(f"the box labels {other} of {len(held)} held-out sweeps otherwise than export did")
    if refused.mean() > MOST_REFUSED:
        raise ExportRefused(
            f"the box would refuse {refused.sum()} of {len(held)} held-out sweeps (limit {MOST_REFUSED:.0%}); "
            f"see their thresholds {box.bundle.manifest.thresholds}, and drop sweeps with stuck taxels from the set"
        )
    return figures(box, held, protocol)


@contextlib.contextmanager
def _aside(target: Path) -> Iterator[Path]:
    """A new folder beside `target` that takes its place when the block ends well, and vanishes when it does not."""
    if target.exists() and not (target / bundle.MANIFEST).is_file():
        raise ExportRefused(f"{target} is no bundle and will not be replaced; name another folder with --out")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as workplace:
            new, old = Path(workplace) / "new", Path(workplace) / "old"
            new.mkdir()
            yield new
            if target.exists():
                target.rename(old)
            try:
                new.rename(target)
            except OSError:
                if old.exists():
                    old.rename(target)
                raise
    except OSError as e:
        raise ExportRefused(f"the bundle cannot be written to {target}: {e}; name another folder with --out") from e


def yardsticks(folder: Path, seed: int = 0) -> tuple[Path, Path]:
    """Write what `palpate bench` times beside the bundle: fp32.onnx and paper_int8.onnx, both with random weights.

    The first is the default bundle's network in float32, the second the paper's CNN in int8; both take its sweeps.
    """
    rng, form, classes = np.random.default_rng(seed), skin.FORMAT, len(skin.MATERIALS)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        state = networks.Compact(form, classes, 0.1, norm=False).state_dict()
    weights = {k: v.numpy() for k, v in state.items()}
    compact = networks.with_head(networks.trunk(form, 0.1, weights), weights["head.weight"], weights["head.bias"])
    digits = rng.integers(0, 256, (4, form.window, form.rows, form.cols), np.uint8)
    paper = quantize(networks.paper_cnn(form, classes, rng), digits, ("Conv", "Relu", "MaxPool", "Gemm"))
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "fp32.onnx", folder / "paper_int8.onnx"
    for path, model in zip(paths, (compact, paper), strict=True):
        path.write_bytes(model.SerializeToString())
    return paths
