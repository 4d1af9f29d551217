"""Training of the compact network, and a fit of it alone.

The convolutions are trained by gradient descent on augmented sweeps. Then shrinkage LDA in closed
form replaces the head, once for the network and once for its int8 trunk. Held-out groups decide how
many stages the heads see, and the temperature. No random state outside is read or changed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

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
from train.models.recipe.architectures import DEFAULT, Architecture
from train.models.recipe.augment import (
    COPIES,
    Augmentation,
    augment,
    copies,
    default_augmentation,
    texture_scale,
)
from train.models.recipe.fitted import Fit, finished
from train.models.recipe.network import Compact
from train.models.training import Augment, batches, float_batches, learn, one_thread
from train.onnx_tools.graph_builder import run

Array = NDArray[Any]
HeadInputs = tuple[tuple[Array, Array], ...]
"""(features of the training sweeps and their copies, features of the held-out sweeps) of the float
and the int8 trunk."""


@dataclass(frozen=True)
class FitRecipe(training.TrainingRecipe):
    """The training of the compact network.

    augmentation: of the training sweeps, None for `default_augmentation`; it replaces gain and
    noise. keep_means: see Compact; the closed-form head sees the means, the convolutions never do.
    """

    steps: int = 600
    noise: float = 0.0
    gain: float = 0.0
    augmentation: Augmentation | None = None
    keep_means: bool = False

    def json(self) -> dict[str, Any]:
        """The entry `recipe` of a fit and of the manifest of its bundle."""
        fields = asdict(self)
        return fields | {"scene": fields.pop("augmentation")}


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
        model.keep_means = recipe.keep_means
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
        model.format,
        model.scale,
        model.weights(),
        model.architecture,
        ranges,
        keep_means=model.keep_means,
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
