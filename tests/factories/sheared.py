"""Simulated sweeps of a skin of 2x2 taxels with three axes."""

from palpate.sim import skin
from palpate_train.data.sets import Dataset

PITCH_MM = 6.0
WORLD = skin.World(rows=2, cols=2, pitch_mm=(PITCH_MM, PITCH_MM), shear=True)
FRAMES = 600


def sheared(each: int = 2, seed: int = 5, frames: int = FRAMES) -> Dataset:
    """`each` sweeps [frames, 2, 2, 3] of each of six tubes at each of nine positions."""
    samples, labels, position = skin.sweep_set("T-REAL", seed, each, WORLD)
    first = (samples.shape[1] - frames) // 2
    return Dataset(
        samples[:, first:][:, :frames],
        labels,
        skin.MATERIALS,
        750.0,
        {"position": position},
        "sheared",
    )
