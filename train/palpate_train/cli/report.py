"""The command `report`, which writes a page about a bundle."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
from pathlib import Path

from palpate.core.outputs import add_rows
from palpate.core.provenance import commit
from palpate.core.storage import put
from palpate.core.text import say
from palpate_train.arguments import options
from palpate_train.arguments.options import EFFORT, FLAG, WHERE, path, text
from palpate_train.arguments.program import Add
from palpate_train.data import extras, sets
from palpate_train.data.progress import StageLine, StepTimes, spoken
from palpate_train.export import quantized_bundle
from palpate_train.models.recipe.fitted import Fit

SHARES = {"export": 0.21, "answers": 0.30, "trainings": 0.41, "pictures": 0.08}
"""Share of the time that each step takes, measured with the fit of the tutorial."""


def register(add: Add) -> None:
    report = add("report", run_report)
    wanted = "its folder, or what palpate-train fit wrote"
    add_rows(report, ("bundle", wanted, path("BUNDLE|FIT")))
    options.add_set(report)
    # fmt: off
    add_rows(report,
        ("--out", None, path("FILE.html", required=True)),
        options.JSON,
        ("--train", "the set it was fitted to, for a learning curve, and to leave each material out"
            " (the recordings of a FIT)", text("SET", action="append", default=[])),
        ("--quick", "train nothing: no learning curve, no material left out", FLAG),
        EFFORT, *WHERE,
    )
    # fmt: on


def run_report(args: argparse.Namespace) -> None:
    """Measure, train, write the page and print its path."""
    for option, *endings in (("out", ".html", ".htm"), ("json", ".json")):
        if path := getattr(args, option):
            options.writable_file(path, f"--{option}", *endings)
    with extras.needed_for("a report"):
        from palpate_train.reports import bundle_experiment, bundle_report, bundle_trainings
    sweeps, log = options.load(args, learned=False), options.Log()
    train = sets.join([sets.load(spec, 1) for spec in args.train]) if args.train else None
    steps = _steps(args, log)
    with tempfile.TemporaryDirectory() as folder:
        bundle, own = args.bundle, None
        if not bundle.is_dir():
            fit, bundle = Fit.load(args.bundle), Path(folder) / "bundle"
            own = bundle_trainings.whole(fit)
            steps.begin("export")
            quantized_bundle.export(fit, bundle, args.bundle.stem, "1", commit())
        steps.begin("answers")
        figures = bundle_experiment.run(bundle, sweeps, log)
    train = train or own
    if train and not args.quick:
        steps.begin("trainings")
        where, effort = options.where(args), options.effort(args)
        figures |= bundle_trainings.run(figures["made"], train, sweeps, where, log, effort)
    steps.begin("pictures")
    figures["command"] = shlex.join(["palpate-train", *sys.argv[1:]])
    put(args.out, bundle_report.page(figures, sweeps).encode(), parents=True)
    if args.json:
        put(args.json, (json.dumps(figures, allow_nan=False) + "\n").encode())
    log.end()
    say(str(args.out))


def _steps(args: argparse.Namespace, log: options.Log) -> StepTimes:
    """The steps of this report, each with the time left when it begins."""
    made = args.bundle.is_dir()
    left_out = {"export": made, "trainings": args.quick or (made and not args.train)}
    names = [name for name in SHARES if not left_out.get(name)]

    def tell(step: str, done: float, left_s: float | None) -> None:
        left = "" if left_s is None else f", about {spoken(left_s)} left"
        log(StageLine.of(names.index(step) + 1, len(names), step, f"{step}{left}"))

    return StepTimes({name: SHARES[name] for name in names}, tell)
