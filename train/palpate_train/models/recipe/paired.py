"""How two candidates differ on the same held-out sweeps, and what that is enough for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_train.metrics.tolerances import LOST

Array = NDArray[Any]
TINY = 1e-12
ERRORS = 2.0
"""Number of standard errors by which a candidate must be better than the usual one, because it is
the best of about ten."""
MOST_WORSE = 0.02
"""Largest rise of the cross entropy by which fewer filters are still chosen."""


def _error(x: Array) -> float:
    """Standard error of the sum of `x` [n]."""
    return float(np.sqrt(len(x) / max(len(x) - 1, 1) * ((x - x.mean()) ** 2).sum()))


@dataclass(frozen=True, eq=False)
class PairedDifference:
    """How one candidate differs from another on the same held-out sweeps, and the rules by which
    it takes the place of the other.

    won, saved: the share [n] of each sweep in the gain of accuracy and in the fall of the loss.
    clusters: int [n], the part of each sweep. groups: for each group its sweeps (bool [n]) and
    their weights.
    """

    won: Array
    saved: Array
    clusters: Array
    groups: Sequence[tuple[Array, Array]]

    @property
    def better(self) -> bool:
        """A lower loss, and a higher accuracy by more than ERRORS standard errors. The loss alone
        decides nothing: in a sum of discriminants it depends on the size of their logits."""
        return bool(self.saved.sum() > 0) and self._clear(self.won)

    @property
    def worse(self) -> bool:
        """Less accurate by more than chance: one standard error over sweeps. Something that joins
        has to show less than something that replaces, but it must not harm, not even in a single
        part."""
        return bool(-self.won.sum() > max(_error(self.won), TINY))

    @property
    def gains(self) -> bool:
        """A lower loss, and an accuracy that is not lower."""
        return bool(self.saved.sum() > 0 and self.won.sum() > -TINY)

    @property
    def helps(self) -> bool:
        """A lower loss by more than ERRORS standard errors, no group shows the opposite, and the
        accuracy is not worse. Here the loss decides, because a level shows in margins long before
        it shows in labels: the held-out sweeps may all be right without it, and sweeps of a new
        condition wrong."""
        each = [self.saved[of] for of, _ in self.groups]
        alike = all(saved.sum() >= -_error(saved) for saved in each)
        return self._clear(self.saved) and alike and not self.worse

    @property
    def carries(self) -> bool:
        """A lower loss, a higher accuracy by more than ERRORS standard errors over sweeps, and no
        group is less accurate by more than one. Parts may differ: outermost values
        show most."""
        alike = all(self.won[of].sum() >= -_error(self.won[of]) for of, _ in self.groups)
        gain = self.won.sum() > ERRORS * _error(self.won)
        return bool(self.saved.sum() > 0 and gain and alike)

    @property
    def holds(self) -> bool:
        """At most LOST less accuracy, one standard error or one sweep included, and at most
        MOST_WORSE more loss. No group may lose more than LOST either: an easier group does
        not make up for what a new force would lose."""
        lost = max(-self.won.sum(), 0) + max(_error(self.won), 1 / len(self.won))
        each = all(-self.won[of].sum() <= LOST * of_them.sum() for of, of_them in self.groups)
        return bool(lost <= LOST and -self.saved.sum() <= MOST_WORSE and each)

    def _clear(self, gain: Array) -> bool:
        """Whether a gain [n] is more than ERRORS standard errors, the larger of that over parts and
        that over sweeps, because a few parts may agree by chance."""
        by_part = np.bincount(self.clusters, gain)
        return bool(gain.sum() > ERRORS * max(map(_error, (gain, by_part))))
