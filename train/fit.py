"""The room of training. In: a SweepSet and a seed. Out: a Fit, which holds the network and the sweeps it saw.

The convolutions are trained by gradient; then the head is replaced by shrinkage LDA in closed form, and one
temperature, found on groups that were held out, makes its probabilities honest. No random state outside is read or
changed.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from appliance.errors import FormatError
from appliance.sim.sets import read

from . import loop
from .compact import Compact
from .heads import closed_form_head, hold_out
from .loop import Cost, Log, in_order, learn, one_thread, silent, tensors
from .networks import Network, texture_scale
from .score import figure
from .sets import SweepSet

Array = NDArray[Any]


@dataclass(frozen=True)
class Recipe(loop.Recipe):
    """How the compact network is trained.

    row_shift: share of sweeps moved by one row of taxels. stretch: largest change of speed. Both are drawn per sweep.
    keep_means: see Compact; the convolutions never see them, the closed-form head does.
    """

    row_shift: float = 0.0
    stretch: float = 0.0
    keep_means: bool = False


@dataclass(frozen=True)
class Fit:
    """A trained network. weights: the state of a fused Compact with its LDA head, the temperature folded in.

    train, held: what was trained on and what was held out. about: JSON of how it was made and how it did.
    cost: (step, cross entropy) of the training; the file does not keep it.
    """

    weights: dict[str, Array]
    scale: float
    train: SweepSet
    held: SweepSet
    about: dict[str, Any]
    cost: Cost = field(default_factory=list)

    @property
    def keep_means(self) -> bool:
        """Whether the head sees the means of the taxels."""
        return bool(self.about["recipe"]["keep_means"])

    def network(self) -> Compact:
        """The network in PyTorch, ready to run."""
        with torch.random.fork_rng(devices=[]):  # its first weights are drawn, and written over
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


def fit(sweeps: SweepSet, seed: int, recipe: Recipe, log: Log = silent) -> Fit:
    """Train on `sweeps`, less those that `hold_out` takes. Raises FormatError as it, and for windows too short."""
    return fit_on(*hold_out(sweeps, seed), seed, recipe, log)


def fit_on(train: SweepSet, held: SweepSet, by: str, seed: int, recipe: Recipe, log: Log = silent) -> Fit:
    """Train on `train`; `held` gives temperature and validation. by: how they were parted, for the story."""
    scale = texture_scale(train.samples)
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model, cost = learn(
            Compact(train.format, len(train.materials), scale),
            train,
            recipe,
            seed,
            log,
            vary=partial(vary, rows=train.format.rows, recipe=recipe),
        )
        model.keep_means = recipe.keep_means
        seen, unseen = features(model, train), features(model, held)
    weight, bias = closed_form_head(seen, train.labels, unseen, held.labels)
    weights = {k: v.numpy() for k, v in model.state_dict().items()} | {"head.weight": weight, "head.bias": bias}
    right = int(np.sum((unseen @ weight.T + bias).argmax(1) == held.labels))
    about = {"seed": seed, "recipe": asdict(recipe), "held_out_by": by, "validation": figure(right, len(held))}
    return Fit(weights, scale, train, held, about, cost)


def vary(x: Tensor, rng: Generator, rows: int, recipe: Recipe) -> Tensor:
    """Sweeps [B, R * C, T] as another attachment and speed would have given them."""
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
    return x


@torch.no_grad()
def features(model: Network, sweeps: SweepSet) -> Array:
    """What the head sees of each sweep, float32 [N, F]."""
    return np.concatenate([model.seen(x).numpy() for x in tensors(sweeps.samples, in_order(len(sweeps)))])
