"""The room of networks. In: the form of a sweep. Out: networks in PyTorch, each of which writes its own ONNX graph.

Compact, the box's own, has its own room. All have a linear head on features of a sweep; `prepare` makes digits what the convolutions take. The graphs are
written with train/graphs.py and take the sensor's own digits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
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

from appliance.core.types import SweepFormat
from train.models.linear_head import ABSENT
from train.onnx_tools.graph_builder import GraphBuilder, centred

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

    @torch.no_grad()
    def spread(self, present: NDArray[Any], classes: int, cooler: float) -> None:
        """Take a head for all `classes`, of which `present` were learnt; the logits are divided by `cooler`.

        Moved so that the logits that were learnt add up to 0: no softmax changes, and ABSENT lies far below the largest.
        """
        old, new = self.head, nn.utils.skip_init(nn.Linear, self.head.in_features, classes)  # draws nothing
        new.weight.zero_()
        new.bias.fill_(ABSENT)
        new.weight[present] = (old.weight - old.weight.mean(0)) / cooler
        new.bias[present] = (old.bias - old.bias.mean()) / cooler
        self.head = new

    @abstractmethod
    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K], as in inference."""


def texture_scale(samples: NDArray[Any]) -> float:
    """What makes digits [N, T, R, C] of deviation 1 after each taxel's mean over each sweep is taken away."""
    deviation = samples - samples.mean(axis=1, keepdims=True, dtype=np.float32)
    return float(1 / max(np.sqrt(np.mean(deviation**2)), 1e-6))


@dataclass(frozen=True)
class ImageShape:
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
PAPER = ImageShape(channels=(32, 64), strides=((1, 1), (1, 1)), pool=10, norm=False, dense=1024)
"""The paper's CNN (eq. 6 to 9, table I)."""
TACTNET2 = ImageShape(channels=(32, 64, 128), strides=((5, 2), (5, 2), (5, 1)), pool=2, norm=True, dense=1024)
"""TactNet-II as far as it is known: three convolutions, batch norm, 1.84 M parameters (Tulbure and Baeuml 2018; here
1.83 M for 1500 x 4 x 4 and six classes). The kernels are those of its predecessor; channels, strides, which stand for
most of the pooling and are a twentieth of the work, and the dense layer are ours."""


class ImageNetwork(Network):
    """Convolutions over one image, time by taxels, then a dense layer: the form of the paper's CNN.

    Zero padding keeps sizes; where the pooling runs over the end it pools what is there.
    """

    def __init__(self, form: SweepFormat, classes: int, scale: float, offset: float | None, plan: ImageShape) -> None:
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
        g, form, classes = GraphBuilder(), self.form, self.head.out_features
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
        g, unit = GraphBuilder(), self.unit
        x = g("Mul", centred(g, self.form)[0], g.constant(self.scale))
        x = g("Relu", g("Conv", x, *_constants(g, self.patches), strides=[self.stride]))
        given, kept = (_reordered(w) for w in (unit.weight_ih_l0, unit.weight_hh_l0))
        biases = np.concatenate([_reordered(b) for b in (unit.bias_ih_l0, unit.bias_hh_l0)])
        weights = [g.constant(w[None]) for w in (given, kept, biases)]
        x = g("GRU", g("Transpose", x, perm=[2, 0, 1]), *weights, hidden_size=STATE, linear_before_reset=1)
        x = g("Reshape", g("ReduceMean", x, axes=[0]), g.constant([1, STATE], "int64"))
        g("Gemm", x, *_constants(g, self.head), transB=1, output="logits")
        return g.model(self.form, "logits", self.head.out_features)


def _constants(g: GraphBuilder, layer: nn.Module) -> tuple[str, str]:
    return g.constant(layer.weight.detach().numpy()), g.constant(layer.bias.detach().numpy())


def _reordered(gates: Tensor) -> NDArray[Any]:
    """PyTorch's gates (reset, update, new) in ONNX's order (update, reset, new)."""
    reset, update, new = gates.detach().numpy().reshape(3, STATE, *gates.shape[1:])
    return np.concatenate([update, reset, new])


def paper_cnn(form: SweepFormat, classes: int, rng: np.random.Generator) -> onnx.ModelProto:
    """The paper's CNN with random weights: a reference for time and memory, not for accuracy."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**31)))
        return ImageNetwork(form, classes, 1 / 255, 0.0, PAPER).graph()
