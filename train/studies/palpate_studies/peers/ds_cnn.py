"""DS-CNN, a small network for microcontrollers: the METHOD ds-cnn.

A convolution, then four depthwise separable ones, each with batch norm, and a mean over time (Zhang
et al. 2017, "Hello Edge"). The published network sees an image of 49 x 10 speech features, this one
the series of the taxels.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import onnx
import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from palpate.core.types import SweepFormat
from palpate_studies.peers.networks import (
    Build,
    PeerNetwork,
    PeerRecipe,
    centred_network,
    layer_constants,
    network_method,
    scale_steps,
)
from palpate_train.models.methods import FULL_EFFORT, Effort, Method
from palpate_train.onnx_tools.graph_builder import GraphBuilder, centred

CHANNELS, BLOCKS, TAPS = 64, 4, 9
"""As in the small DS-CNN; a depthwise kernel of 3 x 3 becomes one of nine frames."""
STEPS, FIRST_TAPS = 50, 10
"""Approximate number of time steps after the first convolution, whose kernel has ten frames or two
strides."""
RECIPE = PeerRecipe(ema=0.9, dropout=0.0)
"""The recipe of our own networks with a shorter average, which batch norms need; no means are
dropped."""
INT8_NODES = ("Conv", "Relu")


class DepthwiseSeparable(PeerNetwork):
    """DS-CNN over time; the taxels are the channels of its first convolution. Zero padding keeps
    sizes in the blocks."""

    def __init__(self, format: SweepFormat, classes: int, scale: float) -> None:
        super().__init__(format, scale)
        self.stride = max(format.window // STEPS, 1)
        kernel = min(max(FIRST_TAPS, 2 * self.stride), format.window)
        layers = [nn.Conv1d(format.channels, CHANNELS, kernel, self.stride)]
        for _ in range(BLOCKS):
            layers.append(nn.Conv1d(CHANNELS, CHANNELS, TAPS, padding=TAPS // 2, groups=CHANNELS))
            layers.append(nn.Conv1d(CHANNELS, CHANNELS, 1))
        self.convs = nn.ModuleList(layers)
        self.norms = nn.ModuleList(nn.BatchNorm1d(CHANNELS) for _ in layers)
        self.head = nn.Linear(CHANNELS, classes)

    def _convolutions(self) -> Iterator[tuple[nn.Conv1d, nn.BatchNorm1d]]:
        for conv, norm in zip(self.convs, self.norms, strict=True):
            assert isinstance(conv, nn.Conv1d)
            assert isinstance(norm, nn.BatchNorm1d)
            yield conv, norm

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> means over time [B, CHANNELS]."""
        x = prepared
        for conv, norm in self._convolutions():
            x = torch.relu(norm(conv(x)))
        return x.mean(2)

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]; the batch norms are folded into the convolutions."""
        g = GraphBuilder()
        x = g("Mul", centred(g, self.format)[0], g.constant(self.scale))
        for conv, norm in self._convolutions():
            one = fuse_conv_bn_eval(conv.eval(), norm.eval())
            pads = [int(one.padding[0])] * 2
            x = g(
                "Conv",
                x,
                *layer_constants(g, one),
                strides=list(one.stride),
                pads=pads,
                group=one.groups,
            )
            x = g("Relu", x)
        mean = g("ReduceMean", x, axes=[2], keepdims=0)
        g("Gemm", mean, *layer_constants(g, self.head), transB=1, output="logits")
        return g.model(self.format, "logits", self.head.out_features)


build: Build = partial(centred_network, DepthwiseSeparable)


def methods(effort: Effort = FULL_EFFORT) -> tuple[Method, ...]:
    """The method, trained with this effort."""
    about = "DS-CNN, as deployed on microcontrollers, over time (Zhang et al. 2017); also in int8"
    return (network_method("ds-cnn", about, build, scale_steps(RECIPE, effort), int8=INT8_NODES),)
