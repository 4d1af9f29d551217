"""How the loads of taxels move together in training, so that sound taxels tell the load of a broken
one.

Neighbours differ where one of them is pressed harder than the other in every sweep. A few modes,
such as more force or a contact further along, describe the loads of all taxels: probabilistic
principal components (Tipping and Bishop, Journal of the Royal Statistical Society B, 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import BundleError
from palpate.core.schema import LEAST, MOST, Within, check

_MOST = MOST**0.25  # products of four stay finite
_Row = tuple[Annotated[float, Within(-_MOST, _MOST)], ...]


@dataclass(frozen=True, slots=True)
class LoadModes:
    """Loads are mean + amounts @ modes + noise.

    mean: raw counts of each value of a frame, [V]. modes: [M, V], for amounts with variance 1.
    rest: variance of the noise. Raises BundleError for a value out of range.
    """

    mean: _Row
    modes: Annotated[tuple[_Row, ...], Within(1, 8)]
    rest: Annotated[float, Within(LEAST, _MOST)]

    def __post_init__(self) -> None:
        check(self, "bridging.loads")
        if {len(mode) for mode in self.modes} != {len(self.mean)}:
            raise BundleError(
                "bridging.loads: each mode must have as many values as the mean; "
                "export the bundle again"
            )

    def expected(self, frames: NDArray[Any], broken: NDArray[np.bool_]) -> NDArray[np.float32]:
        """The most probable broken values [T, B], given the sound ones of frames [T, V].

        broken: mask [V].
        """
        weights, offset = _weights(self, broken.tobytes())
        told: NDArray[np.float32] = frames[:, ~broken].astype(np.float32) @ weights + offset
        return told


@lru_cache(maxsize=4)
def _weights(loads: LoadModes, mask: bytes) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weights [S, B] and offset [B] that give broken values as a sum of sound ones."""
    broken = np.frombuffer(mask, bool)
    mean, modes = np.array(loads.mean), np.array(loads.modes)
    sound = modes[:, ~broken]
    amounts = np.linalg.solve(sound @ sound.T + loads.rest * np.eye(len(modes)), sound)  # [M, S]
    weights = amounts.T @ modes[:, broken]
    offset = mean[broken] - mean[~broken] @ weights
    return weights.astype(np.float32), offset.astype(np.float32)
