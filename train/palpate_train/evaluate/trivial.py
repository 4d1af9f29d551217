"""Trivial baselines, reported with every fit and evaluation: linear discriminants of the mean
of each taxel, and of its spread and log powers in a few bands.

A method that is not better has learnt no more than that. If means alone show the materials, the
level of the session may do so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.answer.heads import fit_discriminant
from palpate_train.data.sets import Dataset, evenly
from palpate_train.data.splitters import inner_parts
from palpate_train.data.transforms import log_powers
from palpate_train.metrics.score import accuracy_figure

Array = NDArray[Any]
Json = dict[str, Any]
MOST_TAXELS = 64
"""Largest number of taxels that are looked at, drawn evenly, all axes counted."""
DITHER = 1e-6
"""Deviation of the noise that is added to features whose deviation is 1. Without it, equal sweeps
of a material would make weights infinite."""
MEANS, BANDS = "means alone", "spread, log bands"


def features(sweeps: Dataset) -> dict[str, Array]:
    """The features [N, F] of each baseline by its name, with mean 0 and deviation 1."""
    n, frames = sweeps.samples.shape[:2]
    flat = sweeps.samples.reshape(n, frames, -1)
    some = evenly(flat.shape[2], MOST_TAXELS)
    means, spread = np.empty((n, len(some))), np.empty((n, len(some)))
    for i, sweep in enumerate(flat):  # a copy of all sweeps might not fit into memory
        means[i] = sweep[:, some].mean(axis=0, dtype=np.float64)
        spread[i] = sweep[:, some].std(axis=0, dtype=np.float64)
    logs = np.log(spread + 1e-3 * spread.mean() + np.finfo(float).tiny)
    bands = log_powers(sweeps.samples, some).reshape(n, -1)
    return {MEANS: scaled(means), BANDS: scaled(np.hstack([logs, bands]))}


def right(x: Array, labels: Array, train: Array, test: Array) -> int:
    """How many of the sweeps `test` are classified correctly by a discriminant of the features `x`
    [N, F], fitted to the sweeps `train`; 0 if these are too few. train, test: masks or numbers."""
    try:
        weight, bias = fit_discriminant(x[train], labels[train], int(labels.max()) + 1)
    except FormatError:
        return 0
    answers = (x[test] @ weight.T + bias).argmax(axis=1)
    return int((answers == labels[test]).sum())


def figures(sweeps: Dataset, folds: Sequence[tuple[Array, Array]]) -> Json:
    """The accuracy of each baseline over the `folds`, pairs (training, test) of sweep numbers or
    masks."""
    numbers, found = np.arange(len(sweeps)), {}
    total = sum(len(numbers[test]) for _, test in folds)
    for name, x in features(sweeps).items():
        count = sum(right(x, sweeps.labels, *fold) for fold in folds)
        found[name] = accuracy_figure(count, total) | {"right": count}
    return found


def beside_a_fit(sweeps: Dataset, varies: Sequence[str] = ()) -> Json:
    """The accuracy of each baseline on the parts that chose the model, see inner_parts; {} if
    nothing can be left out."""
    try:
        parts = inner_parts(sweeps, varies=varies)
    except FormatError:
        return {}
    return figures(sweeps, [(~part.out, part.out) for part in parts])


def lines(protocol: str, means_removed: bool, found: Json) -> Iterator[str]:
    """A line for each baseline under evaluate.HEADER."""
    means = "out" if means_removed else "in"
    for name, figure in found.items():
        count = f"{figure['right']}/{figure['n']} {figure['accuracy']:.3f}"
        ends = f"[{figure['low']:.3f}, {figure['high']:.3f}]"
        yield f"{f'({name})':<20} {protocol:<22} {means:<6} {count} {ends}"


def above(result: Json) -> str:
    """A warning if a baseline in a result of `evaluate` classifies more sweeps correctly, else
    ""."""
    window = result["window"]
    share = window["right"] / window["total"]
    name, best = max(result["baselines"].items(), key=lambda item: float(item[1]["accuracy"]))
    if best["accuracy"] <= share:
        return ""
    return (
        f"warning: ({name}) has {best['accuracy']:.3f}, more than {result['method']} under "
        f"{result['protocol']}: so simple a rule suffices for these sweeps, or they are too few"
    )


def scaled(x: Array) -> Array:
    """Features [N, F] with mean 0 and deviation 1, without features that never change; a column of
    zeros if none changes."""
    x = x[:, np.ptp(x, axis=0) > 0]
    if not x.shape[1]:
        return np.zeros((len(x), 1))
    found: Array = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), np.finfo(float).tiny)
    return found + DITHER * np.random.default_rng(0).standard_normal(found.shape)
