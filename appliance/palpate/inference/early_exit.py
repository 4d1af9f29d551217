"""Early exit: answers with status ok while the finger still slides.

The bundle's graph has a head for each step of the window. The manifest holds the least probability
at which each head may answer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import BundleError
from palpate.core.types import Status, Sweep, Verdict
from palpate.inference.classifier import Classifier, softmax
from palpate.inference.novelty import EarlyDistances

if TYPE_CHECKING:
    from palpate.bundle.manifest import Early


def decides(scores: NDArray[np.float64], rule: Early) -> bool:
    """Whether `scores` float64 [d + 1, K], the probabilities of steps 0 to d, allow an answer at
    step d.

    This needs the same label at the last `rule.agree` steps, and a probability of at least
    `rule.least[d]` at step d.
    """
    labels = scores[-rule.agree :].argmax(axis=1)
    agreed = len(labels) == rule.agree and (labels == labels[-1]).all()
    return bool(agreed and scores[-1].max() >= rule.least[len(scores) - 1])


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
        self._classifier, self._manifest, self._rule = classifier, manifest, manifest.early
        self.steps = len(self._rule.least)
        classes, limits = classifier.bundle.classes, self._rule.limits
        self._distances = (
            EarlyDistances(classes.early, limits) if classes and classes.early else None
        )
        self._outputs = ("early", *("early_embedding",) * (self._distances is not None))
        classifier.prepare(*self._outputs)

    def __call__(self, sweep: Sweep) -> Verdict | None:
        """The verdict on a sweep with share < 1, or None if the rest of the sweep is needed; then
        the sweep is not counted.

        The frames are checked like a whole window: broken taxels are bridged, and a faulty sweep is
        not answered early, nor one whose material is unknown at one of the steps that must agree,
        if the bundle has limits for these. For the graph the window is completed by repeating the
        last frame; the heads up to this step do not depend on the repeated frames.
        """
        sweep, finding = self._classifier.repaired(sweep)
        if finding.status is not Status.OK:
            return None
        scores, known = self._scores(sweep)
        if not (decides(scores, self._rule) and known[-self._rule.agree :].all()):
            return None
        return self._classifier.conclude_if_ok(sweep, scores[-1], finding.degraded)

    def scores(self, sweep: Sweep) -> NDArray[np.float64]:
        """Probabilities float64 [d, K] at the steps that a sweep with share < 1 has reached."""
        return self._scores(self._classifier.repaired(sweep)[0])[0]

    def _scores(self, sweep: Sweep) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """As `scores`, of a sweep whose broken taxels were bridged; and whether its material is
        known at each step, bool [d]."""
        taxels = sweep.frames.taxels
        rest = self._manifest.format.window - len(taxels)
        step = round(sweep.share * (self.steps + 1))  # counted from 1
        whole = np.concatenate([taxels, taxels[-1:].repeat(rest, axis=0)])
        logits, *embedded = self._classifier.unfinished(whole, *self._outputs)
        known = np.ones(step, bool)
        if self._distances:
            known = self._distances.known(embedded[0][:step])
        return softmax(logits[:step]), known
