"""Sweeps of materials that are hard to distinguish, for comparisons of logits."""

import numpy as np

from palpate_train.data.sets import Dataset


def close(n: int = 80) -> Dataset:
    """Sweeps [n, 64, 2, 2] of three materials that hum at nearly equal rates, in much noise."""
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(3), n)
    pitch = np.array([0.11, 0.15, 0.2])[labels] * rng.uniform(0.9, 1.1, 3 * n)
    phase = 2 * np.pi * (pitch[:, None] * np.arange(64) + rng.random((3 * n, 1)))
    offset = rng.uniform(80, 120, (3 * n, 1, 2, 2))
    samples = offset + 12 * np.sin(phase)[:, :, None, None]
    samples = (samples + 8 * rng.standard_normal((3 * n, 64, 2, 2))).astype("uint8")
    groups, names = {"recording": np.arange(3 * n)}, ("low", "middle", "high")
    return Dataset(samples, labels, names, 100.0, groups, "close")
