"""The range of the measured speeds of a training set."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.sim import skin
from palpate_train.answer.fit_slide import trained_speeds
from palpate_train.data.sets import Dataset


def swept(speeds: list[float]) -> Dataset:
    """One simulated sweep at each multiple of 30 mm/s."""
    windows = []
    for i, speed in enumerate(speeds):
        rng, world = np.random.default_rng(i), replace(skin.WORLD, speed=speed)
        windows.append(skin.window("plastic rough", skin.Placement(), rng, world))
    labels = np.zeros(len(windows), np.int64)
    groups = {"recording": np.arange(len(windows))}
    return Dataset(np.array(windows), labels, skin.MATERIALS, 750.0, groups, "mine")


def test_the_range_covers_nearly_all_sweeps():
    """Within the error of the measurement; two wrong ones of a hundred do not widen it."""
    found, why = trained_speeds(swept([1.0, 2.0] * 4 + [1.5]), skin.PITCH_MM)
    assert found
    assert (found.least_mm_s, found.most_mm_s) == pytest.approx((30.0, 60.0), rel=0.03)
    assert why == ""
    found, _ = trained_speeds(swept([1.0] * 98 + [0.6, 3.0]), skin.PITCH_MM)
    assert found
    assert (found.least_mm_s, found.most_mm_s) == pytest.approx((30.0, 30.0), rel=0.05)


def test_without_a_range_the_reason_is_given():
    """No pitch; too few sweeps; sweeps in which nothing slides."""
    sweeps = swept([1.0] * 6)
    resting = replace(sweeps, samples=np.repeat(sweeps.samples[:, :1], 1500, axis=1))
    for trained, pitch_mm, why in (
        (sweeps, None, "--pitch-mm"),
        (swept([1.0] * 4), skin.PITCH_MM, "4 of 4"),
        (resting, skin.PITCH_MM, "0 of 6"),
    ):
        found, said = trained_speeds(trained, pitch_mm)
        assert found is None
        assert why in said
