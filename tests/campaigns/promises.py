"""Compares the accuracy that `fit` prints with that of its bundle where a condition is new.

`python -m tests.campaigns promises` leaves out each value of a condition in turn, fits the other
sweeps, exports the fit, and lets the box answer the sweeps that were left out. The printed figures
are the mean over all conditions, and that of heads that did not see this condition. Real fabrics
need PALPATE_DATA; a condition is one of CASES. Takes two minutes for each value.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import ApplianceError
from palpate.core.provenance import commit
from palpate.inference.classifier import Classifier
from palpate_studies.fabrics_experiment import FABRICS, FOUR, SEVEN
from palpate_studies.study import StudyCase
from palpate_train.data.sets import Dataset
from palpate_train.export import bundle_score, quantized_bundle
from palpate_train.metrics.answers import outcomes
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.recipe import Settings
from palpate_train.onnx_tools.graph_builder import run

FABRIC_SETS = {"7 fabrics": SEVEN, "4 fabrics": FOUR}
WORLDS = {"laboratory": "sim:T-REAL:1-3", "level-blind": "sim:T-REAL/level-blind:1-3"}
CASES = (
    *(("7 fabrics", name) for name in ("force", "speed", "rep")),
    *(("4 fabrics", name) for name in ("force", "speed", "direction")),
    *((world, "position") for world in WORLDS),
)
MOST_TESTED = 400
"""Largest number of sweeps that the box answers of each value."""


@dataclass(frozen=True)
class Promise:
    """The word of a fit and what became of it, in per cent. expected, of_this: printed, as the mean
    over conditions and for the condition that is left out; NaN if it has one value left. outcomes:
    shares of the box's answers, right first. network: its label alone."""

    expected: float
    of_this: float
    network: float
    outcomes: dict[str, float]

    @property
    def rightly(self) -> float:
        """The share of sweeps that the box names rightly."""
        return self.outcomes["right"]


def load(name: str) -> Dataset | None:
    """The sweeps of a case; None where real sweeps are missing."""
    if name in WORLDS:
        return StudyCase((WORLDS[name],)).load(None)
    folder = os.environ.get("PALPATE_DATA")
    case = StudyCase((FABRICS,), only=FABRIC_SETS[name], real=True)
    return case.load(Path(folder) if folder else None)


def promises(
    sweeps: Dataset, condition: str, steps: int, seed: int, most: int | None = None
) -> Iterator[Promise]:
    """One for each value of the condition, or for `most` of them at even distances."""
    values = sweeps.group(condition)
    tried = np.unique(values)
    if most is not None and most < len(tried):
        tried = tried[np.linspace(0, len(tried) - 1, most).round().astype(int)]
    for value in tried:
        out = values == value
        tested = np.random.default_rng(seed).permutation(np.flatnonzero(out))[:MOST_TESTED]
        yield promise(sweeps.take(~out), sweeps.take(np.sort(tested)), condition, steps, seed)


def promise(train: Dataset, test: Dataset, condition: str, steps: int, seed: int) -> Promise:
    """Fit `train`, export, and let the box answer `test`."""
    made = recipe.fit(train, seed, Settings(steps=steps))
    figures, names = made.held_out_figures(), made.about["conditions"]
    said = {name: 100 * figures[f"held-out {name}"]["accuracy"] for name in names}
    with tempfile.TemporaryDirectory() as aside:
        quantized_bundle.export(made, Path(aside) / "b", "promise", "1", commit(), proven=False)
        box = Classifier(bundle.load(Path(aside) / "b"), SystemClock(), slides=False)
        labels, ok = bundle_score.labels_of(box, test)
    became = outcomes(labels, ok, test.labels)
    network = run(quantized_bundle.graphs(made)[1], test.samples).argmax(axis=1) == test.labels
    return Promise(
        float(np.mean(list(said.values()))),
        said.get(condition, np.nan),
        100 * float(network.mean()),
        {name: 100 * float(share.mean()) for name, share in became.items()},
    )


def summary(found: list[Promise]) -> str:
    """The means over values, and the largest difference of word and answer."""
    rightly = np.array([one.rightly for one in found])
    network = np.mean([one.network for one in found])
    texts = [f"as the box answers {rightly.mean():.1f} %, label alone {network:.1f} %"]
    for name, said in (
        ("mean of conditions", np.array([one.expected for one in found])),
        ("this condition", np.array([one.of_this for one in found])),
    ):
        if np.isnan(said).any():  # of two values one is left, so nothing is held out by it
            continue
        apart = said - rightly
        texts.append(
            f"{name} said {said.mean():.1f} %: {apart.mean():+.1f} on the mean, "
            f"{apart[np.argmax(np.abs(apart))]:+.1f} at most"
        )
    return "; ".join(texts)


def main() -> None:
    """Print a line for each value, and a summary of each condition."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.promises", description=__doc__)
    parser.add_argument("--steps", type=int, default=0, help="of trained stages (0)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="a condition or a set of CASES: force, '4 fabrics'")
    parser.add_argument("--values", type=int, help="largest number of values of a condition (all)")
    args = parser.parse_args()
    for name, condition in CASES:
        if args.only not in (None, name, condition):
            continue
        if (sweeps := load(name)) is None:
            print(f"{name}: PALPATE_DATA does not name the folder of real sweeps")
            continue
        found = []
        for one in promises(sweeps, condition, args.steps, args.seed, args.values):
            shares = ", ".join(f"{share:.1f} % {what}" for what, share in one.outcomes.items())
            print(
                f"  {name}, {condition}: said {one.expected:.1f} % and {one.of_this:.1f} %; "
                f"label alone {one.network:.1f} %; {shares}",
                flush=True,
            )
            found.append(one)
        print(f"{name}, a {condition} out, {len(found)} values: {summary(found)}", flush=True)


if __name__ == "__main__":
    try:
        main()
    except ApplianceError as e:
        raise SystemExit(f"promises: {e}") from e
