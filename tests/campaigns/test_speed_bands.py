"""Bands over f/v do not depend on the speed at which a pattern passes."""

from __future__ import annotations

import numpy as np

from tests.campaigns.speed_bands import BANDS, QUIET, log_bands

RATE_HZ, FRAMES = 200.0, 800
HZ = (1.0, 20.0)


def passing(speed: float, windows: int = 40) -> np.ndarray:
    """Windows float32 [windows, FRAMES, 2] of a pattern that passes at this speed: 300 waves from
    0.5 to 40 per mm, the shorter ones weaker."""
    rng = np.random.default_rng(5)
    per_mm = np.exp(rng.uniform(np.log(0.5), np.log(40), (300, 1)))
    path_mm = speed * np.arange(FRAMES) / RATE_HZ
    turns = [per_mm * path_mm + rng.uniform(0, 1, per_mm.shape) for _ in range(windows)]
    waves = np.stack([(np.sin(2 * np.pi * turn) / per_mm).sum(axis=0) for turn in turns])
    return np.stack([waves, 0.5 * waves], axis=2).astype(np.float32)


def test_a_known_speed_keeps_the_bands_of_a_pattern():
    """At twice the speed, mean bands over f/v differ by less than a quarter of what bands over f
    do."""
    one, two = np.ones(40), np.full(40, 2.0)
    slow = log_bands(passing(1), RATE_HZ, one, HZ).mean(axis=0)
    told, untold = (log_bands(passing(2), RATE_HZ, v, HZ).mean(axis=0) for v in (two, one))
    assert slow.shape == (BANDS * 2,)
    assert np.abs(told - slow).mean() < 0.25 * np.abs(untold - slow).mean()


def test_a_band_outside_of_the_spectrum_is_finite():
    """Bands far above half the frame rate, or below one period, have a finite power."""
    for ratio in (1e-4, 1e4):
        assert np.isfinite(log_bands(passing(1, 1), RATE_HZ, np.full(1, ratio), HZ)).all()


def test_a_silent_window_is_quiet():
    """Counts that do not change have the power QUIET in every band."""
    silent = np.zeros((1, FRAMES, 2), np.float32)
    assert np.allclose(log_bands(silent, RATE_HZ, np.ones(1), HZ), np.log(QUIET))
