"""The compact network in PyTorch. Its sizes are in architectures.py; graph.py writes its graphs, in
float and in int8."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from appliance.core.types import SweepFormat
from train.models.networks import Network
from train.models.recipe import spectrum
from train.models.recipe.architectures import DEFAULT, FLOOR, NOISE_LIMIT, Architecture
from train.models.recipe.graph import Ranges, level_frames, trunk_graph
from train.models.training import batches, float_batches
from train.onnx_tools.graph_builder import with_head
from train.onnx_tools.quantize import PERCENTILE, calibration_sweeps

Array = NDArray[Any]


class ZeroSum(nn.Conv1d):
    """A convolution whose taps sum to zero for every filter and taxel, so that no offset changes
    its output.

    Gradient descent changes the taps freely; their unwanted part is subtracted. mains: periods of
    the mains per frame; if it is not 0 the hum is removed as well.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, mains: float = 0.0
    ) -> None:
        super().__init__(inputs, outputs, kernel, stride)
        phase = 2 * np.pi * mains * np.arange(kernel)
        unwanted = np.stack(
            [np.ones(kernel), np.sin(phase), np.cos(phase)][: 3 if mains else 1], axis=1
        )
        self.unwanted = torch.from_numpy(np.linalg.qr(unwanted)[0].astype(np.float32))

    def effective(self, weight: Tensor) -> Tensor:
        """The taps that are applied [filters, taxels, kernel]."""
        taps: Tensor = weight - weight @ self.unwanted @ self.unwanted.T
        return taps

    def forward(self, x: Tensor) -> Tensor:
        """[B, taxels, T] -> [B, filters, steps]."""
        response: Tensor = self._conv_forward(x, self.effective(self.weight), self.bias)
        return response


def limit_noise(x: Tensor) -> Tensor:
    """Taxels [B, R * C, T] with attenuation of those that are much noisier than others; see
    architectures.NoiseLimit."""
    step, rank = NOISE_LIMIT.step(x.shape[2]), NOISE_LIMIT.rank(x.shape[1])
    noise = (x[:, :, 1::step] - x[:, :, :-1:step]).abs().mean(2, keepdim=True)
    limit = NOISE_LIMIT.times * noise.topk(rank + 1, dim=1).values[:, -1:]
    return torch.where((noise > limit) & (limit > 0), x * (limit / noise), x)


def band_powers(x: Tensor, format: SweepFormat, mains_hz: float) -> Tensor:
    """Scaled taxels [B, R * C * A, T] -> log band powers [B, count(format)], those of the first
    axis first."""
    length = format.window // spectrum.SEGMENTS
    waves, averaging = (
        torch.from_numpy(m) for m in spectrum.matrices(length, spectrum.mains(format, mains_hz))
    )
    mean = x.unflatten(1, (-1, format.axes)).mean(1)[:, :, : length * spectrum.SEGMENTS]
    cut = mean.unflatten(2, (spectrum.SEGMENTS, length))
    return torch.log(((cut @ waves).square() @ averaging).mean(2) + spectrum.QUIET).flatten(1)


