"""The answers of the box to sweeps, by the bundle that export makes of a trained model."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.provenance import commit
from palpate.inference.classifier import Classifier
from palpate_train.data.sets import Dataset
from palpate_train.export.quantized_bundle import export
from palpate_train.metrics import bundle_score
from palpate_train.models.methods import Model
from palpate_train.models.recipe.fitted import Fit, FittedModel, finished

Array = NDArray[Any]


def answers(model: Model, sweeps: Dataset) -> tuple[Array, Array] | None:
    """The answers to `sweeps`, as `export` and `score` give them, see fold.AsTheBox; None for a
    model that is not a fit. Raises FormatError or BundleError if export refuses the model."""
    if not isinstance(model, FittedModel):
        return None
    own = model.fit.train.materials
    with tempfile.TemporaryDirectory() as folder:
        pack(model.fit, target := Path(folder) / "bundle")
        classifier = Classifier(bundle.load(target), SystemClock())
        found, sure = bundle_score.labels_of(classifier, sweeps)
    labels = [sweeps.materials.index(own[k]) if k >= 0 else int(k) for k in found]
    return np.array(labels, int), sure


def pack(fit: Fit, target: Path) -> None:
    """Calibrate `fit` and export it with all rules of the answer. Its materials get names that any
    bundle may have: they change no answer. Raises FormatError or BundleError if export refuses."""
    names = tuple(f"m{number}" for number in range(len(fit.train.materials)))
    sides = {side: replace(getattr(fit, side), materials=names) for side in ("train", "held")}
    export(finished(replace(fit, **sides)), target, "fold", "1", commit(), proven=False)
