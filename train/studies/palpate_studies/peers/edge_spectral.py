"""The usual recipe of edge tools, spectral features and a small dense network: the METHOD
edge-spectral.

The features of each taxel are the log power spectrum, averaged over half-overlapping frames, with
root mean square, skewness and kurtosis, as in the spectral block of Edge Impulse (Hymel et al.
2022). They are followed by dense layers of 20 and 10 neurons, its default.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from palpate.core.types import SweepFormat
from palpate_studies.peers.networks import (
    PeerNetwork,
    PeerRecipe,
    layer_constants,
    network_method,
    scale_steps,
)
from palpate_train.data.augment import texture_scale
from palpate_train.models.methods import FULL_EFFORT, Effort, Method
from palpate_train.models.training import batches, float_batches, one_thread
from palpate_train.onnx_tools.graph_builder import GraphBuilder, centred

Array = NDArray[Any]
SHORTEST, LONGEST = 64, 256
"""Number of frames of a Fourier transform: the largest power of two within half a window, from 64
to 256."""
HIDDEN = (20, 10)
FLOOR = 1e-6
"""Added to a power before its logarithm and to a variance; the variance of all taxels together is
1."""
RECIPE = PeerRecipe(dropout=0.0, noise=0.0, gain=0.0)
"""The recipe of our own networks without changes of the sweeps, because the tools' blocks augment
nothing."""


def transform_length(window: int) -> int:
    """Number of frames of a transform for windows of this many frames."""
    return int(np.clip(2 ** int(np.log2(max(window // 2, 1))), SHORTEST, LONGEST))


class SpectralNetwork(PeerNetwork):
    """Two dense layers and a head on standardised spectra and statistics of each taxel.

    A window that is shorter than a transform is followed by zeros. waves [2 B, 1, L]: cosines, then
    sines, under a Hann window. centre, spread [F]: of the training features.
    """

    waves: Tensor
    centre: Tensor
    spread: Tensor

    def __init__(self, format: SweepFormat, classes: int, scale: float) -> None:
        super().__init__(format, scale)
        length = transform_length(format.window)
        self.missing, self.hop, self.bins = max(length - format.window, 0), length // 2, length // 2
        angle = 2 * np.pi * np.arange(1, self.bins + 1)[:, None] * np.arange(length) / length
        hann = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
        waves = np.concatenate([np.cos(angle), np.sin(angle)]) * hann / np.linalg.norm(hann)
        size = format.channels * (self.bins + 3)
        self.register_buffer("waves", torch.from_numpy(waves[:, None].astype(np.float32)))
        self.register_buffer("centre", torch.zeros(size))
        self.register_buffer("spread", torch.ones(size))
        self.first, self.second = nn.Linear(size, HIDDEN[0]), nn.Linear(*HIDDEN)
        self.head = nn.Linear(HIDDEN[1], classes)

    def spectral(self, prepared: Tensor) -> Tensor:
        """[B, M, T] -> [B, M * (3 + bins)]: all root mean squares, skewnesses, kurtoses, then log
        powers taxel by taxel."""
        variance = (prepared**2).mean(2) + FLOOR
        skewness = (prepared**3).mean(2) / variance**1.5
        kurtosis = (prepared**4).mean(2) / variance**2 - 3
        padded = functional.pad(prepared, (0, self.missing)).flatten(0, 1)[:, None]
        parts = functional.conv1d(padded, self.waves, stride=self.hop) ** 2
        power = parts.unflatten(1, (2, self.bins)).sum(1).mean(2)
        log_power = (power + FLOOR).log().view(len(prepared), -1)
        return torch.cat([variance.sqrt(), skewness, kurtosis, log_power], 1)

    def features(self, prepared: Tensor) -> Tensor:
        """[B, M, T] -> the second layer's neurons [B, 10]."""
        x = (self.spectral(prepared) - self.centre) / self.spread
        return torch.relu(self.second(torch.relu(self.first(x))))

    @torch.no_grad()
    def standardise(self, samples: Array) -> None:
        """Take centre and spread of the features from raw counts [N, T, R, C]."""
        with one_thread():
            parts = [
                self.spectral(self.prepare(x))
                for x in float_batches(samples, batches(len(samples)))
            ]
        spread, self.centre = torch.std_mean(torch.cat(parts), 0, correction=0)
        self.spread = torch.where(spread > FLOOR, spread, torch.ones_like(spread))

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]."""
        g, taxels = GraphBuilder(), self.format.channels
        x = g("Mul", centred(g, self.format)[0], g.constant(self.scale))
        square = g("Mul", x, x)
        variance = g("Add", g("ReduceMean", square, axes=[2], keepdims=0), g.constant(FLOOR))
        root = g("Sqrt", variance)
        third = g("ReduceMean", g("Mul", square, x), axes=[2], keepdims=0)
        fourth = g("ReduceMean", g("Mul", square, square), axes=[2], keepdims=0)
        skewness = g("Div", third, g("Mul", variance, root))
        kurtosis = g("Sub", g("Div", fourth, g("Mul", variance, variance)), g.constant(3.0))
        rows = g("Reshape", x, [taxels, 1, self.format.window])
        parts = g(
            "Conv", rows, g.constant(self.waves.numpy()), strides=[self.hop], pads=[0, self.missing]
        )
        frames = (self.format.window + self.missing - 2 * self.bins) // self.hop + 1
        parts = g("Reshape", g("Mul", parts, parts), [taxels, 2, self.bins, frames])
        power = g("ReduceMean", g("ReduceSum", parts, [1], keepdims=0), axes=[2], keepdims=0)
        log_power = g("Log", g("Add", power, g.constant(FLOOR)))
        log_power = g("Reshape", log_power, [1, taxels * self.bins])
        x = g("Concat", root, skewness, kurtosis, log_power, axis=1)
        x = g("Div", g("Sub", x, g.constant(self.centre.numpy())), g.constant(self.spread.numpy()))
        for layer in (self.first, self.second):
            x = g("Relu", g("Gemm", x, *layer_constants(g, layer), transB=1))
        g("Gemm", x, *layer_constants(g, self.head), transB=1, output="logits")
        return g.model(self.format, "logits", self.head.out_features)


def build(format: SweepFormat, classes: int, samples: Array) -> PeerNetwork:
    """The network with random weights and the features of `samples` standardised; each taxel's mean
    is subtracted."""
    network = SpectralNetwork(format, classes, texture_scale(samples))
    network.standardise(samples)
    return network


def methods(effort: Effort = FULL_EFFORT) -> tuple[Method, ...]:
    """The method, trained with this effort."""
    about = (
        "log spectra and statistics of each taxel + dense layers of 20 and 10, as the edge tools "
        "do (Hymel et al. 2022)"
    )
    return (network_method("edge-spectral", about, build, scale_steps(RECIPE, effort)),)
