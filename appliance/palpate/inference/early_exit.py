"""Answers with status ok while the finger still slides."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.early import EarlyNetwork
from palpate.answer.pipeline import Context
from palpate.answer.unknown import EarlyDistances
from palpate.core.errors import BundleError
from palpate.core.types import Status, Sweep, Verdict
from palpate.inference.classifier import Classifier


class EarlyExit:
    """Answers unfinished sweeps. steps: number of times in a window at which it can answer.

    Raises BundleError if the bundle has no early heads.
    """

    def __init__(self, classifier: Classifier) -> None:
        manifest = classifier.bundle.manifest
        if manifest.early is None:
            raise BundleError(
                f"bundle {manifest.name} {manifest.version} has no early heads, but "
                "classifier.early is true; set classifier.early = false, or name a bundle that was "
                "exported with them"
            )
        self._classifier, self.steps = classifier, len(manifest.early.least)
        classes, limits = classifier.bundle.classes, manifest.early.limits
        if manifest.known:  # the limits are strict already: a loose choice does not widen them
            growth = min(1.0, manifest.known.growth(classifier.settings.strangers))
            limits = tuple(growth * limit for limit in limits)
        distances = EarlyDistances(classes.early, limits) if classes and classes.early else None
        outputs = ("early", *("early_embedding",) * (distances is not None))
        classifier.prepare(*outputs)

        def network(taxels: NDArray[Any]) -> list[NDArray[np.float32]]:
            return classifier.outputs(taxels, *outputs)

        window = manifest.format.window
        self._stages = classifier.stages(EarlyNetwork(network, manifest.early, distances, window))

    def __call__(self, sweep: Sweep) -> Verdict | None:
        """The verdict on a sweep with share < 1, or None if the rest of the sweep is needed; then
        the sweep is not counted. It passes the stages of a whole window."""
        context = self.judged(sweep)
        return self._classifier.verdict(context) if context.status is Status.OK else None

    def judged(self, sweep: Sweep) -> Context:
        """The findings of the stages in a sweep with share < 1."""
        return self._classifier.unfinished(sweep, self._stages)
