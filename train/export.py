"""The room where the compact network is quantized. In: a Fit. Out: its int8 model, packed as a bundle.

Nothing leaves whose int8 form answers otherwise than what was trained.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from appliance import bundle
from appliance.classifier import softmax
from appliance.sim import skin

from . import compact, networks
from .fit import Fit
from .graphs import run, with_head
from .heads import closed_form_head
from .nets import PAPER_INT8
from .pack import Content, ExportRefused, pack
from .quantize import quantize

Array = NDArray[Any]
MOST_LOGIT_DIFFERENCE = 0.01
"""PyTorch against the float graph: the same sums in another order."""
LEAST_AGREEMENT = 0.95
MOST_PROBABILITY_DIFFERENCE = 0.5
"""Float against int8 on held-out sweeps: share of equal labels, and how far any probability may move."""


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
    """Quantize `fit`, check it, and pack it; see pack.pack. Raises ExportRefused where a check fails."""
    model, parity = quantized(fit)
    by = fit.about["held_out_by"]
    content = Content(model, "raw", fit.train, fit.held, by, fit.about, {"parity": asdict(parity)})
    return pack(content, target, name, version, commit, full_scale)


def quantized(fit: Fit) -> tuple[onnx.ModelProto, Parity]:
    """The int8 model, its head refitted on what the int8 trunk gives. Raises ExportRefused where parity is broken."""
    trunk = compact.trunk(fit.train.format, fit.scale, fit.weights, fit.keep_means)
    whole = with_head(trunk, fit.weights["head.weight"], fit.weights["head.bias"])
    int8_trunk = quantize(trunk, fit.train.samples)
    seen, held = run(int8_trunk, fit.train.samples), run(int8_trunk, fit.held.samples)
    model = with_head(int8_trunk, *closed_form_head(seen, fit.train.labels, held, fit.held.labels))
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


def yardsticks(folder: Path, seed: int = 0) -> tuple[Path, Path]:
    """Write what `palpate bench` times beside the bundle: fp32.onnx and paper_int8.onnx, both with random weights.

    The first is the default bundle's network in float32, the second the paper's CNN in int8; both take its sweeps.
    """
    rng, form, classes = np.random.default_rng(seed), skin.FORMAT, len(skin.MATERIALS)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        state = compact.Compact(form, classes, 0.1, norm=False).state_dict()
    weights = {k: v.numpy() for k, v in state.items()}
    small = with_head(compact.trunk(form, 0.1, weights), weights["head.weight"], weights["head.bias"])
    digits = rng.integers(0, 256, (4, form.window, form.rows, form.cols), np.uint8)
    paper = quantize(networks.paper_cnn(form, classes, rng), digits, PAPER_INT8)
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "fp32.onnx", folder / "paper_int8.onnx"
    for path, model in zip(paths, (small, paper), strict=True):
        path.write_bytes(model.SerializeToString())
    return paths
