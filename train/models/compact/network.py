"""The room of the compact network, the box's own. In: a Architecture and the form of a sweep. Out: the network in PyTorch.

Its shapes stand in ladder.py; exact.py writes its graphs, for int8 too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from appliance.core.types import SweepFormat
from train.models.compact import graph, spectrum
from train.models.compact.architectures import CAP, DEFAULT, FLOOR, MAINS_HZ, Architecture
from train.models.networks import Network
from train.models.training import in_order, tensors
from train.onnx_tools.graph_builder import with_head

Array = NDArray[Any]
CALIBRATION_SWEEPS = 96
PERCENTILE = 99.9
"""Of the values that int8 must reach: with their full range one outlier sweep takes the resolution from all others."""


class ZeroSum(nn.Conv1d):
    """A convolution whose taps sum to zero for every filter and taxel: no offset can move it.

    Gradient descent may hold any taps; what is not wanted of them is taken away. mains: how many of its periods pass
    from one frame to the next; their hum is not wanted either.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, mains: float = 0.0) -> None:
        super().__init__(inputs, outputs, kernel, stride)
        turn = 2 * np.pi * mains * np.arange(kernel)
        unwanted = np.stack([np.ones(kernel), np.sin(turn), np.cos(turn)][: 3 if mains else 1], axis=1)
        self.unwanted = torch.from_numpy(np.linalg.qr(unwanted)[0].astype(np.float32))

    def wanted(self, weight: Tensor) -> Tensor:
        """The taps themselves [filters, taxels, kernel]."""
        return weight - weight @ self.unwanted @ self.unwanted.T

    def forward(self, x: Tensor) -> Tensor:
        """[B, taxels, T] -> [B, filters, steps]."""
        return self._conv_forward(x, self.wanted(self.weight), self.bias)


def capped(x: Tensor) -> Tensor:
    """Taxels [B, R * C, T], those that tremble far more than others turned down; see ladder.Cap."""
    step, place = CAP.step(x.shape[2]), CAP.place(x.shape[1])
    trembling = (x[:, :, 1::step] - x[:, :, :-1:step]).abs().mean(2, keepdim=True)
    limit = CAP.times * trembling.topk(place + 1, dim=1).values[:, -1:]
    return torch.where((trembling > limit) & (limit > 0), x * (limit / trembling), x)


