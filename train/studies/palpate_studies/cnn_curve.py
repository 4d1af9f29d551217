"""The study `cnn-curve`: accuracy of the paper's CNN over iterations, at new positions and with the
contact a row off.

It writes the curve into a file, with the newest answers, which the study `paper` takes up. The
whole training takes an hour of one core. A small one compares simulated worlds: a quarter of the
filters and neurons, one second of each sweep, 600 iterations at ten times the learning rate. An
interrupted training goes on from the file and from a checkpoint beside it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.metrics import log_loss

from palpate.core.errors import FormatError
from palpate.core.storage import put
from palpate.inference.classifier import softmax
from palpate.sim import skin
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from palpate_train.metrics import score
from palpate_train.models.networks import Network
from palpate_train.models.peers import paper_cnn
from palpate_train.models.peers.paper_cnn import PAPER_RECIPE, ImageLayers
from palpate_train.models.training import (
    TrainingRecipe,
    batches,
    deterministic_device,
    float_batches,
    learn,
)

Array = NDArray[Any]
PRINTED = {"left": 0.923, "new": 0.923, "hard": 0.917}
"""Figs. 5, 7 and 10: leave one position out, twice, and T-HARD."""
TESTED = {"left": "position left out", "new": "new positions", "hard": "T-HARD"}
APART = 1000
"""The set "new" is T-REAL of the seed + APART. It is like the position that was left out, with more
sweeps."""
ATTACHMENTS = 36
FIRST_MARK = 25
EACH = {"train": 10, "new": 3, "hard": 3}
"""Sweeps of each material at each position; those of the position left out are as many as those of
"train"."""


@dataclass(frozen=True)
class Size:
    """A size of the paper's CNN. window: frames of each sweep that it uses."""

    layers: ImageLayers
    window: int
    recipe: TrainingRecipe


SIZES = {
    "small": Size(
        replace(paper_cnn.PAPER, channels=(8, 16), dense=256),
        750,
        replace(PAPER_RECIPE, steps=600, peak_rate=1e-3),
    ),
    "whole": Size(paper_cnn.PAPER, 1500, replace(PAPER_RECIPE, steps=paper_cnn.PAPER_STEPS)),
}


def draw(
    seed: int, world: skin.World, window: int, each: dict[str, int], left: int | None = None
) -> dict[str, Dataset]:
    """The sets "train", "new" and "hard" of a simulated world, the first `window` frames of each
    sweep. left: number of a position of "train" that becomes the set "left"."""
    hard = range(ATTACHMENTS * (seed - 1) + 1, ATTACHMENTS * seed + 1)
    named: dict[str, list[tuple[skin.SetName, int]]] = {
        "train": [("T-REAL", seed)],
        "new": [("T-REAL", seed + APART)],
        "hard": [("T-HARD", number) for number in hard],
    }
    drawn = {}
    for key, those in named.items():
        parts = []
        for name, number in those:
            samples, labels, position = skin.sweep_set(name, number, each[key], world)
            groups = {"position": position}
            parts.append(
                Dataset(
                    samples[:, :window], labels, skin.MATERIALS, skin.FORMAT.rate_hz, groups, name
                )
            )
        drawn[key] = sets.join(parts)
    if left is not None:
        out = drawn["train"].group("position") == left
        if not out.any():
            last = int(drawn["train"].group("position").max())
            raise FormatError(f"position {left} of T-REAL is unknown; use 0 to {last}")
        drawn |= {"left": drawn["train"].take(out), "train": drawn["train"].take(~out)}
    return drawn


