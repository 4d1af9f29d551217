"""The room of training. In: a Dataset and a seed. Out: a Fit, which holds the network and the sweeps it saw.

The convolutions are trained by gradient on sweeps that vary as the scene does; then shrinkage LDA in closed form
replaces the head, one for the network and one for its int8 trunk. Groups that were held out tell how many stages the
heads should see, and give one temperature that makes probabilities honest. No random state outside is read or changed.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from appliance.core.errors import FormatError
from appliance.core.sweep_set import read
from appliance.core.types import SweepFormat
from appliance.inference.classifier import LEAST_PROBABILITY, softmax
from train.data.sets import Dataset
from train.metrics.score import figure
from train.models import training
from train.models.compact import graph, spectrum
from train.models.compact.architectures import DEFAULT, Architecture
from train.models.compact.augment import SLOW, Augmentation, vary
from train.models.compact.network import Compact
from train.models.linear_head import closed_form_head, hold_out
from train.models.networks import Network, texture_scale
from train.models.training import Cost, Log, Vary, in_order, learn, one_thread, silent, tensors
from train.onnx_tools.graph_builder import run

Array = NDArray[Any]
Seen = tuple[tuple[Array, Array], ...]
COPIES = 2
"""Of the training sweeps, changed as in training, that the closed-form head sees beside them."""


@dataclass(frozen=True)
class FitRecipe(training.TrainingRecipe):
    """How the compact network is trained.

    scene: what varies, and so do the training sweeps; gain and noise are its matter. None: `usual`.
    keep_means: see Compact; the convolutions never see them, the closed-form head does.
    """

    steps: int = 600
    noise: float = 0.0
    gain: float = 0.0
    scene: Augmentation | None = None
    keep_means: bool = False


@dataclass(frozen=True)
class Fit:
    """A trained network. weights: the state of a fused Compact with its LDA head, the temperature folded in; and one
    more, `int8.weight` [K, F] and `int8.bias` [K], fitted on what the int8 trunk gives.

    shape: its rung, cut to what the heads see. reach: what its int8 form reaches. train, held: what was trained on and
    what was held out. about: JSON of how it was made and how it did. cost: (step, cross entropy) of the training; the
    file does not keep it.
    """

    weights: dict[str, Array]
    scale: float
    shape: Architecture
    reach: graph.Ranges
    train: Dataset
    held: Dataset
    about: dict[str, Any]
    cost: Cost = field(default_factory=list)

    @property
    def keep_means(self) -> bool:
        """Whether the head sees the means of the taxels."""
        return bool(self.about["recipe"]["keep_means"])

    @property
    def bands(self) -> int:
        """How many of the features, the last ones, are of the spectrum and were not learnt."""
        return self.shape.spectrum * spectrum.count(self.train.format)

    def network(self) -> Compact:
        """The network in PyTorch, ready to run."""
        with torch.random.fork_rng(devices=[]):  # its first weights are drawn, and written over
            form, classes = self.train.format, len(self.train.materials)
            model = Compact(form, classes, self.scale, False, self.keep_means, self.shape)
        state = {k: torch.from_numpy(v) for k, v in self.weights.items() if not k.startswith("int8.")}
        model.load_state_dict(state)
        return model.eval()

    def trunk(self, int8: bool = True, tenths: bool = False) -> onnx.ModelProto:
        """`sweep` -> `features` float32 [1, F], or `tenths` float32 [1, 10, F]; see exact.trunk."""
        reach, form = self.reach if int8 else None, self.train.format
        return graph.trunk(form, self.scale, self.weights, self.shape, reach, tenths, self.keep_means)

    def int8_head(self) -> tuple[Array, Array]:
        """Weight [K, F] and bias [K] of the int8 trunk's head, the temperature folded in."""
        return self.weights["int8.weight"], self.weights["int8.bias"]

    def save(self, path: Path) -> None:
        """Write the fit as one .npz without pickle; training and held-out sweeps are one set with a mark."""
        both = {
            f"set_{k}": np.concatenate([getattr(self.train, k), getattr(self.held, k)]) for k in ("samples", "labels")
        }
        arrays = {f"weight_{k}": v for k, v in self.weights.items()} | both
        for name in self.train.groups:
            arrays[f"group_{name}"] = np.concatenate([self.train.groups[name], self.held.groups[name]])
        meta = {"scale": self.scale, "shape": asdict(self.shape), "reach": asdict(self.reach),
                "materials": self.train.materials, "rate_hz": self.train.rate_hz,
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
            whole = Dataset(samples, labels, materials, meta["rate_hz"], groups, meta["source"])
            first = np.arange(len(whole)) < meta["trained_on"]
            shape = Architecture(**meta["shape"] | {"channels": tuple(meta["shape"]["channels"])})
            reach = graph.Ranges(meta["reach"]["digits"], tuple(meta["reach"]["responses"]))
            made = cls(weights, meta["scale"], shape, reach, whole.take(first), whole.take(~first), meta["about"])
        except (KeyError, ValueError, TypeError) as e:
            raise FormatError(f"{path.name}: not {what}, or of another version; fit again: {e}") from e
        try:
            made.network()
        except RuntimeError as e:
            raise FormatError(f"{path.name}: its weights are not those of its {shape}; fit again") from e
        return made


def fit(sweeps: Dataset, seed: int, recipe: FitRecipe, log: Log = silent, shape: Architecture = DEFAULT) -> Fit:
    """Train on `sweeps`, less those that `hold_out` takes. Raises FormatError as it, and for windows too short."""
    return fit_on(*hold_out(sweeps, seed), seed, recipe, log, shape)


def fit_on(
    train: Dataset,
    held: Dataset,
    by: str,
    seed: int,
    recipe: FitRecipe,
    log: Log = silent,
    shape: Architecture = DEFAULT,
) -> Fit:
    """Train on `train`; `held` gives temperature and validation. by: how they were parted, for the story."""
    if not (shape.channels or spectrum.count(train.format)):
        raise FormatError(f"a window of {train.format.window} frames is too short for a spectrum; take another rung")
    recipe = replace(recipe, scene=(scene := recipe.scene or usual(train.format, shape)))
    scale, change = texture_scale(train.samples), partial(varied, rows=train.format.rows, scene=scene)
    with one_thread(), torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        model = Compact(train.format, len(train.materials), scale, shape=shape)
        with torch.enable_grad():
            model, cost = learn(model, train, recipe, seed, log, vary=change) if shape.channels else (model.fused(), [])
        model.keep_means, model.shape = recipe.keep_means, replace(shape, spectrum=spectrum.count(train.format) > 0)
        reach = model.reach(train.samples)
        seen = _seen(model, reach, train, held, copies(model, train, change, seed))
        model, weights = _judged(model, seen, np.tile(train.labels, COPIES + 1), held.labels)
        logits = features(model, held) @ weights["head.weight"].T + weights["head.bias"]
    right = int(np.sum(logits.argmax(1) == held.labels))
    about = {"seed": seed, "recipe": asdict(recipe), "held_out_by": by, "validation": figure(right, len(held))}
    reach = replace(reach, responses=reach.responses[: len(model.convs)])
    return Fit(weights, scale, model.shape, reach, train, held, about, cost)


def _seen(model: Compact, reach: graph.Ranges, train: Dataset, held: Dataset, more: Iterable[Dataset]) -> Seen:
    """What the heads see of the training sweeps with their copies, and of those held out: (float, int8)."""
    trunk = graph.trunk(model.form, model.scale, model.weights(), model.shape, reach, keep_means=model.keep_means)
    asked = (partial(features, model), lambda sweeps: run(trunk, sweeps.samples))
    rows = [[ask(sweeps) for ask in asked] for sweeps in chain([train], more)]
    return tuple(
        (np.concatenate(of_all), ask(held)) for of_all, ask in zip(zip(*rows, strict=True), asked, strict=True)
    )


def _judged(model: Compact, seen: Seen, labels: Array, held_labels: Array) -> tuple[Compact, dict[str, Array]]:
    """The network behind the heads, and all weights of a Fit.

    The heads see the first stages, with the spectrum or without, whichever names the held-out sweeps with the least
    surprise; of equal ones the least. What comes after is cut off. Later stages know the training sweeps too well, and
    a head that was found on these trusts them too much.
    """
    size, whole = sum(model.shape.channels), seen[1][0].shape[1]
    bands = model.shape.spectrum * spectrum.count(model.form)
    surprise = []
    depths = range(min(model.shape.fewest, len(model.convs)), len(model.convs) + 1)
    for depth, with_bands in product(depths, (True, False) if bands else (False,)):
        if not depth and not with_bands:
            continue
        columns = np.r_[: sum(model.shape.channels[:depth]), size : whole - bands * (not with_bands)]
        heads = [closed_form_head(x[:, columns], labels, y[:, columns], held_labels) for x, y in seen]
        weight, bias = heads[1]
        p = softmax(seen[1][1][:, columns] @ weight.T + bias)[np.arange(len(held_labels)), held_labels]
        surprise.append((-np.log(np.maximum(p, LEAST_PROBABILITY)).mean(), depth, with_bands, heads))
    _, depth, with_bands, heads = min(surprise, key=lambda one: one[0])
    model = model.cut(depth, with_bands)
    named = {  # what all materials have in common changes no probability, and takes digits from float32
        f"{name}.{k}": v - v.mean(axis=0)
        for name, head in zip(("head", "int8"), heads, strict=True)
        for k, v in zip(("weight", "bias"), head, strict=True)
    }
    model.head.weight.data, model.head.bias.data = (torch.from_numpy(named[f"head.{k}"]) for k in ("weight", "bias"))
    return model, {k: v.numpy() for k, v in model.state_dict().items()} | named


def usual(form: SweepFormat, shape: Architecture) -> Augmentation:
    """What varies where nobody says it: another scene for a sensor that is too slow for kernels that sum to zero."""
    return Augmentation() if shape.zero_sum(form.window) else SLOW


def varied(x: Tensor, rng: Generator, rows: int, scene: Augmentation) -> Tensor:
    """augment.vary, as the loop calls it."""
    return vary(x, rows, scene, rng)


def copies(model: Compact, sweeps: Dataset, change: Vary, seed: int) -> Iterator[Dataset]:
    """The sweeps again COPIES times as the scene might have given them: the head must know how materials vary, too."""
    rng, kind = torch.Generator().manual_seed(seed), sweeps.samples.dtype
    for _ in range(COPIES):
        changed = np.empty_like(sweeps.samples)
        picks = in_order(len(sweeps))
        for pick, digits in zip(picks, tensors(sweeps.samples, picks), strict=True):
            x = change(model.prepare(digits), rng) / model.scale
            x = x.transpose(1, 2).unflatten(2, digits.shape[2:]) + digits.mean(1, keepdim=True)
            if kind.kind != "f":
                x = x.round().clamp(np.iinfo(kind).min, np.iinfo(kind).max)
            changed[pick.numpy()] = x.numpy()
        yield replace(sweeps, samples=changed)


@torch.no_grad()
def features(model: Network, sweeps: Dataset) -> Array:
    """What the head sees of each sweep, float32 [N, F]."""
    return np.concatenate([model.seen(x).numpy() for x in tensors(sweeps.samples, in_order(len(sweeps)))])
