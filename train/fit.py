"""The room of training. In: a SweepSet and a seed. Out: a Fit, which holds the network and the sweeps it saw.

The convolutions are trained by gradient; then the head is replaced by shrinkage LDA in closed form, and one
temperature, found on groups that were held out, makes its probabilities honest. No random state outside is read or
changed.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from appliance.errors import FormatError
from appliance.sim.score import wilson
from appliance.sim.sets import read

from .loop import Cost, Log, Recipe, in_order, learn, one_thread, silent, tensors
from .networks import Compact, Network
from .sets import SweepSet

Array = NDArray[Any]
HELD_OUT = 0.2
"""Share of the groups that training does not see: they give the temperature and the figures of validation."""
TEMPERATURES = np.geomspace(1, 100, 200)
"""From the LDA's own posteriors, which are never too modest, to hardly sure of anything."""


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


def hold_out(sweeps: SweepSet, seed: int) -> tuple[SweepSet, SweepSet, str]:
    """(to train on, held out, by what): whole positions where there are several and these allow it, else recordings.

    Raises FormatError where the set has too few groups, or one sweep of a material would be all that is left.
    """
    if len(np.unique(sweeps.groups.get("position", 0))) > 1:
        with suppress(FormatError):
            return _parted(sweeps, "position", seed)
    return _parted(sweeps, "recording", seed)


def _parted(sweeps: SweepSet, by: str, seed: int) -> tuple[SweepSet, SweepSet, str]:
    train, held = sweeps.split(by, 1 - HELD_OUT, seed)
    counts = np.bincount(train.labels, minlength=len(sweeps.materials))
    if 1 in counts:
        one = sweeps.materials[int(np.flatnonzero(counts == 1)[0])]
        raise FormatError(f"{sweeps.source}: split by {by!r} leaves one sweep of {one!r}; record more of it")
    return train, held, by


def fit_on(train: SweepSet, held: SweepSet, by: str, seed: int, recipe: Recipe, log: Log = silent) -> Fit:
    """Train on `train`; `held` gives temperature and validation. by: how they were parted, for the story."""
    scale = texture_scale(train.samples)
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model, cost = learn(Compact(train.format, len(train.materials), scale), train, recipe, seed, log)
        model.keep_means = recipe.keep_means
        seen, unseen = features(model, train), features(model, held)
    weight, bias = closed_form_head(seen, train.labels, unseen, held.labels)
    weights = {k: v.numpy() for k, v in model.state_dict().items()} | {"head.weight": weight, "head.bias": bias}
    right = int(np.sum((unseen @ weight.T + bias).argmax(1) == held.labels))
    about = {"seed": seed, "recipe": asdict(recipe), "held_out_by": by, "validation": figure(right, len(held))}
    return Fit(weights, scale, train, held, about, cost)


def texture_scale(samples: Array) -> float:
    """What makes digits [N, T, R, C] of deviation 1 after each taxel's mean over each sweep is taken away."""
    deviation = samples - samples.mean(axis=1, keepdims=True, dtype=np.float32)
    return float(1 / max(np.sqrt(np.mean(deviation**2)), 1e-6))


@torch.no_grad()
def features(model: Network, sweeps: SweepSet) -> Array:
    """What the head sees of each sweep, float32 [N, F]."""
    return np.concatenate([model.seen(x).numpy() for x in tensors(sweeps.samples, in_order(len(sweeps)))])


def closed_form_head(seen: Array, labels: Array, held: Array, held_labels: Array) -> tuple[Array, Array]:
    """Weight [K, F] and bias [K], float32, of shrinkage LDA on the features `seen` [N, F], as sure as `held` allows.

    Raises FormatError where there is but one sweep of each material, which says nothing of how they vary.
    """
    if len(labels) <= len(np.unique(labels)):
        raise FormatError(
            f"{len(labels)} sweeps of as many materials are too few for a linear discriminant; record more"
        )
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
