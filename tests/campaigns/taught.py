"""Accuracy of taught bundles beside `palpate-train fit`, as the box answers.

`python -m tests.campaigns taught` prints a line for each set, number of sweeps of a material, and
seed: the share of other recordings that the taught bundle names rightly and calls unknown, and the
same of the model of `palpate-train fit` at its default, or `the same model` if all weights are
equal. Taxels that may be bridged are not measured. Fabrics need PALPATE_DATA.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np

from appliance.bundle import bundle
from appliance.core.clock import SystemClock
from appliance.core.errors import ApplianceError
from appliance.core.types import Status
from appliance.inference.classifier import Classifier
from train.data import sets
from train.data.sets import Dataset
from train.data.splitters import draw
from train.export import bundle_score, quantized_bundle
from train.models.recipe import recipe
from train.models.recipe.fitted import Fit

SETS = ("sim:T-REAL:1:10", "sim:T-REAL/level-blind:1:10", "fabricslide/fabricslide.npz")
TESTED = 600
"""Largest number of sweeps that judge."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser("python -m tests.campaigns taught")
    parser.add_argument("--set", nargs="+", default=SETS, dest="sets")
    parser.add_argument("--each", nargs="+", type=int, default=(5, 10, 20))
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    for name in args.sets:
        known = name.startswith(("sim:", "aeon:")) or Path(name).exists()
        path = name if known else str(Path(os.environ["PALPATE_DATA"]) / name)
        sweeps = sets.load(path)
        for each in args.each:
            for seed in range(args.seeds):
                print(
                    f"{name}, {each} each, seed {seed}: {compared(sweeps, each, seed)}", flush=True
                )


def compared(sweeps: Dataset, each: int, seed: int) -> str:
    """The results of both models in words."""
    given, others = _parts(sweeps, each, seed)
    taught = recipe.fit(given, seed, recipe.Settings(steps=0))
    text = f"taught {_answers(taught, others)}"
    default = recipe.fit(given, seed, recipe.Settings())
    if all(np.array_equal(v, default.weights.get(k)) for k, v in taught.weights.items()):
        return f"{text}; palpate-train fit: the same model"
    return f"{text}; palpate-train fit {_answers(default, others)}"


def _parts(sweeps: Dataset, each: int, seed: int) -> tuple[Dataset, Dataset]:
    """`each` sweeps of each material, one of a recording as far as possible, and sweeps of other
    recordings."""
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
