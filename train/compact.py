"""The room of the compact network, the box's own. In: the form of a sweep. Out: the network and its ONNX graph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from appliance.errors import FormatError
from appliance.sweep import SweepFormat

from .graphs import Graph, centred, with_head
from .networks import Network

CHANNELS = 32
"""Of each stage: the fewest for which Arm's symmetric int8 kernel is used."""
FLOOR = 0.02
"""Added to a mean activation before its logarithm: a silent channel stays finite."""
LEAST_STEPS = 24
"""Time steps that the last stage should have: a mean over less is mostly noise."""


def stages(window: int) -> tuple[tuple[int, int], ...]:
    """(kernel, stride) of the three stages for a window of so many frames.

    The first stride is the largest of 4, 2, 1 that leaves LEAST_STEPS after the last stage, and 1 where none does; its
    kernel is four strides. 1500 frames: 16/4, then 5/2 twice. 128 frames: 4/1, then 5/2 twice.
    Raises FormatError where the window is too short for any.
    """
    for stride in (4, 2, 1):
        plan = ((4 * stride, stride), (5, 2), (5, 2))
        steps = window
        for kernel, by in plan:
            steps = (steps - kernel) // by + 1
        if steps >= LEAST_STEPS:
            return plan
    if steps < 1:
        raise FormatError(f"a window of {window} frames is too short for the network; record at least 16")
    return plan


class Compact(Network):
    """Three strided convolutions over time with the taxels as channels; the head sees each one's mean activation.

    Each taxel's mean over the window is taken away first: what is left is texture, and int8 does not spend its range
    on the offset. `scale` makes the rest about 1. Batch norms serve training only; `fused` folds them in.
    keep_means: show the head the means as well, for comparison: where materials were recorded one after another they
    tell the session rather than the material.
    """

    def __init__(
        self, form: SweepFormat, classes: int, scale: float, norm: bool = True, keep_means: bool = False
    ) -> None:
        super().__init__(form, scale)
        self.keep_means = keep_means
        plan = stages(form.window)
        inputs = (form.rows * form.cols,) + (CHANNELS,) * (len(plan) - 1)
        self.convs = nn.ModuleList(nn.Conv1d(n, CHANNELS, k, s) for n, (k, s) in zip(inputs, plan, strict=True))
        self.norms = nn.ModuleList(nn.BatchNorm1d(CHANNELS) if norm else nn.Identity() for _ in plan)
        self.head = nn.Linear(CHANNELS * len(plan) + keep_means * inputs[0], classes)

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> log mean activations [B, 3 * CHANNELS]."""
        means, x = [], prepared
        for conv, norm in zip(self.convs, self.norms, strict=True):
            x = torch.relu(norm(conv(x)))
            means.append(x.mean(2))
        return torch.log(torch.cat(means, 1) + FLOOR)

    def seen(self, digits: Tensor) -> Tensor:
        """Digits [B, T, R, C] -> what the head sees of them [B, F]."""
        features = self.features(self.prepare(digits))
        means = digits.flatten(2).float().mean(1) * self.scale
        return torch.cat([features, means], 1) if self.keep_means else features

    def fused(self) -> Compact:
        """The same network for inference, its batch norms folded into the convolutions."""
        plain = Compact(self.form, self.head.out_features, self.scale, norm=False)
        plain.head.load_state_dict(self.head.state_dict())
        for mine, conv, norm in zip(plain.convs, self.convs, self.norms, strict=True):
            mine.load_state_dict(fuse_conv_bn_eval(conv.eval(), norm.eval()).state_dict())
        return plain.eval()

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]; of a fused network."""
        weights = {k: v.numpy() for k, v in self.state_dict().items()}
        whole = trunk(self.form, self.scale, weights, self.keep_means)
        return with_head(whole, weights["head.weight"], weights["head.bias"])


def trunk(
    form: SweepFormat, scale: float, weights: Mapping[str, NDArray[Any]], keep_means: bool = False
) -> onnx.ModelProto:
    """`Compact` up to its features: `sweep` -> `features` float32 [1, F]. weights: the state of a fused Compact.

    The first convolution takes the scale along.
    """
    g = Graph()
    x, sums = centred(g, form)
    means = []
    for i, (_, stride) in enumerate(stages(form.window)):
        w, b = weights[f"convs.{i}.weight"], weights[f"convs.{i}.bias"]
        x = g("Relu", g("Conv", x, g.constant(w if i else w * scale), g.constant(b), strides=[stride]))
        means.append(g("ReduceMean", x, axes=[2], keepdims=0))
    seen = g("Log", g("Add", g("Concat", *means, axis=1), g.constant(FLOOR)), output="" if keep_means else "features")
    if keep_means:
        g("Concat", seen, g("Mul", sums, g.constant(scale / form.window)), axis=1, output="features")
    return g.model(form, "features", CHANNELS * len(means) + keep_means * form.rows * form.cols)
