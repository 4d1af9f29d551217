"""The studies that measure: stress, certainty, alignment."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.core.outputs import Row, add_rows
from palpate.core.provenance import commit
from palpate.inference.classifier import Classifier
from palpate_studies import (
    alignment,
    certainty,
    rules_study,
    stress,
    tables,
)
from palpate_studies.study import add_out, save
from palpate_train.arguments import options
from palpate_train.arguments.options import EFFORT, WHERE, text
from palpate_train.arguments.program import Add
from palpate_train.data import sets
from palpate_train.data.corruptions import applicable
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.progress import Progress
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.export import bundle_stress
from palpate_train.export.quantized_bundle import export
from palpate_train.metrics import score
from palpate_train.models.methods import PACKAGED, Log
from palpate_train.models.recipe import recipe

STRESSED = "sim:T-REAL/level-blind:101-104:1"
"""At 36 attachments at which neither the methods nor the packaged bundle are trained."""
CERTAIN = "sim:T-REAL/level-blind:1-3", "sim:T-REAL/level-blind:4-6:20"
"""What is trained on and tested on in the study `certainty`."""
MOVED, EACH = "sim:T-HARD/level-blind:101-112:2", 48
"""Slides at places that are displaced, and the number of sweeps of each alteration and each kind of
junk, for the study `rules`."""
OWN = "stressed"
"""Name of a bundle that the study makes for itself."""
STRESSED_METHODS = (
    "palpate-reattached,palpate,minirocket,minirocket-augmented,multirocket-hydra,ds-cnn,H-svm"
)
"""First the recipe of the packaged bundle."""


# fmt: off
_STRESS: tuple[Row, ...] = (
    ("--split", "train on this share of the set's groups, as `fit --split` with seed 1, and corrupt"
        f" the rest instead of {STRESSED}, which is drawn anew", text("GROUP:SHARE")),
    ("--method", "ours first; the first five are drawn; or all; see palpate-train evaluate --list"
        f" ({STRESSED_METHODS})", text("NAME[,NAME...]", STRESSED_METHODS)),
    ("--seeds", "of training and corruptions: 1 to N (1)", text("N", 1, type=int)),
)
# fmt: on


def register(add: Add) -> None:
    """Add all commands of this module."""
    stressed = add("stress", run_stress)
    options.add_set(stressed, "sim:T-REAL/level-blind:1")
    add_rows(stressed, *_STRESS)
    for command, name in ((stressed, "stress"), (add("certainty", run_certainty), "certainty")):
        add_out(command, name)
        add_rows(command, EFFORT, *WHERE)
    add_out(add("alignment", run_alignment), "alignment", kept=False)
    add_out(add("rules", run_rules), "rules", kept=False)


def run_rules(args: argparse.Namespace) -> None:
    """Measure, write the results, and print their table."""
    tested, moved, packaged = sets.load(STRESSED), sets.load(MOVED), bundle.load(bundle.DEFAULT)
    result = rules_study.results(packaged, tested, moved, EACH, options.Log())
    save(args.out, result)
    print(tables.rules(result))


def run_stress(args: argparse.Namespace) -> None:
    """Write the results; print their path."""
    names, seeds, log = options.names(args), options.seeds(args), options.Log()
    train = options.load(args)
    if args.split:
        train, rest = train.split(*options.group_share(args.split), 1)
        test = EvaluationSweeps.of(rest)
    else:
        test = EvaluationSweeps.simulated(STRESSED)
    with tempfile.TemporaryDirectory() as own:
        folder = _made_of(train, Path(own), log) if args.split else None
        box = _box_under_stress(folder, test, seeds, log)
    result = stress.run(
        names,
        train,
        test,
        options.where(args),
        seeds=seeds,
        effort=options.effort(args),
        log=log,
    )
    positions = test.sweeps.groups.get("position")
    result |= {
        "box": box,
        "only": list(args.only),
        "split": args.split or "",
        "train": train.source,
        "train_sweeps": len(train),
        "train_digest": sets.digest(train),
        "test": test.sweeps.source,
        "test_sweeps": len(test.sweeps),
        "test_digest": sets.digest(test.sweeps),
        "attachments": 0 if positions is None else len(np.unique(positions)),
        "format": str(train.format),
        "seeds": list(seeds),
    } | score.provenance()
    print(save(args.out, result))


def _made_of(train: Dataset, folder: Path, log: Log) -> Path:
    """The bundle that `fit` and `export` make of these sweeps at their defaults."""
    export(recipe.fit(train, Run(1, log)), folder / "bundle", OWN, "1", commit())
    return folder / "bundle"


def _box_under_stress(
    folder: Path | None, test: EvaluationSweeps, seeds: Sequence[int], log: Callable[[str], None]
) -> dict[str, Any]:
    """The answers of a bundle under corruption. Raises FormatError if it cannot answer these
    sweeps; for the packaged one (None) the curves are then missing."""
    box = Classifier(bundle.load(folder or bundle.DEFAULT), SystemClock(), slides=False)
    try:
        curves, paired = (
            bundle_stress.under_corruptions(box, test, seeds, log, those)
            for those in (applicable(test), stress.pairs())
        )
    except FormatError:
        if folder:
            raise
        curves, paired = {}, {}
    manifest = box.bundle.manifest
    number = box.bundle.id if manifest.name != OWN else ""  # this file is gone after the run
    return {
        "bundle": {"name": manifest.name, "version": manifest.version, "id": number},
        "made": dict(manifest.made),
        "curves": curves,
        "pairs": paired,
    }


def run_certainty(args: argparse.Namespace) -> None:
    """Write the results; print their path."""
    train, test = map(sets.load, CERTAIN)
    where, effort = options.where(args), options.effort(args)
    result = certainty.run(train, test, PACKAGED, where, options.Log(), effort)
    print(save(args.out, result))


def run_alignment(args: argparse.Namespace) -> None:
    """Measure, write the results, and print their table."""
    box = Classifier(bundle.load(bundle.DEFAULT), SystemClock())
    displacements = len(alignment.DIRECTIONS) * (2 * len(alignment.OFF_MM) + 1)
    progress = Progress(displacements, options.Log())
    result = alignment.measure(box, progress.begin)
    save(args.out, result)
    print(tables.alignment(result))
