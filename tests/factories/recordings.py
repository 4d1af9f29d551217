"""Recordings on disk, for tests."""

from pathlib import Path

import numpy as np

from palpate.core.sweep_file import save
from palpate.core.types import Frames, Status, Sweep, SweepFormat

FORMAT = SweepFormat(2, 3, 50.0, 8, "int16")


def record(
    path: Path,
    material: str = "a",
    status: Status = Status.OK,
    format: SweepFormat = FORMAT,
    **more,
) -> None:
    """A recording in the files of the box. Its raw counts start at its id."""
    n = more.pop("frames", format.window)
    taxels = (
        (more.setdefault("id", 1) + np.arange(n * 6)).reshape(n, 2, 3).astype(format.numpy_type)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = Frames(np.arange(n), np.arange(n), taxels)
    save(
        path,
        Sweep(start_ns=0, stop_ns=1, status=status, frames=frames, material=material, **more),
        format,
    )
