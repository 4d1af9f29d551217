"""An optional rule of the answer, as its twin on the desktop describes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from palpate.bundle.contents import Bundle
from palpate.bundle.manifest import Manifest
from palpate_train.data.sets import Dataset


@dataclass(frozen=True)
class Rule:
    """A rule that a bundle may lack. what: for people. without: makes a bundle without it; the same
    bundle if it has none. tried: whether recordings can show that it is not needed; no recording
    shows a material that was not taught, and an early answer saves time alone. limited: a manifest
    with its limits, from the counts of training sweeps."""

    what: str
    without: Callable[[Bundle], Bundle]
    tried: bool = True
    limited: Callable[[Manifest, Dataset], Manifest] = lambda manifest, train: manifest
