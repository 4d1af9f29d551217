"""The load of a broken taxel follows from the loads of sound taxels."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.answer.taxels import LoadModes, bridged

SPREAD = np.array([4.0, 8.0, 2.0, 6.0, 1.0, 5.0])
TILT = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
LOADS = LoadModes(
    *(tuple((20 * SPREAD).tolist()), (tuple((5 * SPREAD).tolist()), tuple((4 * TILT).tolist()))),
    1e-3,
)
"""Six values that are pressed differently: a common force, and a tilt."""


def frames(n: int = 30) -> np.ndarray:
    """float32 [n, 6] of random forces and tilts."""
    rng = np.random.default_rng(0)
    force, tilt = rng.uniform(10, 30, n), rng.uniform(-10, 10, n)
    return (force[:, None] * SPREAD + tilt[:, None] * TILT).astype(np.float32)


@pytest.mark.parametrize("places", [[0], [5], [1, 2], [0, 2, 4], [0, 1, 2, 3]])
def test_sound_values_tell_the_broken_ones(places):
    """Exactly, where the modes are all there is; whatever the broken ones read."""
    broken = np.isin(np.arange(6), places)
    read = np.where(broken, np.nan, frames())
    assert LOADS.expected(read, broken) == pytest.approx(frames()[:, broken], rel=0.01, abs=0.5)


@pytest.mark.parametrize(("shape", "mask"), [((3, 2), (1, 0)), ((3, 1, 2), (0, 0))])
def test_a_broken_taxel_is_filled_on_all_axes(shape, mask):
    """Where neighbours would be far off; counts stay whole, given ones unchanged."""
    taxels = np.rint(frames()).astype(np.int16).reshape(-1, *shape)
    broken = np.zeros(shape[:2], bool)
    broken[mask] = True
    given = taxels.copy()
    given[:, broken] = -7
    filled = bridged(given, broken, np.zeros(shape), LOADS)
    assert (given[:, broken] == -7).all()
    assert np.abs(filled.astype(int) - taxels).max() <= 1
    assert filled.dtype == np.int16
    beside = bridged(given, broken, np.zeros(shape))
    assert np.abs(beside.astype(int) - taxels).max() > 20


def test_filled_counts_stay_in_the_range_of_their_type():
    """A load above 255 becomes 255."""
    taxels = np.full((3, 3, 2), 250, np.uint8)
    assert bridged(taxels, np.eye(3, 2, dtype=bool), np.zeros((3, 2)), LOADS).max() == 255
