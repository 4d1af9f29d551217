"""Rates of recordings whose times repeat."""

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import sampling


@pytest.mark.parametrize(
    "time_s",
    [
        np.arange(400) // 8 * 0.08,
        np.repeat(np.arange(100), 4) * 0.04,
        np.sort(np.append(np.arange(200), np.arange(200)[::2]))[:300] / 67.0,
    ],
)
def test_the_rate_of_times_that_repeat_is_proposed(time_s: np.ndarray):
    """Four or eight frames at once, or each time twice: the rate of the frames."""
    frames = np.zeros((len(time_s), 2, 2))
    with pytest.raises(FormatError, match=r"--rate 10[0-4]") as raised:
        sampling.runs(frames, time_s, sampling.measured_hz(time_s))
    assert "--rate" in str(raised.value)
