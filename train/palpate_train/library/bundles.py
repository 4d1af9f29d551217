"""A bundle as a classifier: its answers come from the code that runs on the box."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.core.types import Verdict
from palpate.inference.classifier import Classifier
from palpate_train.data.sets import Dataset
from palpate_train.library.sweeps import as_value_errors, of_type, raw_counts
from palpate_train.metrics import bundle_score


class BundleClassifier:
    """Answers as the box gives them. classes_: the bundle's materials, in the order of columns."""

    def __init__(self, loaded: bundle.Bundle) -> None:
        self.bundle = loaded
        self.classes_: Array = np.array(loaded.manifest.labels)
        self._box = Classifier(loaded, SystemClock())

    @as_value_errors()
    def verdicts(self, x: Any) -> list[Verdict]:
        """The box's verdict on each sweep. x: as sweeps.raw_counts takes it, in the
        bundle's type. Raises FormatError if it has another format than the bundle."""
        sweeps = self._sweeps(x)
        return [verdict for _, verdict in bundle_score.verdicts(self._box, sweeps)]

    def predict(self, x: Any) -> Array:
        """A material for each sweep, or the status of a sweep that the box does not classify, such
        as "unknown" or "no-contact"; str [n]."""
        return np.array([v.label or str(v.status) for v in self.verdicts(x)])

    def predict_proba(self, x: Any) -> Array:
        """The probability of each material, float64 [n, K]; NaN for a sweep that the box does not
        score."""
        found = np.full((len(given := self.verdicts(x)), len(self.classes_)), np.nan)
        for i, verdict in enumerate(given):
            if len(verdict.scores):
                found[i] = verdict.scores
        return found

    def score(self, x: Any, y: Any) -> float:
        """The share of sweeps whose material the box names. y: a label for each sweep."""
        return float(np.mean(self.predict(x) == np.asarray(y).astype(str)))

    def _sweeps(self, x: Any) -> Dataset:
        wanted = self.bundle.manifest.format
        samples = x.samples if isinstance(x, Dataset) else raw_counts(x, wanted.shape)
        samples = of_type(samples, wanted.dtype)
        labels = np.zeros(len(samples), np.int64)
        made = Dataset(samples, labels, tuple(self.classes_), wanted.rate_hz, {}, "X")
        if made.format != wanted:
            raise FormatError(f"X has the format {made.format}; the bundle takes {wanted}")
        return made


def load_bundle(path: str | Path) -> BundleClassifier:
    """The bundle in a folder. Raises BundleError if it is broken."""
    return BundleClassifier(bundle.load(Path(path)))
