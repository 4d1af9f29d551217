"""The picture of a sweep: lines that lose no peak, a spectrogram that shows the vibration."""

from __future__ import annotations

import json
from base64 import b64encode

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.web.sweep_picture import FINEST, MOST_TAXELS, DrawnWindow, picture, window
from tests.factories import feed_lines


def test_the_window_is_the_one_that_was_sent():
    """Bytes, shape, axes, the most loaded taxels; 45 Hz in the band of 40 to 60 Hz."""
    shown = picture(window(feed_lines.sweep(1, hz=45.0), feed_lines.RATE_HZ))
    assert shown["seconds"] == 2.0
    shares = np.array(shown["spectrogram"])
    assert shares.shape == (40, 19)
    assert shown["band_hz"] == pytest.approx(20.0)
    assert np.mean(shares.argmax(axis=1) == 2) > 0.9
    assert json.loads(json.dumps(shown)) == shown
    counts = np.arange(2 * 3 * 4 * 3, dtype="<i2").reshape(2, 3, 4, 3) - 7
    line = {
        "sweep": 5,
        "shape": [2, 3, 4, 3],
        "dtype": "int16",
        "data": b64encode(counts.tobytes()).decode(),
    }
    found = window(line, 100.0)
    assert (found.sweep, found.rate_hz) == (5, 100.0)
    np.testing.assert_array_equal(found.taxels, counts)
    counts = np.zeros((100, 12, 32, 3), np.int16)
    counts[:, 4:8, 10:14, 2] = 500
    counts[:, 0, 0, 0] = 9000  # shear, which is not drawn
    shown = picture(DrawnWindow(1, 100.0, counts))
    assert len(shown["taxels"]) == MOST_TAXELS
    assert shown["of"] == 384
    assert [one["name"] for one in shown["taxels"]] == [
        f"{r}.{c}" for r in range(5, 9) for c in range(11, 15)
    ]


@pytest.mark.parametrize("frames", [1, 7, FINEST, 1500, 12_345])
def test_no_peak_is_lost(frames):
    """Lowest and highest count of the whole sweep are in the lines, in at most FINEST steps."""
    counts = np.random.default_rng(frames).normal(100, 20, (frames, 2, 2)).astype("<f4")
    shown = picture(DrawnWindow(1, 750.0, counts))
    assert [one["name"] for one in shown["taxels"]] == ["1.1", "1.2", "2.1", "2.2"]
    for i, one in enumerate(shown["taxels"]):
        assert len(one["low"]) == len(one["high"]) <= FINEST
        series = counts.reshape(frames, 4)[:, i]
        assert (min(one["low"]), max(one["high"])) == pytest.approx(
            (series.min(), series.max()), abs=0.01
        )


def _nan() -> NDArray[np.float32]:
    counts = np.ones((100, 2, 2), np.float32)
    counts[3, 0, 0] = np.nan
    return counts


@pytest.mark.parametrize(
    ("counts", "rate_hz", "why"),
    [
        (np.ones((100, 2, 2), np.uint8), 10.0, "too slow"),
        (np.ones((2, 2, 2), np.uint8), 750.0, "too few"),
        (_nan(), 750.0, "not a number"),
    ],
)
def test_without_a_spectrogram_it_says_why(counts, rate_hz, why):
    """The lines are present and can be sent as JSON."""
    shown = picture(DrawnWindow(1, rate_hz, counts))
    assert why in shown["trouble"]
    assert shown["spectrogram"] == []
    assert len(json.loads(json.dumps(shown, allow_nan=False))["taxels"]) == 4
