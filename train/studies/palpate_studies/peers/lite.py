"""LITE, a small network for time series with hand-crafted filters: the METHOD lite.

Three convolutions of 32 filters and 40, 20 and 10 frames with fixed detectors of rise, fall and
peak, then two depthwise separable ones and a mean over time (Ismail-Fawaz et al. 2023, "LITE").
With several taxels the first layer is separable too, and each taxel has the detectors (Ismail-Fawaz
et al. 2024, "Look Into the LITE").

Three things differ from the publication: it is one network instead of five together, it is trained
as our own networks are instead of for 1,500 epochs, and the first layer has a stride if windows are
long.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from palpate.core.types import SweepFormat
from palpate_studies.peers.ds_cnn import INT8_NODES, RECIPE
from palpate_studies.peers.networks import (
    Build,
    PeerNetwork,
    centred_network,
    layer_constants,
    network_method,
    scale_steps,
)
from palpate_train.models.methods import FULL_EFFORT, Effort, Method
from palpate_train.onnx_tools.graph_builder import GraphBuilder, centred

Array = NDArray[Any]
FILTERS = 32
FIRST_TAPS = (40, 20, 10)
LATER = ((20, 2), (10, 4))
"""Number of frames of a kernel and their distance, for the two separable convolutions."""
DETECTORS = (2, 4, 8, 16, 32, 64)
"""Number of frames of a rise; a peak has half as many again, and there are no peaks of two."""
STEPS = 256
"""Least number of time steps after the stride. The published network has no stride."""


class SameConv(nn.Conv1d):
    """A convolution without bias, with zeros at both ends: of T steps, T / stride are left, rounded
    up."""

    def __init__(
        self,
        channels: int,
        filters: int,
        taps: int,
        stride: int = 1,
        dilation: int = 1,
        groups: int = 1,
    ):
        super().__init__(
            channels, filters, taps, stride, dilation=dilation, groups=groups, bias=False
        )

    def ends(self, steps: int) -> tuple[int, int]:
        """Number of zeros before and after this many steps."""
        reach = (self.kernel_size[0] - 1) * self.dilation[0] + 1
        missing = max((-(-steps // self.stride[0]) - 1) * self.stride[0] + reach - steps, 0)
        return missing // 2, missing - missing // 2

    def forward(self, x: Tensor) -> Tensor:
        """[B, channels, T] -> [B, filters, T / stride]."""
        return super().forward(functional.pad(x, self.ends(x.shape[2])))


def rise_and_fall(frames: int) -> Array:
    """Two filters [2, frames]."""
    change = np.where(np.arange(frames) % 2, 1.0, -1.0)
    return np.stack([change, -change])


def peak(frames: int) -> Array:
    """One filter [1, 1.5 * frames]: a hump between two hollows of half its height; `frames` is a
    multiple of four."""
    flank = (np.arange(1, frames // 4 + 1) / (frames // 4)) ** 2
    hump = np.concatenate([flank, flank[::-1]])
    filters: Array = np.concatenate([-hump, 2 * hump, -hump])[None]
    return filters


def fixed(filters: Array, taxels: int, stride: int) -> SameConv:
    """`filters` [n, frames] over each taxel, not trained."""
    conv = SameConv(taxels, taxels * len(filters), filters.shape[1], stride, groups=taxels)
    weight = torch.from_numpy(np.tile(filters, (taxels, 1))[:, None].astype(np.float32))
    conv.weight = nn.Parameter(weight, requires_grad=False)
    return conv


def separable(channels: int, taps: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """A kernel for each channel, FILTERS mixtures of them, batch norm; a single channel has FILTERS
    kernels instead of a mixture."""
    if channels == 1:
        return nn.Sequential(SameConv(1, FILTERS, taps, stride, dilation), nn.BatchNorm1d(FILTERS))
    depthwise = SameConv(channels, channels, taps, stride, dilation, groups=channels)
    return nn.Sequential(depthwise, SameConv(channels, FILTERS, 1), nn.BatchNorm1d(FILTERS))


class Lite(PeerNetwork):
    """LITE, in its multivariate variant if there are several taxels."""

    def __init__(self, format: SweepFormat, classes: int, scale: float) -> None:
        super().__init__(format, scale)
        taxels, stride = format.channels, max(format.window // STEPS, 1)
        self.steps = -(-format.window // stride)
        self.learnt = nn.ModuleList(separable(taxels, taps, stride) for taps in FIRST_TAPS)
        filters = [*map(rise_and_fall, DETECTORS), *map(peak, DETECTORS[1:])]
        self.detectors = nn.ModuleList(fixed(one, taxels, stride) for one in filters)
        self.norms = nn.ModuleList(nn.BatchNorm1d(taxels * len(one)) for one in filters)
        width = FILTERS * len(FIRST_TAPS) + taxels * sum(map(len, filters))
        self.later = nn.ModuleList(
            separable(channels, taps, dilation=dilation)
            for channels, (taps, dilation) in zip((width, FILTERS), LATER, strict=True)
        )
        self.head = nn.Linear(FILTERS, classes)

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> means over time [B, FILTERS]."""
        found = [layer(prepared) for layer in self.learnt]
        found += [
            norm(conv(prepared).relu())
            for conv, norm in zip(self.detectors, self.norms, strict=True)
        ]
        x = torch.cat(found, 1).relu()
        for layer in self.later:
            x = layer(x).relu()
        return x.mean(2)

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]; batch norms are folded into the convolutions before
        them if possible."""
        g, frames = GraphBuilder(), self.format.window
        sweep = g("Mul", centred(g, self.format)[0], g.constant(self.scale))
        parts = [g("Relu", _convolved(g, sweep, layer, frames)) for layer in self.learnt]
        for conv, norm in zip(self.detectors, self.norms, strict=True):
            found = g("Relu", _convolved(g, sweep, conv, frames))
            parts.append(g("Relu", _normed(g, found, norm)))
        x = g("Concat", *parts, axis=1)
        for layer in self.later:
            x = g("Relu", _convolved(g, x, layer, self.steps))
        mean = g("ReduceMean", x, axes=[2], keepdims=0)
        g("Gemm", mean, *layer_constants(g, self.head), transB=1, output="logits")
        return g.model(self.format, "logits", self.head.out_features)


def _convolved(g: GraphBuilder, x: str, layer: nn.Module, steps: int) -> str:
    """Nodes of a SameConv, or of a layer of `separable`, for this many steps; a batch norm is
    folded into the convolution before it."""
    convs: list[nn.Conv1d] = []
    for one in [*layer.children()] or [layer]:
        if isinstance(one, nn.BatchNorm1d):
            convs[-1] = fuse_conv_bn_eval(convs[-1].eval(), one.eval())
        else:
            assert isinstance(one, SameConv)
            convs.append(one)
    for conv in convs:
        assert isinstance(conv, SameConv)
        constants = [
            g.constant(value.detach().numpy())
            for value in (conv.weight, conv.bias)
            if value is not None
        ]
        x = g(
            "Conv",
            x,
            *constants,
            pads=list(conv.ends(steps)),
            strides=list(conv.stride),
            dilations=list(conv.dilation),
            group=conv.groups,
        )
        steps = -(-steps // conv.stride[0])
    return x


def _normed(g: GraphBuilder, x: str, norm: nn.Module) -> str:
    """A batch norm that does not follow a convolution."""
    assert isinstance(norm, nn.BatchNorm1d)
    mean, variance = norm.running_mean, norm.running_var
    assert mean is not None
    assert variance is not None
    factor = norm.weight / torch.sqrt(variance + norm.eps)
    columns = [value.detach().numpy()[:, None] for value in (factor, norm.bias - mean * factor)]
    return g("Add", g("Mul", x, g.constant(columns[0])), g.constant(columns[1]))


build: Build = partial(centred_network, Lite)


def methods(effort: Effort = FULL_EFFORT) -> tuple[Method, ...]:
    """The method, trained with this effort."""
    about = (
        "LITE, 10,000 weights, some filters hand-crafted (Ismail-Fawaz et al. 2023, 2024); also in "
        "int8"
    )
    return (network_method("lite", about, build, scale_steps(RECIPE, effort), int8=INT8_NODES),)
