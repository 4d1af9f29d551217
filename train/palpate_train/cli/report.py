"""The command `report`, which writes a page about a bundle."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
from pathlib import Path

from palpate.core.provenance import commit
from palpate.core.storage import put
from palpate.core.text import say
from palpate_train.arguments import options
from palpate_train.arguments.program import Add
from palpate_train.data import extras, sets
from palpate_train.export import quantized_bundle
from palpate_train.models.recipe.fitted import Fit


def register(add: Add) -> None:
    report = add("report", run_report)
    report.add_argument(
        "bundle",
        type=Path,
        metavar="BUNDLE|FIT",
        help="its folder, or what palpate-train fit wrote",
    )
    options.add_set(report)
    report.add_argument("--out", type=Path, required=True, metavar="FILE.html")
    report.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    report.add_argument(
        "--train",
        action="append",
        default=[],
        metavar="SET",
        help=(
            "the set it was fitted to, for a learning curve, and to leave each material out "
            "(those of a FIT)"
        ),
    )
    report.add_argument(
        "--quick",
        action="store_true",
        help="train nothing: no learning curve, no material left out",
    )
    options.add_effort(report)
    options.add_where(report)


def run_report(args: argparse.Namespace) -> None:
    """Measure, train, write the page and print its path."""
    for option, *endings in (("out", ".html", ".htm"), ("json", ".json")):
        if path := getattr(args, option):
            options.writable_file(path, f"--{option}", *endings)
    with extras.needed_for("a report"):
        from palpate_train.reports import bundle_experiment, bundle_report, bundle_trainings
    sweeps, log = options.load(args, learned=False), options.Log()
    train = sets.join([sets.load(spec, 1) for spec in args.train]) if args.train else None
    with tempfile.TemporaryDirectory() as folder:
        bundle, own = args.bundle, None
        if not bundle.is_dir():
            fit, bundle = Fit.load(args.bundle), Path(folder) / "bundle"
            own = bundle_trainings.whole(fit)
            quantized_bundle.export(fit, bundle, args.bundle.stem, "1", commit())
        figures = bundle_experiment.run(bundle, sweeps, log)
    train = train or own
    if train and not args.quick:
        where, effort = options.where(args), options.effort(args)
        figures |= bundle_trainings.run(figures["made"], train, sweeps, where, log, effort)
    figures["command"] = shlex.join(["palpate-train", *sys.argv[1:]])
    put(args.out, bundle_report.page(figures, sweeps).encode(), parents=True)
    if args.json:
        put(args.json, (json.dumps(figures, allow_nan=False) + "\n").encode())
    say(str(args.out))
