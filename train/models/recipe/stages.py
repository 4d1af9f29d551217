"""The trained stages: the compact network in PyTorch, its training, and a fit of it alone.

The convolutions are trained by gradient descent on augmented sweeps. Then shrinkage LDA in closed
form replaces the head, once for the network and once for its int8 trunk. Held-out groups decide how
many stages the heads see, and the temperature. No random state outside is read or changed.

The sizes of the network are in architectures.py; graph.py writes its graphs, in float and in int8.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from appliance.core.errors import FormatError
from appliance.core.types import SweepFormat
from appliance.inference.classifier import LEAST_PROBABILITY, softmax
from train.calibration.heads import HeadPart, HeadPlan
from train.data.sets import Dataset
from train.metrics.score import accuracy_figure
from train.models import training
from train.models.linear_head import closed_form_head, hold_out
from train.models.methods import Cost, Log, no_log
from train.models.networks import Network
from train.models.recipe import graph, spectrum
from train.models.recipe.architectures import DEFAULT, FLOOR, NOISE_LIMIT, Architecture
from train.models.recipe.augment import (
    COPIES,
    Augmentation,
    augment,
    copies,
    default_augmentation,
    texture_scale,
)
from train.models.recipe.fitted import Fit, finished
from train.models.recipe.graph import Ranges, level_frames, trunk_graph
from train.models.training import Augment, batches, float_batches, learn, one_thread
from train.onnx_tools.graph_builder import run, with_head
from train.onnx_tools.quantize import PERCENTILE, calibration_sweeps

Array = NDArray[Any]
HeadInputs = tuple[tuple[Array, Array], ...]
"""(features of the training sweeps and their copies, features of the held-out sweeps) of the float
and the int8 trunk."""


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
    about 1. The batch norms only serve training; `fused` folds them in.
    """

    def __init__(
        self,
        format: SweepFormat,
        classes: int,
        scale: float,
        norm: bool = True,
        architecture: Architecture = DEFAULT,
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
        self.head = nn.Linear(sum(architecture.channels) + bands, classes)

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
        less = Compact(self.format, self.head.out_features, self.scale, False, architecture)
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
        trunk = trunk_graph(self.format, self.scale, weights, self.architecture)
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


def network_of(fit: Fit) -> Compact:
    """The network of a fit, ready to run; the fit has no filter bank."""
    with torch.random.fork_rng(devices=[]):  # its first weights are drawn and overwritten
        format, classes = fit.train.format, len(fit.train.materials)
        model = Compact(format, classes, fit.scale, False, fit.architecture)
    state = {k: torch.from_numpy(v) for k, v in fit.weights.items() if not k.startswith("int8.")}
    model.load_state_dict(state)
    return model.eval()


@dataclass(frozen=True)
class FitRecipe(training.TrainingRecipe):
    """The training of the compact network.

    augmentation: of the training sweeps, None for `default_augmentation`; it replaces gain and
    noise.
    """

    steps: int = 600
    noise: float = 0.0
    gain: float = 0.0
    augmentation: Augmentation | None = None

    def json(self) -> dict[str, Any]:
        """The entry `recipe` of a fit and of the manifest of its bundle."""
        return asdict(self)


def fit_network(
    sweeps: Dataset,
    seed: int,
    recipe: FitRecipe,
    log: Log = no_log,
    architecture: Architecture = DEFAULT,
    unfinished: Path | None = None,
) -> Fit:
    """A finished fit of a network alone, trained on the sweeps that `hold_out` leaves. Raises
    FormatError as `hold_out`, and if the window is too short."""
    sides = hold_out(sweeps, seed)
    return finished(fit_network_on(*sides, seed, recipe, log, architecture, unfinished))


def fit_network_on(
    train: Dataset,
    held: Dataset,
    by: str,
    seed: int,
    recipe: FitRecipe,
    log: Log = no_log,
    architecture: Architecture = DEFAULT,
    unfinished: Path | None = None,
) -> Fit:
    """A network trained on `train`; `held` gives temperature and validation. by: the group that
    separates the two, for the record. unfinished: see training.learn."""
    format, bands = train.format, spectrum.count(train.format)
    if not (architecture.channels or bands):
        raise FormatError(
            f"a window of {format.window} frames is too short for a spectrum; take another size"
        )
    augmentation = recipe.augmentation or default_augmentation(architecture.zero_sum(format.window))
    recipe, scale = replace(recipe, augmentation=augmentation), texture_scale(train.samples)
    with one_thread(), torch.random.fork_rng(devices=[]), torch.no_grad():
        model, cost = _learned(train, scale, seed, recipe, log, architecture, unfinished)
        model.architecture = replace(architecture, spectrum=bands > 0)
        ranges = model.ranges(train.samples)
        inputs = _head_inputs(model, ranges, train, held, copies(train, augmentation, seed, COPIES))
        labels = np.tile(train.labels, COPIES + 1)
        model, weights = _select_depth(model, inputs, labels, held.labels)
        logits = features(model, held) @ weights["head.weight"].T + weights["head.bias"]
    about = {
        "seed": seed,
        "recipe": recipe.json() | {"mains_hz": architecture.mains_hz},
        "held_out_by": by,
        "validation": accuracy_figure(int(np.sum(logits.argmax(1) == held.labels)), len(held)),
    }
    ranges = replace(ranges, responses=ranges.responses[: len(model.convs)])
    plan = HeadPlan((HeadPart(tuple(range(weights["head.weight"].shape[1])), copies=True),))
    return Fit(weights, scale, model.architecture, ranges, train, held, about, plan, cost)


def train_stages(
    sweeps: Dataset,
    scale: float,
    seed: int,
    recipe: FitRecipe,
    log: Log,
    architecture: Architecture,
    unfinished: Path | None = None,
) -> tuple[dict[str, Array], graph.Ranges]:
    """Stages trained on all of `sweeps`, whose counts are multiplied by `scale`: their weights as
    graph.trunk_graph takes them, and ranges for int8. unfinished: see training.learn."""
    with one_thread(), torch.random.fork_rng(devices=[]):
        model, _ = _learned(sweeps, scale, seed, recipe, log, architecture, unfinished)
        weights = {k: v for k, v in model.weights().items() if k.startswith("convs.")}
        return weights, model.ranges(sweeps.samples)


def _learned(
    sweeps: Dataset,
    scale: float,
    seed: int,
    recipe: FitRecipe,
    log: Log,
    architecture: Architecture,
    unfinished: Path | None,
) -> tuple[Compact, Cost]:
    """A fused network trained on `sweeps`, and the cost of each step. Without stages there is
    nothing to train."""
    assert recipe.augmentation
    torch.manual_seed(seed)
    model = Compact(sweeps.format, len(sweeps.materials), scale, architecture=architecture)
    if not architecture.channels:
        return model.fused(), []
    change = augmenter(sweeps.format, recipe.augmentation)
    with torch.enable_grad():
        return learn(model, sweeps, recipe, seed, log, augment=change, unfinished=unfinished)


def _head_inputs(
    model: Compact, ranges: graph.Ranges, train: Dataset, held: Dataset, more: Iterable[Dataset]
) -> HeadInputs:
    """The features of the training sweeps with their copies, and of the held-out sweeps: (float,
    int8)."""
    trunk = graph.trunk_graph(
        model.format, model.scale, model.weights(), model.architecture, ranges
    )
    trunks: tuple[Callable[[Dataset], Array], ...] = (
        partial(features, model),
        lambda sweeps: run(trunk, sweeps.samples),
    )
    rows = [[compute(sweeps) for compute in trunks] for sweeps in chain([train], more)]
    return tuple(
        (np.concatenate(of_all), compute(held))
        for of_all, compute in zip(zip(*rows, strict=True), trunks, strict=True)
    )


def _select_depth(
    model: Compact, inputs: HeadInputs, labels: Array, held_labels: Array
) -> tuple[Compact, dict[str, Array]]:
    """The network, cut to the features that its heads see, and all weights of a Fit.

    The heads see the first stages, with the spectrum or without: the choice with the lowest cross
    entropy on the held-out sweeps, and among equal ones the smallest. The rest is cut off, because
    later stages overfit, and a head that was fitted to the same sweeps relies on them too much.
    """
    convolved, total = sum(model.architecture.channels), inputs[1][0].shape[1]
    bands = model.architecture.spectrum * spectrum.count(model.format)
    candidates = []
    depths = range(min(model.architecture.fewest, len(model.convs)), len(model.convs) + 1)
    for depth, with_bands in product(depths, (True, False) if bands else (False,)):
        if not depth and not with_bands:
            continue
        columns = np.r_[
            : sum(model.architecture.channels[:depth]), convolved : total - bands * (not with_bands)
        ]
        heads = [
            closed_form_head(x[:, columns], labels, y[:, columns], held_labels) for x, y in inputs
        ]
        weight, bias = heads[1]
        p = softmax(inputs[1][1][:, columns] @ weight.T + bias)[
            np.arange(len(held_labels)), held_labels
        ]
        candidates.append(
            (-np.log(np.maximum(p, LEAST_PROBABILITY)).mean(), depth, with_bands, heads)
        )
    _, depth, with_bands, heads = min(candidates, key=lambda candidate: candidate[0])
    model = model.cut(depth, with_bands)
    # a term that all materials share changes no probability, and costs float32 precision
    head_weights = {
        f"{name}.{k}": v - v.mean(axis=0)
        for name, head in zip(("head", "int8"), heads, strict=True)
        for k, v in zip(("weight", "bias"), head, strict=True)
    }
    model.head.weight.data = torch.from_numpy(head_weights["head.weight"])
    model.head.bias.data = torch.from_numpy(head_weights["head.bias"])
    return model, {k: v.numpy() for k, v in model.state_dict().items()} | head_weights


def augmenter(format: SweepFormat, augmentation: Augmentation) -> Augment:
    """`augment` for sweeps of `format` as the training loop calls it: in PyTorch, seeded by its
    generator."""
    rows = format.rows if format.cols > 1 else 1

    def change(x: Tensor, rng: Generator) -> Tensor:
        seed = int(torch.randint(2**63 - 1, (), generator=rng))
        return torch.from_numpy(augment(x.numpy(), rows, augmentation, np.random.default_rng(seed)))

    return change


@torch.no_grad()
def features(model: Network, sweeps: Dataset) -> Array:
    """The features of each sweep that the head sees, float32 [N, F]."""
    return np.concatenate(
        [model.head_input(x).numpy() for x in float_batches(sweeps.samples, batches(len(sweeps)))]
    )
