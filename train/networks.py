"""The room of networks. In: the form of a sweep. Out: networks in PyTorch, each of which writes its own ONNX graph.

All have a linear head on features of a sweep; `prepare` makes digits what the convolutions take. The graphs are
written with train/graphs.py and take the sensor's own digits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from appliance.errors import FormatError
from appliance.sweep import SweepFormat

from .graphs import Graph, centred, with_head

CHANNELS = 32
"""Of each stage: the fewest for which Arm's symmetric int8 kernel is used."""
FLOOR = 0.02
"""Added to a mean activation before its logarithm: a silent channel stays finite."""
LEAST_STEPS = 24
"""Time steps that the last stage should have: a mean over less is mostly noise."""
STATE, PATCHES, LEAST_PATCH = 64, 128, 8
"""Of Recurrent: size of its state, about how many patches it sees, frames of the shortest."""


class Network(nn.Module, ABC):
    """What all networks share. `scale` makes digits about 1 after `offset`, or each taxel's own mean, is taken away.

    dropout: share of the features that the head misses in training.
    """

    head: nn.Linear

    def __init__(self, form: SweepFormat, scale: float, offset: float | None = None) -> None:
        super().__init__()
        self.form, self.scale, self.offset, self.dropout = form, scale, offset, 0.0

    def prepare(self, digits: Tensor) -> Tensor:
        """Digits [B, T, R, C] -> float32 [B, R * C, T] about 1."""
        x = digits.flatten(2).transpose(1, 2).float()
        return (x - (x.mean(2, keepdim=True) if self.offset is None else self.offset)) * self.scale

    @abstractmethod
    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] as `prepare` gives -> what the head sees of it [B, F]."""

    def judge(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] as `prepare` gives -> logits [B, K]; in training the head misses some features."""
        logits: Tensor = self.head(functional.dropout(self.features(prepared), self.dropout, self.training))
        return logits

    def seen(self, digits: Tensor) -> Tensor:
        """Digits [B, T, R, C] -> what the head sees of them [B, F]."""
        return self.features(self.prepare(digits))

    def forward(self, digits: Tensor) -> Tensor:
        """Digits [B, T, R, C] -> logits [B, K]."""
        logits: Tensor = self.head(self.seen(digits))
        return logits

    def fused(self) -> Network:
        """The same network, ready for inference."""
        return self.eval()

    @abstractmethod
    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K], as in inference."""


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


@dataclass(frozen=True)
class Image:
    """Layers of an ImageNetwork. channels: of each convolution; strides: its steps in (time, taxels); pool: in time.

    norm: batch norms behind the convolutions. dense: neurons of the layer before the head.
    """

    channels: tuple[int, ...]
    strides: tuple[tuple[int, int], ...]
    pool: int
    norm: bool
    dense: int


KERNEL = (15, 5)
"""Of the paper's convolutions, frames by taxels (table I)."""
PAPER = Image(channels=(32, 64), strides=((1, 1), (1, 1)), pool=10, norm=False, dense=1024)
"""The paper's CNN (eq. 6 to 9, table I)."""
TACTNET2 = Image(channels=(32, 64, 128), strides=((5, 2), (5, 2), (5, 1)), pool=2, norm=True, dense=1024)
"""TactNet-II as far as it is known: three convolutions, batch norm, 1.84 M parameters (Tulbure and Baeuml 2018; here
1.83 M for 1500 x 4 x 4 and six classes). The kernels are those of its predecessor; channels, strides, which stand for
most of the pooling and are a twentieth of the work, and the dense layer are ours."""


