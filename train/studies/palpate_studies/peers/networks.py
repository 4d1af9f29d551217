"""Training of the peers' networks: a PeerNetwork, a PeerRecipe and sweeps give a model and its
cost curve."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor, nn

from palpate.core.types import SweepFormat
from palpate_train.data.augment import texture_scale
from palpate_train.data.sets import Dataset
from palpate_train.metrics.temperature import platt_temperature
from palpate_train.models.linear_head import ABSENT, hold_out_or_all
from palpate_train.models.methods import Cost, Effort, Method, Model
from palpate_train.models.networks import Network
from palpate_train.models.training import (
    TrainingRecipe,
    batches,
    float_batches,
    learn,
    one_thread,
)
from palpate_train.onnx_tools.graph_builder import GraphBuilder, GraphModel
from palpate_train.onnx_tools.quantize import quantize

Array = NDArray[Any]
Recipe = TypeVar("Recipe", bound=TrainingRecipe)
MIN_STEPS = 2
"""Least number of iterations, for any effort."""


@dataclass(frozen=True)
class PeerRecipe(TrainingRecipe):
    """The training of a peer.

    noise and gain: standard deviations, of a scaled taxel and of its factor. adversarial: how far
    each scaled count is also moved in the direction of a rising cost (fast gradient sign;
    Goodfellow 2015); 0 for none.
    """

    noise: float = 0.05
    gain: float = 0.15
    adversarial: float = 0.0

    def perturbed(self, x: Tensor, rng: Generator) -> Tensor:
        """Sweeps [B, R * C, T] with other gains and added noise."""
        if self.gain:
            x = x * (1 + self.gain * torch.randn(x.shape[:2], generator=rng)[..., None])
        return x + self.noise * torch.randn(x.shape, generator=rng) if self.noise else x


class PeerNetwork(Network):
    """Base class of the peers' networks. offset: what is subtracted from raw counts; None: the mean
    of each taxel. adversarial: of a PeerRecipe."""

    adversarial = 0.0

    def __init__(self, format: SweepFormat, scale: float, offset: float | None = None) -> None:
        super().__init__(format, scale)
        self.offset = offset

    def prepare(self, counts: Tensor) -> Tensor:
        """Raw counts [B, T, R, C] -> float32 [B, R * C, T] of about 1."""
        if self.offset is None:
            return super().prepare(counts)
        return (counts.flatten(2).transpose(1, 2).float() - self.offset) * self.scale

    def backward(self, x: Tensor, labels: Tensor, smoothing: float) -> float:
        """As Network.backward; with the gradients of the sweeps moved by `adversarial`, too."""
        x.requires_grad_(self.adversarial > 0)
        loss = super().backward(x, labels, smoothing)
        if self.adversarial:
            assert x.grad is not None
            super().backward(x.detach() + self.adversarial * x.grad.sign(), labels, smoothing)
        return loss

    @abstractmethod
    def graph(self) -> onnx.ModelProto:
        """`sweep` -> `logits` float32 [1, K], as in inference."""

    @torch.no_grad()
    def expand_head(self, present: Array, classes: int, temperature: float) -> None:
        """Replace the head, trained for `present`, by a head for all `classes`; logits are
        divided by `temperature`.

        The trained logits are shifted to sum to 0, which changes no softmax; ABSENT lies far below
        the largest of them.
        """
        old = self.head
        new = nn.utils.skip_init(nn.Linear, old.in_features, classes)  # draws no random numbers
        new.weight.zero_()
        new.bias.fill_(ABSENT)
        new.weight[present] = (old.weight - old.weight.mean(0)) / temperature
        new.bias[present] = (old.bias - old.bias.mean()) / temperature
        self.head = new


Build = Callable[[SweepFormat, int, Array], PeerNetwork]
"""(format, number of materials, training samples [N, T, R, C]) -> an untrained network."""


def centred_network(
    make: Callable[[SweepFormat, int, float], PeerNetwork],
    format: SweepFormat,
    classes: int,
    samples: Array,
) -> PeerNetwork:
    """The network of `make`, which takes a scale, as a Build; each taxel's mean is subtracted."""
    return make(format, classes, texture_scale(samples))


