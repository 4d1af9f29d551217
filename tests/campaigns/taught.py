"""Accuracy of taught bundles, as the box answers.

`python -m tests.campaigns taught` prints a line for each set, number of sweeps of a material, and
seed: the share of other recordings that the taught bundle classifies correctly and calls unknown.
Taxels that may be bridged are not measured. Fabrics need PALPATE_DATA.

With `--junk` the sweeps are of places where nobody taught, and the line tells the shares of junk
and of altered slides that get a wrong label, whole and early (in the simulator the kinds of the
campaign `junk`; of recorded sweeps the kinds of palpate_train.data.junk, and altered copies).

With `--added N` each material in turn comes later, with N sweeps: into a bundle of the others that
stays, as the box teaches it, and into a fit of all materials.
"""

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.bundle import bundle
from palpate.bundle.bundle import Bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import ApplianceError
from palpate.core.types import Status
from palpate.inference.classifier import Classifier
from palpate.learn import enrolment
from palpate_train.data import sets
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.data.splitters import draw
from palpate_train.export import quantized_bundle
from palpate_train.metrics import bundle_score
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import Fit
from tests.campaigns import taught_junk

Array = NDArray[np.bool_]
SETS = ("sim:T-REAL:1:10", "sim:T-REAL/level-blind:1:10", "fabricslide/fabricslide.npz")
TESTED = 600
"""Largest number of sweeps that judge."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser("python -m tests.campaigns taught")
    parser.add_argument("--set", nargs="+", default=SETS, dest="sets")
    parser.add_argument("--each", nargs="+", type=int, default=(5, 10, 20))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--added", type=int, help="sweeps of a material that comes later")
    parser.add_argument("--junk", action="store_true", help="junk and altered slides, too")
    args = parser.parse_args()
    for name in args.sets:
        known = name.startswith("sim:") or Path(name).exists()
        path = name if known else str(Path(os.environ["PALPATE_DATA"]) / name)
        if args.junk:
            taught_junk.run(name, path, args.each, args.seeds)
            continue
        sweeps = sets.load(path)
        for each in args.each:
            for seed in range(args.seeds):
                told = (
                    added(sweeps, each, args.added, seed)
                    if args.added
                    else alone(sweeps, each, seed)
                )
                print(f"{name}, {each} each, seed {seed}: {told}", flush=True)


def alone(sweeps: Dataset, each: int, seed: int) -> str:
    """The results of a taught bundle in words."""
    given, others = _parts(sweeps, each, seed)
    return f"taught {_answers(recipe.fit(given, Run(seed)), others)}"


def added(sweeps: Dataset, each: int, few: int, seed: int) -> str:
    """Means over the materials that come later, in words."""
    given, others = _parts(sweeps, each, seed)
    found = np.array(
        [_later(given, others, label, few, seed) for label in range(len(given.materials))]
    )
    into, of_all, before, after, together = 100 * found.mean(axis=0)
    return (
        f"{few} sweeps of a new material: taught into the bundle {into:.1f} %, trained with all "
        f"{of_all:.1f} %; the other materials before {before:.1f} %, after {after:.1f} %, trained "
        f"with all {together:.1f} %"
    )


def _later(
    given: Dataset, others: Dataset, label: int, few: int, seed: int
) -> tuple[float, float, float, float, float]:
    """Shares that the box classifies correctly: of the new material, taught into a bundle and
    trained with all; of the other materials before it came, after it, and trained with all."""
    name = given.materials[label]
    own, rest = np.flatnonzero(given.labels == label)[:few], given.labels != label
    kept = ",".join(m for m in given.materials if m != name)
    new = others.labels == label
    with tempfile.TemporaryDirectory() as folder:
        base = exported(given.select((f"material={kept}",)), Path(folder) / "a", seed)
        every = exported(given.take(np.append(np.flatnonzero(rest), own)), Path(folder) / "b", seed)
    taught = enrolment.enrol(base, name, given.samples[own]).bundle
    before, after, together = (_right(one, others) for one in (base, taught, every))
    return (
        float(after[new].mean()),
        float(together[new].mean()),
        *(float(right[~new].mean()) for right in (before, after, together)),
    )


def exported(sweeps: Dataset, folder: Path, seed: int, steps: int = 0) -> Bundle:
    """Writes the bundle of a fit to a folder. steps: of the training of stages."""
    fit = recipe.fit(sweeps, Run(seed), recipe.Settings(steps=steps))
    quantized_bundle.export(fit, folder, "taught", "1", "", proven=False)
    return bundle.load(folder)


def _right(of: Bundle, others: Dataset) -> Array:
    """Whether the box classifies each sweep correctly, with status ok, bool [n]."""
    box, right = Classifier(of, SystemClock(), slides=False), np.zeros(len(others), bool)
    for i, verdict in bundle_score.verdicts(box, others):
        is_ok = verdict.status is Status.OK
        right[i] = is_ok and verdict.label == others.materials[others.labels[i]]
    return right


def _parts(sweeps: Dataset, each: int, seed: int) -> tuple[Dataset, Dataset]:
    """`each` sweeps of each material, of many recordings, and sweeps of other recordings."""
    shuffled = np.random.default_rng(seed).permutation(len(sweeps))
    first = shuffled[np.sort(np.unique(sweeps.group("recording")[shuffled], return_index=True)[1])]
    chosen = draw(first, sweeps.labels, each, seed)
    apart = ~np.isin(sweeps.group("recording"), sweeps.group("recording")[chosen])
    return sweeps.take(chosen), sweeps.take(shuffled[apart[shuffled]][:TESTED])


def _answers(fit: Fit, others: Dataset) -> str:
    """The answers of the exported bundle in words."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            quantized_bundle.export(fit, Path(folder) / "b", "taught", "1", "", proven=False)
        except ApplianceError as e:
            return f"is refused: {e}"
        box = Classifier(bundle.load(Path(folder) / "b"), SystemClock(), slides=False)
    right, unknown = 0, 0
    for i, verdict in bundle_score.verdicts(box, others):
        right += verdict.label == others.materials[others.labels[i]]
        unknown += verdict.status is Status.UNKNOWN
    n = len(others)
    return f"{100 * right / n:.1f} % right, {100 * unknown / n:.1f} % unknown of {n}"


if __name__ == "__main__":
    main()
