"""The answers of the box to sweeps, by the bundle that export makes of a trained model."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from appliance.bundle import bundle
from appliance.core.clock import SystemClock
from appliance.core.provenance import commit
from appliance.inference.classifier import Classifier
from train.data.sets import Dataset
from train.evaluation.fold import BoxAnswers
from train.export import bundle_score
from train.export.quantized_bundle import export
from train.models.methods import Model
from train.models.recipe.fitted import FittedModel, finished


def answers(model: Model, sweeps: Dataset) -> BoxAnswers | None:
    """The answers to `sweeps`, as `export` and `score` give them; None for a model that is not a
    fit. Raises FormatError or BundleError if export refuses the model."""
    if not isinstance(model, FittedModel):
        return None
    fit, own = model.fit, model.fit.train.materials
    # names that any bundle may have: they change no answer
    names = tuple(f"m{number}" for number in range(len(own)))
    sides = {side: replace(getattr(fit, side), materials=names) for side in ("train", "held")}
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "bundle"
        export(finished(replace(fit, **sides)), target, "fold", "1", commit(), proven=False)
        classifier = Classifier(bundle.load(target), SystemClock())
        found, sure = bundle_score.labels_of(classifier, sweeps)
    labels = [sweeps.materials.index(own[k]) if k >= 0 else int(k) for k in found]
    return BoxAnswers.of(labels, sure)
