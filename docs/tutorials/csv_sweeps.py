"""Writes simulated sweeps as CSV files, for the tutorial "Your first model": `python
docs/tutorials/csv_sweeps.py FOLDER`.

Each file is one sweep of a finger over a tube: a line of names, then a line for each frame with its
time in ms and the raw counts of sixteen taxels. `wood_p3_2.csv` is the second sweep of wood at
position 3. The numbers come from the project's simulated skin, not from a real skin.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np

from palpate_train.data import sets

SWEEPS = "sim:T-REAL:1:3"
"""Six materials at nine positions, three sweeps each, world 1 of the simulator."""


def main() -> int:
    """Write all files; the exit code."""
    if len(sys.argv) != 2:
        print("usage: python docs/tutorials/csv_sweeps.py FOLDER", file=sys.stderr)
        return 2
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    data = sets.load(SWEEPS)
    counted: Counter[str] = Counter()
    for sweep, label, position in zip(
        data.samples, data.labels, data.groups["position"], strict=True
    ):
        stem = f"{data.materials[label].replace(' ', '-')}_p{position}"
        counted[stem] += 1
        frames = sweep.reshape(len(sweep), -1)
        times = np.arange(len(frames)) * 1000 / data.rate_hz
        rows = (
            f"{time:.3f}," + ",".join(map(str, row))
            for time, row in zip(times, frames, strict=True)
        )
        head = "time," + ",".join(f"s{taxel}" for taxel in range(frames.shape[1]))
        file = folder / f"{stem}_{counted[stem]}.csv"
        file.write_text("\n".join([head, *rows, ""]), "ascii")
    print(f"{counted.total()} files in {folder}, materials: {', '.join(data.materials)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
