"""Folders of recorded sweeps to teach a box from."""

from pathlib import Path

import numpy as np

from palpate.core.sweep_file import save
from palpate.core.sweep_set import SweepSet
from palpate.core.types import Frames, Status, Sweep


def write(folder: Path, sweeps: SweepSet, *, first: int = 1, position: bool = False) -> None:
    """Write a set's sweeps as `palpate record` does, numbered from `first`."""
    folder.mkdir(parents=True, exist_ok=True)
    window = sweeps.format.window
    for i, taxels in enumerate(sweeps.samples):
        number = first + i
        frames = Frames(np.arange(window), np.arange(window), taxels)
        sweep = Sweep(
            id=number,
            start_ns=0,
            stop_ns=1,
            status=Status.OK,
            frames=frames,
            material=sweeps.materials[sweeps.labels[i]],
            position=str(sweeps.groups["position"][i]) if position else "",
        )
        verdict = {"status": "recorded"}
        save(folder / f"sweep-{number:06d}.npy", sweep, sweeps.format, {"verdict": verdict})