def follow(
    out: Path,
    size: str,
    seed: int,
    centred: bool = False,
    world: skin.World = skin.WORLD,
    steps: int | None = None,
    log: Callable[[str], None] = lambda line: None,
    each: dict[str, int] | None = None,
    left: int | None = None,
) -> dict[str, Any]:
    """Train, and write a point of the curve into `out` at each of `marks`; the content of the file
    at the end.

    centred: a first layer subtracts each taxel's mean. left: see draw. Computed in bfloat16 if the
    processor can. Raises OSError if `out` cannot be written, FormatError if `left` is no position.
    """
    form, each = SIZES[size], each or EACH
    about = [size, seed, centred, repr(world), steps, each, left]
    recipe = replace(form.recipe, steps=form.recipe.steps if steps is None else steps)
    unfinished, result = out.with_suffix(".pt"), _kept(out, about)
    if result is None:
        unfinished.unlink(missing_ok=True)  # of another training
        start: dict[str, Any] = {
            "about": about,
            "world": next((name for name, one in skin.WORLDS.items() if one == world), "other"),
            "left": left,
            "printed": PRINTED,
            "steps": recipe.steps,
            "points": [],
        }
        result = start | score.provenance()
        _write(out, result)
    if any(point["step"] == recipe.steps for point in result["points"]):
        return result
    given, at = draw(seed, world, form.window, each, left), set(marks(recipe.steps))

    def watch(step: int, network: Network) -> None:
        if step in at:
            logits = {name: _logits(network, sweeps.samples) for name, sweeps in given.items()}
            earlier = [point for point in result["points"] if point["step"] < step]
            result["points"] = [*earlier, {"step": step} | _point(logits, given)]
            tested = [name for name in given if name in TESTED]
            result["newest"] = {name: _given(logits[name], given[name]) for name in tested}
            _write(out, result)

    with deterministic_device(seed) as device:
        half = device == "cuda" or bool(torch.cpu.get_capabilities().get("avx512_bf16"))
        build, train = (
            paper_cnn.build_centred if centred else paper_cnn.build_paper_cnn,
            given["train"],
        )
        network = build(train.format, len(train.materials), train.samples, form.layers)
        learn(network, train, recipe, seed, log, device, half, unfinished=unfinished, watch=watch)
    unfinished.unlink(missing_ok=True)
    return result


def marks(steps: int) -> list[int]:
    """Iterations at which accuracy is measured: FIRST_MARK, its doubles, and the last iteration."""
    doubled = [FIRST_MARK * 2**i for i in range(20)]
    return [*(mark for mark in doubled if mark < steps), steps]


def _kept(out: Path, about: Sequence[Any]) -> dict[str, Any] | None:
    """The file of an earlier run of the same training, or None."""
    try:
        kept: dict[str, Any] = json.loads(out.read_text())
    except (OSError, ValueError):
        return None
    return kept if kept.get("about") == json.loads(json.dumps(about)) else None


def _write(out: Path, result: dict[str, Any]) -> None:
    put(out, (json.dumps(result) + "\n").encode(), parents=True)


@torch.no_grad()
def _logits(network: Network, samples: Array) -> Array:
    """Logits float32 [n, K]; the network trains on afterwards."""
    device = next(network.parameters()).device
    network.eval()
    numbers = batches(len(samples), 32)
    logits = [network(x.to(device)).cpu().numpy() for x in float_batches(samples, numbers)]
    network.train()
    return np.concatenate(logits)


def _given(logits: Array, sweeps: Dataset) -> dict[str, Any]:
    """The network's logits for each sweep, as JSON."""
    return {
        "labels": sweeps.labels.tolist(),
        "position": sweeps.group("position").tolist(),
        "logits": logits.astype(float).round(4).tolist(),
    }


def _point(logits: dict[str, Array], given: dict[str, Dataset]) -> dict[str, Any]:
    """Accuracy on each set with its 95 % interval over positions; the confusion matrices of the
    test sets, and the cross entropy of the training set."""
    point: dict[str, Any] = {
        "cost": round(float(log_loss(given["train"].labels, softmax(logits["train"]))), 6)
    }
    for name, sweeps in given.items():
        right = logits[name].argmax(1) == sweeps.labels
        ends = score.interval(right, sweeps.group("position"))
        point[name] = [round(float(value), 4) for value in (right.mean(), *ends)]
        if name != "train":
            point[f"{name} confusion"] = score.confusion(sweeps.labels, logits[name]).tolist()
    return point


def table(result: dict[str, Any]) -> str:
    """A line for each point, for a person."""
    size, seed, centred = result["about"][:3]
    tested = [name for name in TESTED if name in result["points"][-1]]
    heads = "".join(f"{TESTED[name]:<24} " for name in tested)
    lines = [
        f"{size}{', means removed' * centred}, seed {seed}; "
        f"printed {PRINTED['new']} and {PRINTED['hard']}",
        f"{'iteration':>9}  {'training':<9} {heads}".rstrip(),
    ]
    for point in result["points"]:
        shares = "".join(
            f"{'{:.3f} [{:.3f}, {:.3f}]'.format(*point[name]):<24} " for name in tested
        )
        lines.append(f"{point['step']:>9}  {point['train'][0]:<9.3f} {shares}".rstrip())
    return "\n".join(lines)
