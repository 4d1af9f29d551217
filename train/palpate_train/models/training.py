"""Training of networks: from a Network, a Dataset and a TrainingRecipe to a trained network and its
cost curve.

Sweeps are drawn and augmented with a generator of their own. `learn` draws dropout from PyTorch's
global generator, which the caller seeds and forks; no other random state is read or changed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor
from torch.optim import lr_scheduler
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from palpate_train.data.progress import spoken
from palpate_train.data.run import Log, no_log
from palpate_train.data.sets import Dataset
from palpate_train.models.checkpoint import Checkpoint, Stateful, default_generators
from palpate_train.models.methods import Cost
from palpate_train.models.networks import Network

Array = NDArray[Any]
Net = TypeVar("Net", bound=Network)
Augment = Callable[[Tensor, Generator], Tensor]


@dataclass(frozen=True)
class TrainingRecipe:
    """The training of a network: AdamW (Adam if `weight_decay` is 0) on batches drawn from shuffled
    rounds.

    cycle: the learning rate rises to `peak_rate` and falls again; else it is constant. ema: share
    of its old value that the moving average of the weights keeps in each step. dropout: of the
    features before the head.
    """

    steps: int = 800
    batch: int = 48
    peak_rate: float = 3e-3
    weight_decay: float = 0.05
    smoothing: float = 0.1
    ema: float = 0.98
    dropout: float = 0.3
    cycle: bool = True


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


def learn(
    model: Net,
    sweeps: Dataset,
    recipe: TrainingRecipe,
    seed: int,
    log: Log = no_log,
    *,
    device: str = "cpu",
    augment: Augment,
    unfinished: Path | None = None,
) -> tuple[Net, Cost]:
    """Train by gradient descent. Returns the moving average of the weights, ready for inference on
    the processor, and the cost of each step.

    augment: changes sweeps [B, R * C, T], drawn anew in each step. Dropout is drawn from PyTorch's
    global generator: the caller seeds and forks it. unfinished: a file that keeps the training from
    time to time, and from which it goes on with the same bits.
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
        x = augment(model.prepare(counts), rng).to(device)
        optimizer.zero_grad()
        cost.append((step, model.backward(x, labels[pick].to(device), recipe.smoothing)))
        optimizer.step()
        schedule.step()
        average.update_parameters(model)
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


def batches(n: int, batch: int = 128) -> tuple[Tensor, ...]:
    """The numbers of n sweeps in order, a batch at a time."""
    numbers: tuple[Tensor, ...] = torch.arange(n).split(batch)
    return numbers


def float_batches(samples: Array, picks: tuple[Tensor, ...]) -> Iterator[Tensor]:
    """The picked sweeps of `samples` as float32, a batch at a time, because PyTorch hardly supports
    uint16."""
    for pick in picks:
        yield torch.from_numpy(samples[pick.numpy()].astype(np.float32))
