"""Finds where an object ends without NEW OBJECT. It holds the sweeps that are fused so far, and
decides whether the next sweep begins another object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STRONG = 10.0
"""Least Bayes factor for another object: strong evidence (Jeffreys 1961, appendix B). Decision 20
compares it with other rules."""


@dataclass(frozen=True, slots=True)
class ObjectRule:
    """The settings by which an object ends (ClassifierConfig). With the defaults here only NEW
    OBJECT ends it, as in versions before 0.2."""

    max_sweeps: int = 0
    conflict: str = "fuse"
    object_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class FusedSweeps:
    """The sweeps of the present object.

    object: its number, as in Sweep; 0 before the first NEW OBJECT. scores: float64 [K]
    probabilities of each fused sweep. last, end_ns: number and end of the last sweep that had
    probabilities, whether it was fused or refused.
    """

    object: int = 0
    scores: tuple[NDArray[np.float64], ...] = ()
    last: int = 0
    end_ns: int = 0

    def ended(self, start_ns: int, rule: ObjectRule) -> bool:
        """Whether a sweep that starts at `start_ns` comes after a pause, or after `max_sweeps`
        sweeps."""
        paused = 0 < rule.object_s * 1e9 < start_ns - self.end_ns
        full = rule.conflict != "fuse" and 0 < rule.max_sweeps <= len(self.scores)
        return paused or full


def contradicts(own: NDArray[np.float64], fused: NDArray[np.float64]) -> bool:
    """Whether a sweep with the probabilities `own` float64 [K] is of another object than the sweeps
    whose fused probabilities are `fused` float64 [K].

    Compares two cases: the sweep is of this object, or of an object whose material is drawn anew
    from K equally frequent ones. The ratio of their likelihoods is K * sum(fused * own). It is near
    1 if the sweep or the sweeps before it are quite unsure.
    """
    return bool(len(own) * (fused @ own) < 1 / STRONG)