def layer_constants(g: GraphBuilder, layer: nn.Linear | nn.Conv1d | nn.Conv2d) -> tuple[str, str]:
    """The names of a layer's weight and bias, added to the graph as constants."""
    assert layer.bias is not None
    return g.constant(layer.weight.detach().numpy()), g.constant(layer.bias.detach().numpy())


@dataclass(frozen=True)
class NetworkModel:
    """A trained network as a Model. ran: a description of the computation. cost: of the training.
    precisions: the same model in others, by name."""

    network: PeerNetwork
    ran: str
    cost: Cost = field(default_factory=list)
    precisions: Mapping[str, Model] = field(default_factory=dict)

    @torch.no_grad()
    def logits(self, inputs: Array) -> Array:
        """Raw counts [n, T, R, C] -> float32 [n, K]."""
        with one_thread():
            return np.concatenate(
                [self.network(x).numpy() for x in float_batches(inputs, batches(len(inputs), 32))]
            )

    def graph(self) -> onnx.ModelProto:
        """`sweep` [1, T, R, C] -> `logits` float32 [1, K]."""
        return self.network.graph()


@contextmanager
def deterministic_device(seed: int) -> Iterator[str]:
    """The name of the device: a GPU if there is one, else one thread of the processor.

    It computes the same bits each time, and no random state outside is changed.
    """
    # without TF32, which rounds the factors of products in float32
    exact = torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False)
    with one_thread(), exact, torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        torch.manual_seed(seed)
        yield "cuda" if torch.cuda.is_available() else "cpu"


def train_network(
    sweeps: Dataset,
    inputs: Array,
    seed: int,
    *,
    build: Build,
    recipe: PeerRecipe,
    calibrated: bool,
    int8: Sequence[str],
) -> NetworkModel:
    """A network of `build`, trained on the materials that occur in `inputs`, the raw counts [N, T,
    R, C] of `sweeps`.

    A material that does not occur gets a logit that no sweep can raise. calibrated: hold some
    groups out for the temperature; else train on all, with temperature 1. int8: kinds of nodes that
    are in int8 in the precision "int8"; without any that precision is left out. Raises FormatError
    if only one material occurs.
    """
    known = replace(sweeps, samples=inputs).select(())
    train, held_out = hold_out_or_all(known, seed)[:2] if calibrated else (known, known)
    with deterministic_device(seed) as device:
        network = build(train.format, len(train.materials), train.samples)
        network.adversarial = recipe.adversarial
        network, cost = learn(network, train, recipe, seed, device=device, augment=recipe.perturbed)
        ran = f"{recipe.steps} iterations of {recipe.batch} in float32 on {device}"
    trained = NetworkModel(network, ran, cost)
    temperature = (
        platt_temperature(trained.logits(held_out.samples), held_out.labels) if calibrated else 1.0
    )
    network.expand_head(np.unique(sweeps.labels), len(sweeps.materials), temperature)
    graph = quantize(network.graph(), train.samples, int8) if int8 else None
    return replace(trained, precisions={"int8": GraphModel(graph)} if graph else {})


def network_method(
    name: str,
    about: str,
    build: Build,
    recipe: PeerRecipe,
    *,
    calibrated: bool = True,
    int8: Sequence[str] = (),
) -> Method:
    """The Method of this name that trains the networks of `build`; see train_network."""
    train = partial(train_network, build=build, recipe=recipe, calibrated=calibrated, int8=int8)
    return Method(name, about, "raw", train, effort=f"{recipe.steps} iterations")


def scale_steps(recipe: Recipe, effort: Effort) -> Recipe:
    """`recipe` with the iterations of `effort`."""
    return replace(recipe, steps=max(round(recipe.steps * effort.share), MIN_STEPS))