class ImageNetwork(Network):
    """Convolutions over one image, time by taxels, then a dense layer: the form of the paper's CNN.

    Zero padding keeps sizes; where the pooling runs over the end it pools what is there.
    """

    def __init__(self, form: SweepFormat, classes: int, scale: float, offset: float | None, plan: Image) -> None:
        super().__init__(form, scale, offset)
        self.plan, steps, taxels = plan, form.window, form.rows * form.cols
        self.convs, self.norms = nn.ModuleList(), nn.ModuleList()
        for before, after, by in zip((1, *plan.channels), plan.channels, plan.strides, strict=False):
            self.convs.append(nn.Conv2d(before, after, KERNEL, by, padding=(KERNEL[0] // 2, KERNEL[1] // 2)))
            self.norms.append(nn.BatchNorm2d(after) if plan.norm else nn.Identity())
            steps, taxels = ceil(ceil(steps / by[0]) / plan.pool), ceil(taxels / by[1])
        self.dense = nn.Linear(plan.channels[-1] * steps * taxels, plan.dense)
        self.head = nn.Linear(plan.dense, classes)
        for layer in (*self.convs, self.dense):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        self.to(memory_format=torch.channels_last)  # a fifth faster on a processor

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> activations of the dense layer [B, plan.dense]."""
        x = prepared.transpose(1, 2)[:, None]
        for conv, norm in zip(self.convs, self.norms, strict=True):
            x = functional.max_pool2d(norm(conv(x)), (self.plan.pool, 1), ceil_mode=True).relu()
        return torch.relu(self.dense(x.flatten(1)))

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]; the batch norms are folded into the convolutions."""
        g, form, classes = Graph(), self.form, self.head.out_features
        steps, taxels = form.window, form.rows * form.cols
        if self.offset is None:
            x = g("Transpose", centred(g, form)[0], perm=[0, 2, 1])
        else:
            x = g("Sub", g("Cast", "sweep", to=TensorProto.FLOAT), g.constant(self.offset))
        x = g("Mul", g("Reshape", x, g.constant([1, 1, steps, taxels], "int64")), g.constant(self.scale))
        for conv, norm in zip(self.convs, self.norms, strict=True):
            plain = fuse_conv_bn_eval(conv.eval(), norm.eval()) if self.plan.norm else conv
            x = g("Conv", x, *_constants(g, plain), pads=list(conv.padding) * 2, strides=list(conv.stride))
            steps = ceil(steps / conv.stride[0])
            by = [self.plan.pool, 1]
            x = g("MaxPool", g("Relu", x), kernel_shape=by, strides=by, pads=[0, 0, -steps % self.plan.pool, 0])
            steps = ceil(steps / self.plan.pool)
        x = g("Relu", g("Gemm", g("Flatten", x), *_constants(g, self.dense), transB=1))
        g("Gemm", x, *_constants(g, self.head), transB=1, output="logits")
        return g.model(form, "logits", classes)


class Recurrent(Network):
    """Patches of time with the taxels as channels, a gated recurrent unit over them; the head sees its mean state.

    A patch is two strides long; about PATCHES of them cover the window, whatever its rate and length.
    """

    def __init__(self, form: SweepFormat, classes: int, scale: float) -> None:
        super().__init__(form, scale)
        self.stride = max(form.window // PATCHES, 1)
        kernel = min(max(2 * self.stride, LEAST_PATCH), form.window)
        self.patches = nn.Conv1d(form.rows * form.cols, STATE, kernel, self.stride)
        self.unit = nn.GRU(STATE, STATE)
        self.head = nn.Linear(STATE, classes)

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> mean state over time [B, STATE]."""
        states, _ = self.unit(torch.relu(self.patches(prepared)).permute(2, 0, 1))
        return states.mean(0)

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]."""
        g, unit = Graph(), self.unit
        x = g("Mul", centred(g, self.form)[0], g.constant(self.scale))
        x = g("Relu", g("Conv", x, *_constants(g, self.patches), strides=[self.stride]))
        given, kept = (_reordered(w) for w in (unit.weight_ih_l0, unit.weight_hh_l0))
        biases = np.concatenate([_reordered(b) for b in (unit.bias_ih_l0, unit.bias_hh_l0)])
        weights = [g.constant(w[None]) for w in (given, kept, biases)]
        x = g("GRU", g("Transpose", x, perm=[2, 0, 1]), *weights, hidden_size=STATE, linear_before_reset=1)
        x = g("Reshape", g("ReduceMean", x, axes=[0]), g.constant([1, STATE], "int64"))
        g("Gemm", x, *_constants(g, self.head), transB=1, output="logits")
        return g.model(self.form, "logits", self.head.out_features)


def _constants(g: Graph, layer: nn.Module) -> tuple[str, str]:
    return g.constant(layer.weight.detach().numpy()), g.constant(layer.bias.detach().numpy())


def _reordered(gates: Tensor) -> NDArray[Any]:
    """PyTorch's gates (reset, update, new) in ONNX's order (update, reset, new)."""
    reset, update, new = gates.detach().numpy().reshape(3, STATE, *gates.shape[1:])
    return np.concatenate([update, reset, new])


def paper_cnn(form: SweepFormat, classes: int, rng: np.random.Generator) -> onnx.ModelProto:
    """The paper's CNN with random weights: a yardstick for time and memory, not for accuracy."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**31)))
        return ImageNetwork(form, classes, 1 / 255, 0.0, PAPER).graph()
