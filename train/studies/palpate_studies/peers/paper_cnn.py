"""The paper's CNN and TactNet-II: the METHODS paper-cnn, paper-cnn-centred and tactnet2.

Both convolve over one image, time by taxels; the layers of each are an ImageLayers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
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

Array = NDArray[Any]
PAPER_STEPS, PROCESSOR_STEPS = 4000, 200
"""Iterations of the paper's CNN: the paper's (table I) on a GPU; fewer on a processor, because a
core needs about a second for each."""
PAPER_RECIPE = PeerRecipe(
    batch=50,
    peak_rate=1e-4,
    weight_decay=0.0,
    smoothing=0.0,
    ema=0.0,
    dropout=0.25,
    noise=0.0,
    gain=0.0,
    cycle=False,
)
"""The recipe as printed (section IV.D); the paper's p_d = .75 is the share that is kept."""
INT8_NODES = ("Conv", "Relu", "MaxPool", "Gemm")
"""Kinds of nodes of the paper's CNN that are in int8 in the precision "int8"."""
TACTNET2_RECIPE = PeerRecipe(
    steps=120,
    batch=32,
    peak_rate=2e-3,
    smoothing=0.0,
    ema=0.9,
    dropout=0.5,
    noise=0.0,
    gain=0.0,
    adversarial=0.01,
)
"""Adversarial training as in Goodfellow et al. 2015, half of the cost; dropout as in Gal and
Ghahramani 2016. The numbers are our choice, so that one core needs about half a minute for 480
sweeps. An adversarial step larger than .01 lowered the accuracy on positions held out inside a
training set."""


@dataclass(frozen=True)
class ImageLayers:
    """Layers of an ImageNetwork. channels: of each convolution; strides: of each in (time, taxels);
    pool: in time.

    norm: whether batch norms follow the convolutions. dense: number of neurons of the layer before
    the head.
    """

    channels: tuple[int, ...]
    strides: tuple[tuple[int, int], ...]
    pool: int
    norm: bool
    dense: int


KERNEL = (15, 5)
"""Kernel of the paper's convolutions, frames by taxels (table I)."""
PAPER = ImageLayers(channels=(32, 64), strides=((1, 1), (1, 1)), pool=10, norm=False, dense=1024)
"""The paper's CNN (eq. 6 to 9, table I)."""
TACTNET2 = ImageLayers(
    channels=(32, 64, 128), strides=((5, 2), (5, 2), (5, 1)), pool=2, norm=True, dense=1024
)
"""TactNet-II as far as it is published: three convolutions, batch norm, 1.84 M parameters (Tulbure
and Baeuml 2018; here 1.83 M for 1500 x 4 x 4 and six classes). The kernels are its
predecessor's. Channels, the dense layer and strides are our choice; the strides replace most of the
pooling, at a twentieth of the work."""