class Compact(Network):
    """Strided convolutions over time with the taxels as channels; the head sees the logarithm of
    every mean response.

    If the window is long, the first kernels sum to zero and do not respond to the mains. Only
    texture remains, and int8 can take the raw counts as they are. `scale` brings the texture to
    about 1. The batch norms only serve training; `fused` folds them in. keep_means: show the mean
    of each taxel to the head as well, for comparison; if materials were recorded one after another,
    the means reveal the session rather than the material.
    """

    def __init__(
        self,
        format: SweepFormat,
        classes: int,
        scale: float,
        norm: bool = True,
        keep_means: bool = False,
        architecture: Architecture = DEFAULT,
    ) -> None:
        super().__init__(format, scale)
        self.keep_means, self.architecture = keep_means, architecture
        stages, inputs = (
            architecture.stages(format.window),
            (format.channels, *architecture.channels),
        )
        self.convs = nn.ModuleList(
            nn.Conv1d(before, after, stage.kernel, stage.stride)
            for before, after, stage in zip(inputs, architecture.channels, stages, strict=False)
        )
        if architecture.channels and architecture.zero_sum(format.window):
            first = stages[0]
            periods = first.kernel * architecture.mains_hz / format.rate_hz
            mains = (
                architecture.mains_hz / format.rate_hz
                if norm and 1 <= periods <= first.kernel / 4
                else 0.0
            )
            self.convs[0] = ZeroSum(inputs[0], inputs[1], first.kernel, first.stride, mains)
        self.norms = nn.ModuleList(
            nn.BatchNorm1d(n) if norm else nn.Identity() for n in architecture.channels
        )
        bands = architecture.spectrum * spectrum.count(format)
        self.head = nn.Linear(sum(architecture.channels) + keep_means * inputs[0] + bands, classes)

    def responses(self, prepared: Tensor) -> list[Tensor]:
        """[B, R * C, T] -> for each stage its responses [B, channels, steps], which are not
        negative."""
        x, of_stages = limit_noise(prepared), []
        for conv, norm in zip(self.convs, self.norms, strict=True):
            of_stages.append(x := torch.relu(norm(conv(x))))
        return of_stages

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> log mean responses [B, sum of channels]."""
        means = [x.mean(2) for x in self.responses(prepared)]
        return (
            torch.log(torch.cat(means, 1) + FLOOR)
            if means
            else prepared.new_zeros(len(prepared), 0)
        )

    def head_input(self, counts: Tensor) -> Tensor:
        """Raw counts [B, T, R, C] -> the features that the head sees [B, F]."""
        prepared = self.prepare(counts)
        parts = [self.features(prepared)]
        if self.keep_means:
            parts.append(counts.flatten(2).float().mean(1) * self.scale)
        if self.architecture.spectrum:
            parts.append(
                band_powers(limit_noise(prepared), self.format, self.architecture.mains_hz)
            )
        return torch.cat(parts, 1)

    def fused(self) -> Compact:
        """The same network for inference, with its batch norms folded into the convolutions."""
        plain = Compact(
            self.format,
            self.head.out_features,
            self.scale,
            norm=False,
            architecture=self.architecture,
        )
        plain.head.load_state_dict(self.head.state_dict())
        for target, conv, norm in zip(plain.convs, self.convs, self.norms, strict=True):
            assert isinstance(conv, nn.Conv1d)
            assert isinstance(norm, nn.BatchNorm1d)
            target.load_state_dict(fuse_conv_bn_eval(conv.eval(), norm.eval()).state_dict())
        if self.convs:
            first = plain.convs[0].get_parameter("weight")
            first.data.copy_(self.first_taps(first))
        return plain.eval()

    def cut(self, depth: int, spectrum: bool) -> Compact:
        """The first `depth` stages of a fused network, with the spectrum or without; its head is
        not fitted yet."""
        architecture = self.architecture.cut(depth, spectrum)
        less = Compact(
            self.format, self.head.out_features, self.scale, False, self.keep_means, architecture
        )
        less.convs.load_state_dict(self.convs[:depth].state_dict())
        return less.eval()

    def first_taps(self, weight: Tensor) -> Tensor:
        """The taps that the first convolution applies for its weight."""
        first = self.convs[0]
        return first.effective(weight) if isinstance(first, ZeroSum) else weight

    @torch.no_grad()
    def weights(self) -> dict[str, Array]:
        """The weights that `trunk_graph` takes; of a fused network."""
        weights = {k: v.numpy() for k, v in self.state_dict().items()}
        if not self.convs:
            return weights
        return weights | {
            "convs.0.weight": self.first_taps(self.convs[0].get_parameter("weight")).numpy()
        }

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]; of a fused network."""
        weights = self.weights()
        trunk = trunk_graph(
            self.format, self.scale, weights, self.architecture, keep_means=self.keep_means
        )
        return with_head(trunk, weights["head.weight"], weights["head.bias"])

    @torch.no_grad()
    def ranges(self, samples: Array) -> Ranges:
        """The ranges for int8, found on some of the training sweeps [N, T, R, C]; of a fused
        network."""
        some = calibration_sweeps(samples)
        window = level_frames(self.format.window, self.architecture)
        level = some[:, :window].mean(axis=1, keepdims=True, dtype=np.float64)
        values: list[list[Array]] = [[np.abs(some - level).ravel()], *([] for _ in self.convs)]
        for counts in float_batches(some, batches(len(some), 32)):
            for stage, x in zip(values[1:], self.responses(self.prepare(counts)), strict=True):
                stage.append(x.numpy().ravel())
        # the minimum keeps the ranges of a silent set above 0
        largest, *responses = (
            max(float(np.percentile(np.concatenate(x), PERCENTILE)), 1e-6) for x in values
        )
        return Ranges(largest, tuple(responses))
