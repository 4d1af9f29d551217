"""Sweep sets in files, with materials that are easy to distinguish."""

from pathlib import Path

import numpy as np

from palpate_train.data.sets import Dataset


def easy(n: int = 40, pieces: int = 1, dtype: str = "uint8", seed: int = 0) -> Dataset:
    """`n` sweeps [64, 2, 2] of each of three materials that hum, `pieces` a recording."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(3), n)
    pitch = np.array([0.05, 0.15, 0.35])[labels] * rng.uniform(0.9, 1.1, 3 * n)
    phase = 2 * np.pi * (pitch[:, None] * np.arange(64) + rng.random((3 * n, 1)))
    offset = rng.uniform(80, 120, (3 * n, 1, 2, 2))
    samples = (
        offset + 12 * np.sin(phase)[:, :, None, None] + 2 * rng.standard_normal((3 * n, 64, 2, 2))
    )
    groups = {"recording": np.arange(3 * n) // pieces, "speed": np.arange(3 * n) // pieces % 4}
    return Dataset(samples.astype(dtype), labels, ("low", "middle", "high"), 100.0, groups, "easy")


def held() -> dict[str, np.ndarray]:
    """The content of a valid file."""
    return {
        "samples": np.arange(6 * 8 * 2 * 3).reshape(6, 8, 2, 3).astype(np.int16),
        "labels": np.array([0, 1, 2, 0, 1, 2]),
        "materials": np.array(["a", "b", "c"]),
        "rate_hz": np.array(50.0),
        "group_speed": np.array([1, 1, 1, 2, 2, 2]),
    }


def write(path: Path, **changes: object) -> str:
    """Write a set with some arrays changed, or left out if the change is None."""
    arrays = {k: v for k, v in (held() | changes).items() if v is not None}
    np.savez(path, **arrays)
    return str(path)


def tones(
    recordings: int = 6, windows: int = 2, noise: float = 1.0, offset: float = 0.0
) -> Dataset:
    """Three hums (5, 11, 23 Hz) on 2 x 1 taxels at 100 Hz; `offset`: told by the mean."""
    rng = np.random.default_rng(1)
    labels = np.repeat(np.arange(3), recordings * windows)
    recording = np.arange(len(labels)) // windows
    t = np.arange(128) / 100
    phase = rng.uniform(0, 6, (len(labels), 1))
    hum = 20 * np.sin(2 * np.pi * np.array([5.0, 11.0, 23.0])[labels][:, None] * t + phase)
    x = (
        200
        + offset * labels[:, None, None]
        + hum[..., None]
        + noise * rng.standard_normal((len(labels), 128, 2))
    )
    groups = {"recording": recording, "session": recording % 3}
    return Dataset(
        np.rint(x).astype(np.int16)[..., None], labels, ("a", "b", "c"), 100.0, groups, "tones"
    )
