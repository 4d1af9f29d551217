"""MultiRocket-Hydra and QUANT with aeon's default settings: the METHODS multirocket-hydra and
quant.

A user of a time-series library would take these. They have no graph, so they are timed in aeon and
cannot be packed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_studies.peers.linear_head import SHARPENING
from palpate_train.data.sets import Dataset
from palpate_train.models.linear_head import ABSENT
from palpate_train.models.methods import Method
from palpate_train.models.training import one_thread

Array = NDArray[Any]
SHORTEST = 10
"""Smallest number of frames: kernels have nine, and MultiRocket also uses differences. QUANT would
need fewer."""
BATCH = 64
"""Number of sweeps that are transformed at a time: QUANT makes a hundred thousand features of a
long sweep."""
LEAST = 1e-4
"""Least probability of QUANT's 200 trees, before their logarithm."""
Fit = Callable[[Array, Array, int], Callable[[Array], Array]]
"""(series float32 [N, R * C, T], labels [N] from 0 on, seed) -> a function from series to scores
[n, k]."""


@dataclass(frozen=True, eq=False)
class AeonModel:
    """A classifier of aeon. scores: see Fit; present [k]: labels that were trained, among
    `classes`."""

    name: str
    scores: Callable[[Array], Array]
    present: Array
    classes: int

    def logits(self, inputs: Array) -> Array:
        """Raw counts [n, T, R, C] -> float32 [n, K]."""
        found = np.full((len(inputs), self.classes), ABSENT, np.float32)
        with undisturbed():
            for first in range(0, len(inputs), BATCH):
                part = slice(first, first + BATCH)
                found[part, self.present] = self.scores(series(inputs[part]))
        return found

    def graph(self) -> onnx.ModelProto:
        """Raises FormatError, because there is no graph."""
        raise FormatError(
            f"{self.name} runs in aeon alone and has no graph; choose another method for the box"
        )


def train(sweeps: Dataset, inputs: Array, seed: int, *, name: str, fit: Fit) -> AeonModel:
    """A classifier of aeon fitted to `inputs`, the raw counts [N, T, R, C] of `sweeps`.

    Raises FormatError if aeon is missing, if windows are too short, or if only one material occurs.
    """
    sweeps.require_materials()
    if inputs.shape[1] < SHORTEST:
        raise FormatError(
            f"a window of {inputs.shape[1]} frames is too short for {name}; record at least "
            f"{SHORTEST} frames"
        )
    present, labels = np.unique(sweeps.labels, return_inverse=True)
    try:
        with undisturbed():
            scores = fit(series(inputs), labels, seed)
    except ImportError as e:
        raise FormatError(f"{name} needs aeon ({e}); try pip install 'palpate-train[peers]'") from e
    return AeonModel(name, scores, present, len(sweeps.materials))


def series(counts: Array) -> Array:
    """Raw counts [n, T, R, C] as aeon takes them: float32 [n, R * C, T], in C order, since
    for any other numba compiles again."""
    return np.ascontiguousarray(
        counts.reshape(*counts.shape[:2], -1).transpose(0, 2, 1), np.float32
    )


@contextmanager
def undisturbed() -> Iterator[None]:
    """Use one thread, and restore the random states of numpy and PyTorch, which aeon seeds."""
    before = np.random.get_state()
    try:
        with one_thread(), torch.random.fork_rng(devices=[]):
            yield
    finally:
        np.random.set_state(before)


def fit_multirocket_hydra(x: Array, labels: Array, seed: int) -> Callable[[Array], Array]:
    """Margins of its ridge, as Fit; for two classes scikit-learn gives only the second's."""
    from aeon.classification.convolution_based import MultiRocketHydraClassifier

    it = MultiRocketHydraClassifier(random_state=seed, n_jobs=1).fit(x, labels)

    def scores(x: Array) -> Array:
        """The margins that `it` compares; its own method returns only labels, which cannot be
        fused."""
        hydra = it._scale_hydra.transform(it._transform_hydra.transform(x))
        rocket = it._scale_multirocket.transform(it._transform_multirocket.transform(x))
        margins = SHARPENING * it.classifier.decision_function(
            np.concatenate((hydra, rocket), axis=1)
        )
        found = np.stack([-margins, margins], axis=1) if margins.ndim == 1 else margins
        centred: Array = found - found.mean(axis=1, keepdims=True)
        return centred

    return scores


def fit_quant(x: Array, labels: Array, seed: int) -> Callable[[Array], Array]:
    """Log probabilities of its trees, as Fit."""
    from aeon.classification.interval_based import QUANTClassifier

    it = QUANTClassifier(random_state=seed).fit(x, labels)

    def scores(x: Array) -> Array:
        logarithms: Array = np.log(np.maximum(it.predict_proba(x), LEAST))
        return logarithms

    return scores


def _method(name: str, about: str, fit: Fit) -> Method:
    return Method(name, about, "raw", partial(train, name=name, fit=fit), "peers", library="aeon")


METHODS = (
    _method(
        "multirocket-hydra",
        "MultiRocket-Hydra of aeon + ridge (Dempster et al. 2023)",
        fit_multirocket_hydra,
    ),
    _method(
        "quant",
        "QUANT of aeon: quantiles of intervals + extra trees (Dempster et al. 2024)",
        fit_quant,
    ),
)
