"""The room of training. In: a SweepSet and a seed. Out: a Fit, which holds the network and the sweeps it saw.

The convolutions are trained by gradient; then the head is replaced by shrinkage LDA in closed form, and one
temperature, found on groups that were held out, makes its probabilities honest. No random state outside is read or
changed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from torch import Generator, Tensor
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from appliance.errors import FormatError
from appliance.sim.score import wilson
from appliance.sim.sets import read

from .networks import Compact
from .sets import SweepSet

Array = NDArray[Any]
HELD_OUT = 0.2
"""Share of the groups that training does not see: they give the temperature and the figures of validation."""
TEMPERATURES = np.geomspace(1, 100, 200)
"""From the LDA's own posteriors, which are never too modest, to hardly sure of anything."""


@dataclass(frozen=True)
class Recipe:
    """How the convolutions are trained. noise and gain: standard deviations, of a scaled taxel and of its factor.

    row_shift: share of sweeps moved by one row of taxels. stretch: largest change of speed. Both are drawn per sweep.
    keep_means: see networks.Compact; the convolutions never see them, the closed-form head does.
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
    row_shift: float = 0.0
    stretch: float = 0.0
    keep_means: bool = False


@dataclass(frozen=True)
class Fit:
    """A trained network. weights: the state of a fused Compact with its LDA head, the temperature folded in.

    train, held: what was trained on and what was held out. about: JSON of how it was made and how it did.
    """

    weights: dict[str, Array]
    scale: float
    train: SweepSet
    held: SweepSet
    about: dict[str, Any]

    @property
    def keep_means(self) -> bool:
        """Whether the head sees the means of the taxels."""
        return bool(self.about["recipe"]["keep_means"])

    def network(self) -> Compact:
        """The network in PyTorch, ready to run."""
        model = Compact(self.train.format, len(self.train.materials), self.scale, False, self.keep_means)
        model.load_state_dict({k: torch.from_numpy(v) for k, v in self.weights.items()})
        return model.eval()

    def save(self, path: Path) -> None:
        """Write the fit as one .npz without pickle; training and held-out sweeps are one set with a mark."""
        both = {
            f"set_{k}": np.concatenate([getattr(self.train, k), getattr(self.held, k)]) for k in ("samples", "labels")
        }
        arrays = {f"weight_{k}": v for k, v in self.weights.items()} | both
        for name in self.train.groups:
            arrays[f"group_{name}"] = np.concatenate([self.train.groups[name], self.held.groups[name]])
        meta = {"scale": self.scale, "materials": self.train.materials, "rate_hz": self.train.rate_hz,
                "source": self.train.source, "trained_on": len(self.train), "about": self.about}  # fmt: skip
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as f:
            np.savez_compressed(f, meta=np.array(json.dumps(meta)), **arrays)

    @classmethod
    def load(cls, path: Path) -> Fit:
        """Read what `save` wrote. Raises FormatError where it is something else."""
        what = "a fit (made by palpate-train fit)"
        held = read(path, what)
        try:
            meta = json.loads(str(held["meta"]))
            weights, groups = (
                {k.removeprefix(p): v for k, v in held.items() if k.startswith(p)} for p in ("weight_", "group_")
            )
            samples, labels, materials = held["set_samples"], held["set_labels"], tuple(meta["materials"])
            whole = SweepSet(samples, labels, materials, meta["rate_hz"], groups, meta["source"])
            first = np.arange(len(whole)) < meta["trained_on"]
            return cls(weights, meta["scale"], whole.take(first), whole.take(~first), meta["about"])
        except (KeyError, ValueError, TypeError) as e:
            raise FormatError(f"{path.name}: not {what}: {e}") from e


def fit(sweeps: SweepSet, seed: int, recipe: Recipe, log: Callable[[str], None] = lambda line: None) -> Fit:
    """Train on `sweeps`, less those held out: by position where there are several, else by recording.

    Raises FormatError where the set has too few groups or too short windows.
    """
    by = "position" if len(np.unique(sweeps.groups.get("position", 0))) > 1 else "recording"
    train, held = sweeps.split(by, 1 - HELD_OUT, seed)
    deviation = train.samples - train.samples.mean(axis=1, keepdims=True, dtype=np.float32)
    scale = float(1 / max(np.sqrt(np.mean(deviation**2)), 1e-6))
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = _train(Compact(train.format, len(train.materials), scale), train, recipe, seed, log)
        model.keep_means = recipe.keep_means
        seen, unseen = features(model, train), features(model, held)
    weight, bias = closed_form_head(seen, train.labels, unseen, held.labels)
    weights = {k: v.numpy() for k, v in model.state_dict().items()} | {"head.weight": weight, "head.bias": bias}
    right = int(np.sum((unseen @ weight.T + bias).argmax(1) == held.labels))
    about = {"seed": seed, "recipe": asdict(recipe), "held_out_by": by, "validation": figure(right, len(held))}
    return Fit(weights, scale, train, held, about)


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


@torch.no_grad()
def features(model: Compact, sweeps: SweepSet) -> Array:
    """What the head sees of each sweep, float32 [N, F]."""
    return np.concatenate([model.seen(x).numpy() for x in _tensors(sweeps, _in_order(len(sweeps)))])


def closed_form_head(seen: Array, labels: Array, held: Array, held_labels: Array) -> tuple[Array, Array]:
    """Weight [K, F] and bias [K], float32, of shrinkage LDA on the features `seen` [N, F], as sure as `held` allows."""
    lda = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(seen, labels)
    weight, bias = lda.coef_, lda.intercept_
    if len(weight) == 1:  # of two classes it gives only the difference
        weight, bias = np.vstack([0 * weight, weight]), np.append(0, bias)
    cooler = temperature(held @ weight.T + bias, held_labels)
    return (weight / cooler).astype(np.float32), (bias / cooler).astype(np.float32)


def temperature(logits: Array, labels: Array) -> float:
    """The divisor of `logits` [N, K] with the best likelihood, each label believed to (N + 1) / (N + 2) as Platt does.

    Without that doubt a few held-out sweeps, all right, would allow any certainty.
    """
    doubt = 1 / (len(labels) + 2)
    costs = []
    for t in TEMPERATURES:
        z = logits / t
        z = z - z.max(axis=1, keepdims=True)
        log_p = z - np.log(np.exp(z).sum(axis=1, keepdims=True))
        costs.append(-np.mean((1 - doubt) * log_p[np.arange(len(labels)), labels] + doubt * log_p.mean(axis=1)))
    return float(TEMPERATURES[np.argmin(costs)])


def figure(right: int, n: int) -> dict[str, Any]:
    """An accuracy with n and its 95 % Wilson interval."""
    low, high = wilson(right, n)
    return {"accuracy": round(right / n, 4), "n": n, "low": round(low, 4), "high": round(high, 4)}


def augment(x: Tensor, rows: int, recipe: Recipe, rng: Generator) -> Tensor:
    """Sweeps [B, R * C, T] as another attachment, speed and readout would have given them."""
    if recipe.row_shift:
        grid = x.unflatten(1, (rows, -1))
        moved = torch.rand(len(x), 1, generator=rng) < recipe.row_shift
        source = torch.arange(rows) + moved * (2 * torch.randint(0, 2, (len(x), 1), generator=rng) - 1)
        # nobody knows what lies under the row that comes in: as much as its neighbour feels, nothing, or between
        level = torch.where((source < 0) | (source >= rows), torch.rand(len(x), 1, generator=rng), 1.0)
        x = (grid[torch.arange(len(x))[:, None], source.clamp(0, rows - 1)] * level[..., None, None]).flatten(1, 2)
    if recipe.stretch:
        last = x.shape[2] - 1
        speed = 1 + recipe.stretch * (2 * torch.rand(len(x), 1, generator=rng) - 1)
        at = last - (last - torch.arange(last + 1) * speed).abs()  # past its end a sweep runs back
        left = at.floor().clamp(0, last - 1)
        take = left.long()[:, None].expand_as(x)
        x = torch.lerp(x.gather(2, take), x.gather(2, take + 1), (at - left)[:, None])
    gain = 1 + recipe.gain * torch.randn(x.shape[:2], generator=rng)[..., None]
    return x * gain + recipe.noise * torch.randn(x.shape, generator=rng)


def _train(model: Compact, sweeps: SweepSet, recipe: Recipe, seed: int, log: Callable[[str], None]) -> Compact:
    """Gradient training; gives the moving average of the weights, batch norms folded in."""
    rng, n = torch.Generator().manual_seed(seed), len(sweeps)
    rounds = -(-recipe.steps * recipe.batch // n)
    order = torch.cat([torch.randperm(n, generator=rng) for _ in range(rounds)])[: recipe.steps * recipe.batch]
    optimizer = torch.optim.AdamW(model.parameters(), recipe.peak_rate, weight_decay=recipe.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, recipe.peak_rate, total_steps=recipe.steps)
    average = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(recipe.ema), use_buffers=True)
    labels = torch.from_numpy(sweeps.labels.astype(np.int64))
    picks = order.split(recipe.batch)
    model.train()
    for step, (pick, digits) in enumerate(zip(picks, _tensors(sweeps, picks), strict=True), 1):
        seen = model.features(augment(model.prepare(digits), model.form.rows, recipe, rng))
        logits = model.head(functional.dropout(seen, recipe.dropout))
        loss = functional.cross_entropy(logits, labels[pick], label_smoothing=recipe.smoothing)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        average.update_parameters(model)
        log(f"step {step}/{recipe.steps} loss {loss.item():.3f}")
    trained: Compact = average.module
    return trained.fused()


def _in_order(n: int) -> tuple[Tensor, ...]:
    return torch.arange(n).split(128)


def _tensors(sweeps: SweepSet, picks: tuple[Tensor, ...]) -> Iterator[Tensor]:
    """The picked sweeps as float32, a batch at a time; PyTorch knows too little of uint16."""
    for pick in picks:
        yield torch.from_numpy(sweeps.samples[pick.numpy()].astype(np.float32))
