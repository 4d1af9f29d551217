"""The trained stages: their network in PyTorch, and its training.

The convolutions are trained by gradient descent on augmented sweeps, under a head that is dropped
afterwards: recipe.py fits heads in closed form. No random state outside is read or changed.

The sizes of the stages are in architectures.py; graph.py writes their graphs, in float and in int8.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from palpate.core.types import SweepFormat
from palpate_train.data.augment import Augmentation, augment
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.models.networks import Network
from palpate_train.models.recipe.architectures import FLOOR, NOISE_LIMIT, STAGES, Architecture
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.graph import Ranges, level_frames
from palpate_train.models.training import (
    Augment,
    TrainingRecipe,
    batches,
    float_batches,
    learn,
    one_thread,
)
from palpate_train.onnx_tools.quantize import PERCENTILE, calibration_sweeps

Array = NDArray[Any]
TRAINING = TrainingRecipe()
"""The training of stages, but for its steps."""


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
    """Taxels [B, R * C, T] with attenuation of a taxel that is much noisier than others; see
    architectures.NoiseLimit."""
    step, rank = NOISE_LIMIT.step(x.shape[2]), NOISE_LIMIT.rank(x.shape[1])
    noise = (x[:, :, 1::step] - x[:, :, :-1:step]).abs().mean(2, keepdim=True)
    limit = NOISE_LIMIT.times * noise.topk(rank + 1, dim=1).values[:, -1:]
    return torch.where((noise > limit) & (limit > 0), x * (limit / noise), x)


class StagesNetwork(Network):
    """Strided convolutions over time with the taxels as channels; the head sees the logarithm of
    every mean response.

    If the window is long, the first kernels sum to zero and do not respond to the mains. Only
    texture remains, and int8 can take the raw counts as they are. `scale` brings the texture to
    about 1. The batch norms only serve training; `fused` folds them in.
    """

    def __init__(
        self,
        format: SweepFormat,
        classes: int,
        scale: float,
        norm: bool = True,
        architecture: Architecture = STAGES,
    ) -> None:
        super().__init__(format, scale)
        self.architecture = architecture
        stages, inputs = (
            architecture.stages(format.window),
            (format.channels, *architecture.channels),
        )
        self.convs = nn.ModuleList(
            nn.Conv1d(before, after, stage.kernel, stage.stride)
            for before, after, stage in zip(inputs, architecture.channels, stages, strict=False)
        )
        if architecture.zero_sum(format.window):
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
        self.head = nn.Linear(sum(architecture.channels), classes)

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
        return torch.log(torch.cat(means, 1) + FLOOR)

    def fused(self) -> StagesNetwork:
        """The same network for inference, with its batch norms folded into the convolutions."""
        plain = StagesNetwork(
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
        first = plain.convs[0].get_parameter("weight")
        first.data.copy_(self.first_taps(first))
        return plain.eval()

    def first_taps(self, weight: Tensor) -> Tensor:
        """The taps that the first convolution applies for its weight."""
        first = self.convs[0]
        return first.effective(weight) if isinstance(first, ZeroSum) else weight

    @torch.no_grad()
    def weights(self) -> dict[str, Array]:
        """The weights that `trunk_graph` takes; of a fused network."""
        weights = {k: v.numpy() for k, v in self.state_dict().items()}
        return weights | {
            "convs.0.weight": self.first_taps(self.convs[0].get_parameter("weight")).numpy()
        }

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


def network_of(fit: Fit) -> StagesNetwork:
    """The stages of a fit as a network that computes their features; its head is arbitrary."""
    with torch.random.fork_rng(devices=[]):  # its first weights are drawn and overwritten
        format, classes = fit.train.format, len(fit.train.materials)
        model = StagesNetwork(format, classes, fit.scale, False, fit.architecture)
    prefix = "convs."
    model.convs.load_state_dict(
        {
            name.removeprefix(prefix): torch.from_numpy(values)
            for name, values in fit.weights.items()
            if name.startswith(prefix)
        }
    )
    return model.eval()


UNFINISHED = "stages.pt"
"""Name of the file that keeps an unfinished training; see training.learn."""


def train_stages(
    sweeps: Dataset,
    scale: float,
    run: Run,
    steps: int,
    augmentation: Augmentation,
    architecture: Architecture = STAGES,
) -> tuple[dict[str, Array], Ranges]:
    """Stages trained on all of `sweeps`, whose counts are multiplied by `scale`: their weights as
    graph.trunk_graph takes them, and ranges for int8."""
    recipe, change = replace(TRAINING, steps=steps), augmenter(sweeps.format, augmentation)
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(run.seed)
        model = StagesNetwork(
            sweeps.format, len(sweeps.materials), scale, architecture=architecture
        )
        kept = run.file(UNFINISHED)
        model, _ = learn(model, sweeps, recipe, run.seed, run.log, augment=change, unfinished=kept)
        weights = {k: v for k, v in model.weights().items() if k.startswith("convs.")}
        return weights, model.ranges(sweeps.samples)


def augmenter(format: SweepFormat, augmentation: Augmentation) -> Augment:
    """`augment` for sweeps of `format` as the training loop calls it: in PyTorch, seeded by its
    generator."""
    rows = format.rows if format.cols > 1 else 1

    def change(x: Tensor, rng: Generator) -> Tensor:
        seed = int(torch.randint(2**63 - 1, (), generator=rng))
        return torch.from_numpy(augment(x.numpy(), rows, augmentation, np.random.default_rng(seed)))

    return change