class Compact(Network):
    """Strided convolutions over time with the taxels as channels; the head sees the log of every mean response.

    Where the window is long the first kernels sum to zero and do not hear the mains: what is left is texture, and int8
    may take the digits as they are. `scale` makes the texture about 1. For inference the batch norms, which only serve
    training, are folded in by `fused`.
    keep_means: show the head each taxel's mean as well, for comparison: where materials were recorded one after another
    they tell the session rather than the material.
    """

    def __init__(
        self,
        form: SweepFormat,
        classes: int,
        scale: float,
        norm: bool = True,
        keep_means: bool = False,
        shape: Architecture = DEFAULT,
    ) -> None:
        super().__init__(form, scale)
        self.keep_means, self.shape = keep_means, shape
        stages, inputs = shape.stages(form.window), (form.rows * form.cols, *shape.channels)
        self.convs = nn.ModuleList(
            nn.Conv1d(before, after, stage.kernel, stage.stride)
            for before, after, stage in zip(inputs, shape.channels, stages, strict=False)
        )
        if shape.channels and shape.zero_sum(form.window):
            first = stages[0]
            periods = first.kernel * MAINS_HZ / form.rate_hz
            mains = MAINS_HZ / form.rate_hz if norm and 1 <= periods <= first.kernel / 4 else 0.0
            self.convs[0] = ZeroSum(inputs[0], inputs[1], first.kernel, first.stride, mains)
        self.norms = nn.ModuleList(nn.BatchNorm1d(n) if norm else nn.Identity() for n in shape.channels)
        bands = shape.spectrum * spectrum.count(form)
        self.head = nn.Linear(sum(shape.channels) + keep_means * inputs[0] + bands, classes)

    def responses(self, prepared: Tensor) -> list[Tensor]:
        """[B, R * C, T] -> of each stage its responses [B, channels, steps], none below 0."""
        x, of_stages = capped(prepared), []
        for conv, norm in zip(self.convs, self.norms, strict=True):
            of_stages.append(x := torch.relu(norm(conv(x))))
        return of_stages

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> log mean responses [B, sum of channels]."""
        means = [x.mean(2) for x in self.responses(prepared)]
        return torch.log(torch.cat(means, 1) + FLOOR) if means else prepared.new_zeros(len(prepared), 0)

    def seen(self, digits: Tensor) -> Tensor:
        """Digits [B, T, R, C] -> what the head sees of them [B, F]."""
        prepared = self.prepare(digits)
        seen = [self.features(prepared)]
        if self.keep_means:
            seen.append(digits.flatten(2).float().mean(1) * self.scale)
        if self.shape.spectrum:
            seen.append(spectrum.bands(capped(prepared), self.form))
        return torch.cat(seen, 1)

    def fused(self) -> Compact:
        """The same network for inference, its batch norms folded into the convolutions."""
        plain = Compact(self.form, self.head.out_features, self.scale, norm=False, shape=self.shape)
        plain.head.load_state_dict(self.head.state_dict())
        for mine, conv, norm in zip(plain.convs, self.convs, self.norms, strict=True):
            mine.load_state_dict(fuse_conv_bn_eval(conv.eval(), norm.eval()).state_dict())
        if self.convs:
            plain.convs[0].weight.data.copy_(self.first_taps(plain.convs[0].weight))
        return plain.eval()

    def cut(self, depth: int, spectrum: bool) -> Compact:
        """Its first stages, and the spectrum or not, behind a head that is yet to be found; of a fused network."""
        shape = self.shape.cut(depth, spectrum)
        less = Compact(self.form, self.head.out_features, self.scale, False, self.keep_means, shape)
        less.convs.load_state_dict(self.convs[:depth].state_dict())
        return less.eval()

    def first_taps(self, weight: Tensor) -> Tensor:
        """What the first convolution makes of its weight."""
        first = self.convs[0]
        return first.wanted(weight) if isinstance(first, ZeroSum) else weight

    @torch.no_grad()
    def weights(self) -> dict[str, Array]:
        """What `exact.trunk` asks for; of a fused network."""
        weights = {k: v.numpy() for k, v in self.state_dict().items()}
        return weights | ({"convs.0.weight": self.first_taps(self.convs[0].weight).numpy()} if self.convs else {})

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]; of a fused network."""
        weights = self.weights()
        trunk = graph.trunk(self.form, self.scale, weights, self.shape, keep_means=self.keep_means)
        return with_head(trunk, weights["head.weight"], weights["head.bias"])

    @torch.no_grad()
    def reach(self, samples: Array) -> graph.Ranges:
        """What int8 must reach, found on some of the training sweeps [N, T, R, C]; of a fused network."""
        some = samples[np.linspace(0, len(samples) - 1, min(CALIBRATION_SWEEPS, len(samples))).astype(int)]
        level = some[:, : graph.level_frames(self.form.window, self.shape)].mean(
            axis=1, keepdims=True, dtype=np.float64
        )
        kept: list[list[Array]] = [[np.abs(some - level).ravel()], *([] for _ in self.convs)]
        for digits in tensors(some, in_order(len(some), 32)):
            for stage, x in zip(kept[1:], self.responses(self.prepare(digits)), strict=True):
                stage.append(x.numpy().ravel())
        # a silent set has ranges, too
        digits, *responses = (max(float(np.percentile(np.concatenate(x), PERCENTILE)), 1e-6) for x in kept)
        return graph.Ranges(digits, tuple(responses))