class ImageNetwork(PeerNetwork):
    """Convolutions over one image, time by taxels, then a dense layer, as in the paper's CNN.

    Zero padding keeps sizes; a pooling window that reaches past the end pools only the steps before
    it.
    """

    def __init__(
        self,
        format: SweepFormat,
        classes: int,
        scale: float,
        offset: float | None,
        layers: ImageLayers,
    ) -> None:
        super().__init__(format, scale, offset)
        self.layers, steps, taxels = layers, format.window, format.channels
        self.convs, self.norms = nn.ModuleList(), nn.ModuleList()
        for before, after, by in zip(
            (1, *layers.channels), layers.channels, layers.strides, strict=False
        ):
            self.convs.append(
                nn.Conv2d(before, after, KERNEL, by, padding=(KERNEL[0] // 2, KERNEL[1] // 2))
            )
            self.norms.append(nn.BatchNorm2d(after) if layers.norm else nn.Identity())
            steps, taxels = ceil(ceil(steps / by[0]) / layers.pool), ceil(taxels / by[1])
        self.dense = nn.Linear(layers.channels[-1] * steps * taxels, layers.dense)
        self.head = nn.Linear(layers.dense, classes)
        for layer in (*self.convs, self.dense):
            nn.init.kaiming_normal_(layer.get_parameter("weight"), nonlinearity="relu")
            nn.init.zeros_(layer.get_parameter("bias"))
        # a fifth faster on a processor; PyTorch's types lack the argument
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def _convolutions(self) -> Iterator[tuple[nn.Conv2d, nn.Module]]:
        """Each convolution with its batch norm, or None."""
        for conv, norm in zip(self.convs, self.norms, strict=True):
            assert isinstance(conv, nn.Conv2d)
            yield conv, norm

    def features(self, prepared: Tensor) -> Tensor:
        """[B, R * C, T] -> activations of the dense layer [B, layers.dense]."""
        x = prepared.transpose(1, 2)[:, None]
        for conv, norm in self._convolutions():
            y = norm(conv(x))
            x = functional.max_pool2d(y, (self.layers.pool, 1), ceil_mode=True).relu()
        return torch.relu(self.dense(x.flatten(1)))

    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K]; the batch norms are folded into the convolutions."""
        g, format, classes = GraphBuilder(), self.format, self.head.out_features
        steps, taxels, pool = format.window, format.channels, self.layers.pool
        if self.offset is None:
            x = g("Transpose", centred(g, format)[0], perm=[0, 2, 1])
        else:
            x = g("Sub", g("Cast", "sweep", to=TensorProto.FLOAT), g.constant(self.offset))
        x = g("Mul", g("Reshape", x, [1, 1, steps, taxels]), g.constant(self.scale))
        for conv, norm in self._convolutions():
            if isinstance(norm, nn.BatchNorm2d):
                conv = fuse_conv_bn_eval(conv.eval(), norm.eval())
            padding = [KERNEL[0] // 2, KERNEL[1] // 2]
            x = g("Conv", x, *layer_constants(g, conv), pads=padding * 2, strides=list(conv.stride))
            steps = ceil(steps / conv.stride[0])
            x = g(
                "MaxPool",
                g("Relu", x),
                kernel_shape=[pool, 1],
                strides=[pool, 1],
                pads=[0, 0, -steps % pool, 0],
            )
            steps = ceil(steps / pool)
        x = g("Relu", g("Gemm", g("Flatten", x), *layer_constants(g, self.dense), transB=1))
        g("Gemm", x, *layer_constants(g, self.head), transB=1, output="logits")
        return g.model(format, "logits", classes)


def build_paper_cnn(format: SweepFormat, classes: int, samples: Array) -> PeerNetwork:
    """The paper's CNN; raw counts are scaled by one mean and one deviation of all `samples`,
    because the paper prints no scale.

    It has 15,891,910 parameters for 1500 x 4 x 4 and six materials.
    """
    mean = float(samples.mean(dtype=np.float64))
    scale = float(1 / max(samples.std(dtype=np.float64), 1e-6))
    return ImageNetwork(format, classes, scale, mean, PAPER)


build_centred: Build = partial(centred_network, partial(ImageNetwork, offset=None, layers=PAPER))
"""The paper's CNN behind a layer that subtracts each taxel's mean."""
build_tactnet2: Build = partial(
    centred_network, partial(ImageNetwork, offset=None, layers=TACTNET2)
)
"""TactNet-II as far as it is published (TACTNET2); each taxel's mean is subtracted.

Dropout is off at test time, on the box and here. This is the mean field of the published Monte
Carlo dropout; the same sweep always gets the same answer.
"""


def random_paper_cnn(
    format: SweepFormat, classes: int, rng: np.random.Generator
) -> onnx.ModelProto:
    """The graph of the paper's CNN with random weights: a reference model for time and memory, not
    for accuracy."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**31)))
        return ImageNetwork(format, classes, 1 / 255, 0.0, PAPER).graph()


def methods(effort: Effort = FULL_EFFORT) -> tuple[Method, ...]:
    """The methods, trained with this effort."""
    steps = PAPER_STEPS if torch.cuda.is_available() else PROCESSOR_STEPS
    recipe = scale_steps(replace(PAPER_RECIPE, steps=steps), effort)

    def paper(name: str, about: str, build: Build) -> Method:
        """As printed: trained on all sweeps, without a temperature."""
        more: dict[str, Any] = {"calibrated": False, "int8": INT8_NODES}
        return network_method(name, about, build, recipe, **more)

    return (
        paper(
            "paper-cnn",
            f"the paper's CNN on raw counts (section IV), {recipe.steps} iterations",
            build_paper_cnn,
        ),
        paper(
            "paper-cnn-centred",
            "the paper's CNN behind a layer that subtracts each taxel's mean",
            build_centred,
        ),
        network_method(
            "tactnet2",
            "TactNet-II as far as it is published (Tulbure and Baeuml 2018)",
            build_tactnet2,
            scale_steps(TACTNET2_RECIPE, effort),
        ),
    )
