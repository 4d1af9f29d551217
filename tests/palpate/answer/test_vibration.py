"""The vibration of a window against its load, in parts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from palpate.answer.slide import SlideLimits, vibration

TARE = np.full((2, 2), 20.0)


def test_it_is_the_deviation_over_the_load_and_a_constant_part_rests():
    """Whatever gain and shear; NaN is refused elsewhere."""

    def window(*sizes: float, load: float = 50.0, each: int = 40) -> np.ndarray:
        """Counts [T, 2, 2] that swing by each of `sizes` around the load, a part each."""
        swing = np.concatenate([size * (-1.0) ** np.arange(each) for size in sizes])
        return (TARE + load + swing[:, None, None]).astype(np.float32)

    want = [math.log(1 / 50), math.log(4 / 50)]
    assert vibration(window(1, 4), TARE, 2) == pytest.approx(want, abs=1e-3)
    strong = TARE + 10 * (window(1, 4) - TARE)
    assert vibration(strong, TARE, 2) == pytest.approx(want, abs=1e-3)
    small = vibration(window(0.25, 0.25, load=1e6), TARE, 2)
    assert small == pytest.approx([math.log(0.25 / 1e6)] * 2, abs=0.01)
    axes = np.stack([100 * window(5, 5), window(1, 4)], axis=-1)
    tare = np.stack([TARE, TARE], axis=-1)
    assert vibration(axes, tare, 2) == pytest.approx(vibration(window(1, 4), TARE, 2))
    limits = SlideLimits((-5.0, -1.0))
    assert limits.resting(vibration(window(0, 4, 0), TARE, 3), 0) == [1, 3]
    assert limits.resting(vibration(window(4, 4, 4), TARE, 3), 0) == []
    assert limits.resting(vibration(window(4, 4, 4), TARE, 3), 1) == [1, 2, 3]
    assert limits.resting(vibration(window(0, 4, 0), TARE, 3), 2) == []  # of an enrolled label
    broken = window(4, 4, 4)
    broken[50] = np.nan
    assert limits.resting(vibration(broken, TARE, 3), 0) == []
