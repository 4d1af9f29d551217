"""Unknown materials that a bundle takes for known ones, each material left out in turn.

`python -m tests.campaigns unknown-materials` fits a model without each material of the training
set, and exports it. It prints, for the sweeps of the test set: the share of known sweeps within the
limit of known materials, the share of unknown ones within it, and the same if two sweeps of a
material have to be within it. Then both for the limit that keeps 97 % of the known sweeps, and the
AUROC. Real fabrics: `--set $PALPATE_DATA/fabricslide/fabricslide.npz --only direction=0
'force<=180'`, where sweeps of the last repetition test.
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.unknown import shaped_distances
from palpate.core.clock import SystemClock
from palpate.inference.classifier import Classifier
from palpate_train.answer.embedding import auroc
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from tests.campaigns.taught import exported

Array = NDArray[Any]
KEPT = 0.97
"""Share of known sweeps at the second limit."""
MOST = 1200
"""Largest number of test sweeps."""


@dataclass(frozen=True)
class LeftOutDistances:
    """Distances of known sweeps [n] and of unknown ones [m], as shares of the limit."""

    known: Array
    unknown: Array

    def shares(self, limit: float) -> tuple[float, ...]:
        """Shares within a limit: known sweeps, unknown sweeps, and pairs of unknown sweeps."""
        passed = float((self.unknown <= limit).mean())
        half = len(self.unknown) // 2
        both = np.maximum(self.unknown[:half], self.unknown[half : 2 * half]) <= limit
        return float((self.known <= limit).mean()), passed, float(both.mean())

    @property
    def fair(self) -> float:
        """The limit that keeps KEPT of the known sweeps."""
        return float(np.quantile(self.known, KEPT))


def main() -> None:
    """Print a row for each material, and the means."""
    parser = argparse.ArgumentParser("python -m tests.campaigns unknown-materials")
    parser.add_argument("--set", default="sim:T-REAL/level-blind:1-3", dest="given")
    parser.add_argument("--test", default="sim:T-REAL/level-blind:4-6:8")
    parser.add_argument("--only", nargs="*", default=(), help="of --set; its last `rep` tests")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    train = sets.load(args.given)
    if args.only:
        whole = train.select(tuple(args.only))
        last = whole.group("rep") == whole.group("rep").max()
        train, test = whole.take(np.flatnonzero(~last)), whole.take(np.flatnonzero(last))
    else:
        test = sets.load(args.test)
    test = test.take(np.random.default_rng(args.seed).permutation(len(test))[:MOST])
    print("left out: kept, passed, both of two passed | at 97 % kept: passed, both | AUROC")
    rows = []
    for name in train.materials:
        found = left_out(train, test, name, args.steps, args.seed)
        row = (*found.shares(1), *found.shares(found.fair)[1:], auroc(found.known, found.unknown))
        rows.append(row)
        _print(name, row)
    _print("mean", tuple(np.mean(rows, axis=0)))


def left_out(train: Dataset, test: Dataset, name: str, steps: int, seed: int) -> LeftOutDistances:
    """The distances of the test sweeps from a model that has not seen a material."""
    kept = train.select((f"material={','.join(m for m in train.materials if m != name)}",))
    with tempfile.TemporaryDirectory() as folder:
        made = exported(kept, Path(folder) / "b", seed, steps)
    box = Classifier(made, SystemClock(), slides=False)
    known = box.bundle.manifest.known
    classes = box.bundle.classes
    assert known
    assert classes
    z = np.stack([box.outputs(window, "embedding")[0] for window in test.samples]).astype(
        np.float64
    )
    away = z[:, None] - classes.means.astype(np.float64)
    nearest = shaped_distances(away, classes.shapes.astype(np.float64)).min(axis=1) / known.limit
    unknown = np.array([test.materials[k] == name for k in test.labels])
    return LeftOutDistances(nearest[~unknown], nearest[unknown])


def _print(name: str, row: tuple[float, ...]) -> None:
    *shares, area = row
    texts = [f"{100 * share:5.1f}" for share in shares]
    print(f"{name:16} {' '.join(texts[:3])} | {' '.join(texts[3:])} | {area:.3f}", flush=True)


if __name__ == "__main__":
    main()
