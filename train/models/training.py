"""The room of the training loop, one for all networks. In: a Network, a Dataset, a TrainingRecipe. Out: it trained, the cost.

Sweeps are drawn and augmented with a generator of their own; no random state outside is read or changed as long as the
caller forks PyTorch's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from train.data.sets import Dataset
from train.models.networks import Network

Array = NDArray[Any]
Log = Callable[[str], None]
Cost = list[tuple[int, float]]
"""(iteration, cross entropy of its batch), eq. 11: what the paper's Fig. 9 shows."""
Net = TypeVar("Net", bound=Network)
Vary = Callable[[Tensor, Generator], Tensor]


@dataclass(frozen=True)
class TrainingRecipe:
    """How a network is trained: AdamW (Adam where `weight_decay` is 0) on batches drawn from shuffled rounds.

    cycle: the rate rises to `peak_rate` and falls again; else it stays there. ema: share that the moving average of the
    weights keeps of itself each step. dropout: of the features before the head.
    noise and gain: standard deviations, of a scaled taxel and of its factor.
    adversarial: how far each digit, scaled, also moves to where the cost grows (fast gradient sign; Goodfellow 2015).
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


def silent(line: str) -> None:
    """The log of nobody."""


def as_it_is(x: Tensor, rng: Generator) -> Tensor:
    """A scene in which nothing varies."""
    return x


@contextmanager
def one_thread() -> Iterator[None]:
    """Let PyTorch compute in one thread: the same bits whatever number of cores there are, and hardly slower.

    On a busy machine two threads wait for one another; there a fit was seen to take twenty times as long.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def unsettled(x: Tensor, recipe: TrainingRecipe, rng: Generator) -> Tensor:
    """Sweeps [B, R * C, T] with other gains and another noise."""
    if recipe.gain:
        x = x * (1 + recipe.gain * torch.randn(x.shape[:2], generator=rng)[..., None])
    return x + recipe.noise * torch.randn(x.shape, generator=rng) if recipe.noise else x


def learn(
    model: Net,
    sweeps: Dataset,
    recipe: TrainingRecipe,
    seed: int,
    log: Log = silent,
    device: str = "cpu",
    bfloat16: bool = False,
    vary: Vary = as_it_is,
) -> tuple[Net, Cost]:
    """Gradient training; gives the moving average of the weights, ready for inference on the processor, and the cost.

    vary: what the scene does to sweeps [B, R * C, T], drawn anew in each step, before gain and noise. bfloat16: multiply in it. Draws what it needs from PyTorch's own generator too: seed and fork that outside.
    """
    rng, n = torch.Generator().manual_seed(seed), len(sweeps)
    rounds = -(-recipe.steps * recipe.batch // n)
    order = torch.cat([torch.randperm(n, generator=rng) for _ in range(rounds)])[: recipe.steps * recipe.batch]
    model = model.to(device)
    optimizer = torch.optim.AdamW(model.parameters(), recipe.peak_rate, weight_decay=recipe.weight_decay)
    rates = torch.optim.lr_scheduler
    schedule = (
        rates.OneCycleLR(optimizer, recipe.peak_rate, total_steps=recipe.steps)
        if recipe.cycle
        else rates.ConstantLR(optimizer, 1.0)
    )
    average = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(recipe.ema), use_buffers=True)
    labels = torch.from_numpy(sweeps.labels.astype(np.int64))
    picks, cost = order.split(recipe.batch), []
    model.train().dropout = recipe.dropout
    for step, (pick, digits) in enumerate(zip(picks, tensors(sweeps.samples, picks), strict=True), 1):
        x = unsettled(vary(model.prepare(digits), rng), recipe, rng).to(device)
        optimizer.zero_grad()
        with torch.autocast(device, torch.bfloat16, enabled=bfloat16):
            cost.append((step, descend(model, x, labels[pick].to(device), recipe)))
        optimizer.step()
        schedule.step()
        average.update_parameters(model)
        log(f"step {step}/{recipe.steps} loss {cost[-1][1]:.3f}")
    return average.module.cpu().fused(), cost


def descend(model: Network, x: Tensor, labels: Tensor, recipe: TrainingRecipe) -> float:
    """Leave the cost's gradients in the weights; the cost itself, of the sweeps as they are."""
    x.requires_grad_(recipe.adversarial > 0)
    loss = functional.cross_entropy(model.judge(x).float(), labels, label_smoothing=recipe.smoothing)
    loss.backward()
    if recipe.adversarial:
        worse = x.detach() + recipe.adversarial * x.grad.sign()
        functional.cross_entropy(model.judge(worse).float(), labels, label_smoothing=recipe.smoothing).backward()
    return loss.item()


def in_order(n: int, batch: int = 128) -> tuple[Tensor, ...]:
    """The numbers of n sweeps, a batch at a time."""
    return torch.arange(n).split(batch)


def tensors(samples: Array, picks: tuple[Tensor, ...]) -> Iterator[Tensor]:
    """The picked sweeps of `samples` as float32, a batch at a time; PyTorch knows too little of uint16."""
    for pick in picks:
        yield torch.from_numpy(samples[pick.numpy()].astype(np.float32))
