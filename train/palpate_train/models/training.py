"""Training of networks: from a Network, a Dataset and a TrainingRecipe to a trained network and its
cost curve.

Sweeps are drawn and augmented with a generator of their own. `learn` draws dropout from PyTorch's
global generator, which the caller seeds and forks; no other random state is read or changed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor
from torch.nn import functional
from torch.optim import lr_scheduler
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from palpate.core.types import SweepFormat
from palpate_train.data.sets import Dataset
from palpate_train.metrics.temperature import platt_temperature
from palpate_train.models.checkpoint import Checkpoint, Stateful, default_generators
from palpate_train.models.linear_head import hold_out_or_all
from palpate_train.models.methods import Cost, Effort, Log, Method, Model, no_log, spoken
from palpate_train.models.networks import Network
from palpate_train.onnx_tools.graph_builder import GraphModel
from palpate_train.onnx_tools.quantize import quantize

Array = NDArray[Any]
Net = TypeVar("Net", bound=Network)
Recipe = TypeVar("Recipe", bound="TrainingRecipe")
Augment = Callable[[Tensor, Generator], Tensor]
Watch = Callable[[int, Network], None]
"""Called after each step with its number and the network. It must neither change the network nor
draw random numbers."""
Build = Callable[[SweepFormat, int, Array], Network]
"""(format, number of materials, training samples [N, T, R, C]) -> an untrained network."""
MIN_STEPS = 2
"""Least number of iterations, for any effort."""


@dataclass(frozen=True)
class TrainingRecipe:
    """The training of a network: AdamW (Adam if `weight_decay` is 0) on batches drawn from shuffled
    rounds.

    cycle: the learning rate rises to `peak_rate` and falls again; else it is constant. ema: share
    of its old value that the moving average of the weights keeps in each step. dropout: of the
    features before the head. noise and gain: standard deviations, of a scaled taxel and of its
    factor. adversarial: how far each scaled count is also moved in the direction of a rising cost
    (fast gradient sign; Goodfellow 2015); 0 for none.
    """

    steps: int = 800
    batch: int = 48
    peak_rate: float = 3e-3
    weight_decay: float = 0.05
    smoothing: float = 0.1
    ema: float = 0.98
    dropout: float = 0.3
    noise: float = 0.05
    gain: float = 0.15
    cycle: bool = True
    adversarial: float = 0.0


@dataclass(frozen=True)
class NetworkModel:
    """A trained network as a Model. ran: a description of the computation. cost: of the training.
    precisions: the same model in others, by name."""

    network: Network
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


def unchanged(x: Tensor, rng: Generator) -> Tensor:
    """An augmentation without any change."""
    return x


@contextmanager
def one_thread() -> Iterator[None]:
    """Let PyTorch compute in one thread: the same bits for any number of cores, and hardly slower.

    On a busy machine two threads wait for each other; a fit there once took twenty times as long.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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


def perturbed(x: Tensor, recipe: TrainingRecipe, rng: Generator) -> Tensor:
    """Sweeps [B, R * C, T] with other gains and added noise."""
    if recipe.gain:
        x = x * (1 + recipe.gain * torch.randn(x.shape[:2], generator=rng)[..., None])
    return x + recipe.noise * torch.randn(x.shape, generator=rng) if recipe.noise else x


def learn(
    model: Net,
    sweeps: Dataset,
    recipe: TrainingRecipe,
    seed: int,
    log: Log = no_log,
    device: str = "cpu",
    bfloat16: bool = False,
    augment: Augment = unchanged,
    unfinished: Path | None = None,
    watch: Watch = lambda step, network: None,
) -> tuple[Net, Cost]:
    """Train by gradient descent. Returns the moving average of the weights, ready for inference on
    the processor, and the cost of each step.

    augment: changes sweeps [B, R * C, T], drawn anew in each step, before gain and noise. bfloat16:
    multiply in it. Dropout is drawn from PyTorch's global generator: the caller seeds and forks it.
    unfinished: a file that keeps the training from time to time, and from which it goes on with the
    same bits.
    """
    rng = torch.Generator().manual_seed(seed)
    order = _order(len(sweeps), recipe, rng)
    model = model.to(device)
    optimizer = torch.optim.AdamW(
        model.parameters(), recipe.peak_rate, weight_decay=recipe.weight_decay
    )
    schedule = _schedule(optimizer, recipe)
    average = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(recipe.ema), use_buffers=True)
    labels = torch.from_numpy(sweeps.labels.astype(np.int64))
    parts: dict[str, Stateful] = {
        "model": model,
        "optimizer": optimizer,
        "schedule": schedule,
        "average": average,
    }
    checkpoint = Checkpoint(unfinished, parts, (rng, *default_generators(device)))
    cost = checkpoint.load()
    picks = order.split(recipe.batch)[len(cost) :]
    done, begun = len(cost), time.monotonic()
    model.train().dropout = recipe.dropout
    batches_of_sweeps = zip(picks, float_batches(sweeps.samples, picks), strict=True)
    for step, (pick, counts) in enumerate(batches_of_sweeps, done + 1):
        x = perturbed(augment(model.prepare(counts), rng), recipe, rng).to(device)
        optimizer.zero_grad()
        with torch.autocast(device, torch.bfloat16, enabled=bfloat16):
            cost.append((step, backward(model, x, labels[pick].to(device), recipe)))
        optimizer.step()
        schedule.step()
        average.update_parameters(model)
        watch(step, model)
        checkpoint.save(cost)
        left = (time.monotonic() - begun) / (step - done) * (recipe.steps - step)
        log(f"step {step}/{recipe.steps} loss {cost[-1][1]:.3f}, {spoken(left)} left")
    averaged = average.module
    assert isinstance(averaged, type(model))
    return averaged.cpu().fused(), cost


