"""Unknown materials that a bundle takes for known ones, each material left out in turn.

`python -m tests.campaigns unknown-materials` fits a model without each material of the training
set, and exports it. It prints, for the sweeps of the test set and each choice of
`classifier.strangers`: the share of known sweeps within the limit of known materials, the share of
unknown ones within it, and the same if two sweeps of a material have to be within it. The AUROC
comes last. Real fabrics: `--set $PALPATE_DATA/fabricslide/fabricslide.npz --only direction=0
'force<=180'`, where sweeps of the last repetition test, or of the last value of `--last`.
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
from palpate_train.answer.stranger_limits import COSTS
from palpate_train.data import sets
from palpate_train.data.sets import Dataset
from tests.campaigns.taught import exported

Array = NDArray[Any]
MOST = 1200
"""Largest number of test sweeps."""


@dataclass(frozen=True)
class LeftOutDistances:
    """Distances of known sweeps [n] and of unknown ones [m], and the limits by their names."""

    known: Array
    unknown: Array
    limits: dict[str, float]

    def shares(self, limit: float) -> tuple[float, ...]:
        """Shares within a limit: known sweeps, unknown sweeps, and pairs of unknown sweeps."""
        passed = float((self.unknown <= limit).mean())
        half = len(self.unknown) // 2
        both = np.maximum(self.unknown[:half], self.unknown[half : 2 * half]) <= limit
        return float((self.known <= limit).mean()), passed, float(both.mean())


def main() -> None:
    """Print a row for each material, and the means."""
    parser = argparse.ArgumentParser("python -m tests.campaigns unknown-materials")
    parser.add_argument("--set", default="sim:T-REAL/level-blind:1-3", dest="given")
    parser.add_argument("--test", default="sim:T-REAL/level-blind:4-6:8")
    parser.add_argument("--only", nargs="*", default=(), help="of --set; its last value tests")
    parser.add_argument("--last", default="rep", metavar="GROUP", help="of this group (rep)")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    train = sets.load(args.given)
    if args.only:
        whole = train.select(tuple(args.only))
        last = whole.group(args.last) == whole.group(args.last).max()
        train, test = whole.take(np.flatnonzero(~last)), whole.take(np.flatnonzero(last))
    else:
        test = sets.load(args.test)
    test = test.take(np.random.default_rng(args.seed).permutation(len(test))[:MOST])
    print(f"left out: kept, passed, both of two passed, {' | '.join(COSTS)} | AUROC")
    rows = []
    for name in train.materials:
        found = left_out(train, test, name, args.steps, args.seed)
        shares = [share for limit in found.limits.values() for share in found.shares(limit)]
        row = (*shares, auroc(found.known, found.unknown))
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
    nearest = shaped_distances(away, classes.shapes.astype(np.float64)).min(axis=1)
    unknown = np.array([test.materials[k] == name for k in test.labels])
    limits = {name: float(getattr(known, name)) for name in COSTS}
    return LeftOutDistances(nearest[~unknown], nearest[unknown], limits)


def _print(name: str, row: tuple[float, ...]) -> None:
    *shares, area = row
    texts = [f"{100 * share:5.1f}" for share in shares]
    by_limit = [" ".join(texts[i : i + 3]) for i in range(0, len(texts), 3)]
    print(f"{name:16} {' | '.join(by_limit)} | {area:.3f}", flush=True)


if __name__ == "__main__":
    main()
