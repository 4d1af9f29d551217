"""The studies that compare methods or views: paper, development, fabrics, shots, recipe.

Each writes one file of results. `python -m palpate_studies pages` draws them.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path

from palpate.core.outputs import Row, add_rows
from palpate_studies import (
    development_experiment,
    development_times,
    fabrics_experiment,
    paper_experiment,
    recipe_views,
)
from palpate_studies.pages import PAGES
from palpate_studies.study import StudyRun, add_out, read, save
from palpate_train.arguments import options
from palpate_train.arguments.options import EFFORT, FLAG, WHERE, path, text
from palpate_train.arguments.program import Add

# fmt: off
_DATA: Row = ("--data", "folder of real sweeps (PALPATE_DATA)",
    path("DIR", default=os.environ.get("PALPATE_DATA")))
_METHOD = "NAME[,NAME...]"
_SEEDS: Row = ("--seeds", "of training: 1 to N (1)", text("N", 1, type=int))
_OPTIONS: Mapping[str, tuple[Row, ...]] = {
    "paper": (),
    "development": (
        _SEEDS,
        ("--method", "replace these in --out (ours, as fit trains it, and the peers)",
            text(_METHOD)),
        ("--times", "measure the times of the results in --out again, and keep their accuracies",
            FLAG),
    ),
    "fabrics": (("--method", "(all)", text(_METHOD, "all")),),
    "shots": (_SEEDS,),
    "recipe": (),
}
# fmt: on


def register(add: Add) -> None:
    """Add all commands of this module."""
    runs = {"development": run_development, "fabrics": run_fabrics}
    measured = {
        "paper": paper_experiment.results,
        "shots": fabrics_experiment.shots,
        "recipe": recipe_views.results,
    }
    for name, rows in _OPTIONS.items():
        command = add(name, runs.get(name, run_study))
        command.set_defaults(results=measured.get(name))
        add_rows(command, *rows)
        add_out(command, name)
        add_rows(command, *[_DATA] * (name != "paper"), EFFORT, *WHERE)


def _run(args: argparse.Namespace) -> StudyRun:
    seeds = options.seeds(args) if hasattr(args, "seeds") else (1,)
    data: Path | None = getattr(args, "data", None)
    return StudyRun(options.where(args), options.Log(), data, options.effort(args), seeds)


def _done(run: StudyRun, path: Path) -> None:
    """Print the names that were left out, and the path of the results."""
    for name, why in run.left_out.items():
        print(f"left out: {name}: {why}")
    print(path)


def run_study(args: argparse.Namespace) -> None:
    """Measure and write the results of a study that has no options of its own."""
    run = _run(args)
    _done(run, save(args.out, args.results(run)))


def run_fabrics(args: argparse.Namespace) -> None:
    """Evaluate and write the results."""
    names, run = options.names(args), _run(args)
    _done(run, save(args.out, fabrics_experiment.results(names, run)))


def run_development(args: argparse.Namespace) -> None:
    """Evaluate, time and write the results; with --times after timing alone."""
    run, keys = _run(args), PAGES["development"].keys
    names = options.names(args) if args.method else development_experiment.usual_methods()
    if args.times:
        figures = read(args.out, *keys)
    else:
        figures = development_experiment.results(run, tuple(names))
        if args.method and args.out.exists():
            figures = development_experiment.joined(read(args.out, *keys), figures)
    if args.times or not args.kept:
        train = development_times.TIMED.load()
        assert train is not None  # it is simulated
        figures["times"] = development_times.measured(
            figures["methods"], train, 1, run.where.cache, run.log, run.effort
        )
        # without the folder of real sweeps their panel keeps its times
        figures["panel_times"] = figures.get("panel_times", {}) | development_times.of_panels(
            figures["methods"], run.data, 1, run.where.cache, run.log, run.effort
        )
    run.left_out = dict(figures["left_out"])
    _done(run, save(args.out, figures))