def _order(n: int, recipe: TrainingRecipe, rng: Generator) -> Tensor:
    """The numbers of the sweeps of all batches, in shuffled rounds."""
    wanted = recipe.steps * recipe.batch
    return torch.cat([torch.randperm(n, generator=rng) for _ in range(-(-wanted // n))])[:wanted]


def _schedule(optimizer: torch.optim.Optimizer, recipe: TrainingRecipe) -> lr_scheduler.LRScheduler:
    """The learning rate over the steps of a recipe."""
    if recipe.cycle:
        return lr_scheduler.OneCycleLR(optimizer, recipe.peak_rate, total_steps=recipe.steps)
    return lr_scheduler.ConstantLR(optimizer, 1.0)


def backward(model: Network, x: Tensor, labels: Tensor, recipe: TrainingRecipe) -> float:
    """Leave the gradients of the cost in the weights, and return the cost of the unchanged
    sweeps."""
    x.requires_grad_(recipe.adversarial > 0)
    loss = functional.cross_entropy(
        model.training_logits(x).float(), labels, label_smoothing=recipe.smoothing
    )
    loss.backward()
    if recipe.adversarial:
        assert x.grad is not None
        worse = x.detach() + recipe.adversarial * x.grad.sign()
        functional.cross_entropy(
            model.training_logits(worse).float(), labels, label_smoothing=recipe.smoothing
        ).backward()
    return loss.item()


def batches(n: int, batch: int = 128) -> tuple[Tensor, ...]:
    """The numbers of n sweeps in order, a batch at a time."""
    numbers: tuple[Tensor, ...] = torch.arange(n).split(batch)
    return numbers


def float_batches(samples: Array, picks: tuple[Tensor, ...]) -> Iterator[Tensor]:
    """The picked sweeps of `samples` as float32, a batch at a time, because PyTorch hardly supports
    uint16."""
    for pick in picks:
        yield torch.from_numpy(samples[pick.numpy()].astype(np.float32))


def train_network(
    sweeps: Dataset,
    inputs: Array,
    seed: int,
    *,
    build: Build,
    recipe: TrainingRecipe,
    calibrated: bool,
    bfloat16: bool,
    log: Log,
    int8: Sequence[str] = (),
    unfinished: Path | None = None,
) -> NetworkModel:
    """A network of `build`, trained on the materials that occur in `inputs`, the raw counts [N, T,
    R, C] of `sweeps`.

    A material that does not occur gets a logit that no sweep can raise. calibrated: hold some
    groups out for the temperature; else train on all, with temperature 1. int8: kinds of nodes that
    are in int8 in the precision "int8"; without any that precision is left out. unfinished: as in
    `learn`. Raises FormatError if only one material occurs.
    """
    known = replace(sweeps, samples=inputs).select(())
    train, held_out = hold_out_or_all(known, seed)[:2] if calibrated else (known, known)
    with deterministic_device(seed) as device:
        half = bfloat16 and (
            device == "cuda" or bool(torch.cpu.get_capabilities().get("avx512_bf16"))
        )
        network = build(train.format, len(train.materials), train.samples)
        network, cost = learn(
            network, train, recipe, seed, log, device, half, unfinished=unfinished
        )
        trained = NetworkModel(network, describe_run(recipe, device, half, bfloat16), cost)
    temperature = (
        platt_temperature(trained.logits(held_out.samples), held_out.labels) if calibrated else 1.0
    )
    network.expand_head(np.unique(sweeps.labels), len(sweeps.materials), temperature)
    return replace(
        trained,
        precisions={"int8": GraphModel(quantize(network.graph(), train.samples, int8))}
        if int8
        else {},
    )


def network_method(
    name: str,
    about: str,
    build: Build,
    recipe: TrainingRecipe,
    log: Log,
    *,
    calibrated: bool = True,
    bfloat16: bool = False,
    int8: Sequence[str] = (),
    unfinished: Path | None = None,
) -> Method:
    """The Method of this name that trains the networks of `build`; see train_network."""
    train = partial(
        train_network,
        build=build,
        recipe=recipe,
        calibrated=calibrated,
        bfloat16=bfloat16,
        log=log,
        int8=int8,
        unfinished=unfinished,
    )
    return Method(
        name, about, "raw", train, effort=f"{recipe.steps} iterations{', bfloat16' * bfloat16}"
    )


def describe_run(recipe: TrainingRecipe, device: str, half: bool, wanted: bool) -> str:
    """A description of the computation. half: in bfloat16; wanted: whether that was asked for."""
    precision = "bfloat16" if half else "float32 (no bfloat16 here)" if wanted else "float32"
    return f"{recipe.steps} iterations of {recipe.batch} in {precision} on {device}"


def scale_steps(recipe: Recipe, effort: Effort) -> Recipe:
    """`recipe` with the iterations of `effort`."""
    return replace(recipe, steps=max(round(recipe.steps * effort.share), MIN_STEPS))
