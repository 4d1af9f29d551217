"""Folders of recordings as laboratories keep them: simulated sweeps in CSV files."""

from pathlib import Path

import numpy as np

from palpate.sim import skin

LEAD_FRAMES = 300
"""Frames before and after the window of a sweep."""


def csv_folder(folder: Path, each: int = 2, positions: int = 4) -> Path:
    """Write simulated sweeps of a 4x4 skin at 750 Hz, `each` of three tubes at every position.

    The files MATERIAL_POSITION_TRIAL.csv have a header, milliseconds and 16 raw counts. Spaces in
    materials become "-". A README lies beside them.
    """
    folder.mkdir(parents=True)
    samples, labels, position = skin.sweep_set("T-REAL", 5, each)
    trial: dict[tuple[int, int], int] = {}
    for counts, label, at in zip(samples, labels.tolist(), position.tolist(), strict=True):
        if label < 3 and at < positions:
            trial[label, at] = trial.get((label, at), 0) + 1
            around = np.concatenate(
                [counts[:LEAD_FRAMES][::-1], counts, counts[-LEAD_FRAMES:][::-1]]
            )
            name = f"{skin.MATERIALS[label].replace(' ', '-')}_p{at}_{trial[label, at]}.csv"
            write(folder / name, around.reshape(len(around), -1), skin.FORMAT.rate_hz)
    (folder / "README.md").write_text("Recorded with the robot in the cellar.\n")
    return folder


def write(
    path: Path, counts: np.ndarray, rate_hz: float, time_ms: np.ndarray | None = None
) -> None:
    """Write raw counts [n, columns] as CSV with a header and times in ms to three decimals."""
    path.parent.mkdir(parents=True, exist_ok=True)
    times = 1000 * np.arange(len(counts)) / rate_hz if time_ms is None else time_ms
    names = ",".join(["time", *(f"s{k}" for k in range(counts.shape[1]))])
    rows = (
        f"{t:.3f},{','.join(f'{c:g}' for c in row)}\n"
        for t, row in zip(times, counts.tolist(), strict=True)
    )
    path.write_text(f"{names}\n{''.join(rows)}")
