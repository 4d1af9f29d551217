"""The least correlations of a slide, above the correlations of noise made of the training sweeps.

Few sweeps say little of how slides differ, but in every scene noise has correlations around 0. So
the limits come from it, and hold for three sweeps of a material. Found on FabricSlide, fingerSense
and two simulated worlds (24 limits): 0 to 2 % of slides at new places lie below them, and of noise
95 %.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from palpate.answer.correlation import Correlations, correlations
from palpate.bundle.contents import Bundle
from palpate_train.answer.rule import Rule
from palpate_train.data.junk import FOR_LIMITS, windows
from palpate_train.data.sets import Dataset

CAUGHT = 0.95
"""Share of the windows of noise of each kind below the limit."""
KINDS = ("stops halfway", "random phases")
"""Of palpate_train.data.junk: without correlation from frame to frame, and from taxel to taxel."""


def limits(train: Dataset, held_out: Dataset, seed: int = 0) -> Correlations:
    """The limits. One training sweep may lie below each, as one of many does by chance, and none
    that is held out, by which a bundle is judged."""
    slides, judges = (np.array([correlations(x) for x in of.samples]) for of in (train, held_out))
    found = []
    for number, kind in enumerate(KINDS):
        noise = windows(kind, train, FOR_LIMITS, np.zeros(train.samples.shape[2:]), seed)
        middle, high = np.quantile([correlations(x)[number] for x in noise], (0.5, CAUGHT))
        least = min(np.sort(slides[:, number])[:2][-1], judges[:, number].min())
        limit = min(high, least)
        found.append(float(np.floor(1e4 * limit) / 1e4) if limit > middle else -1.0)
    return Correlations(*found)


def without(bundle: Bundle) -> Bundle:
    """The bundle without the rule against noise."""
    return replace(bundle, manifest=replace(bundle.manifest, correlations=None))


RULES = {"noise": Rule("least correlations of slides", without, tried=False)}
