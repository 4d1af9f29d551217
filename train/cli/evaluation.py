"""The commands that judge methods: methods, evaluate, stress, certainty, calibrate, cnn-curve, alignment."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from appliance.bundle import bundle
from appliance.core.clock import SystemClock
from appliance.core.errors import FormatError
from appliance.core.storage import put
from appliance.inference.classifier import Classifier
from train.cli import numbers, options
from train.cli.options import Add
from train.data import sets
from train.data.progress import Progress
from train.evaluation import evaluate, robustness, sim_calibration, uncertainty
from train.evaluation.corruptions import EvaluationSweeps
from train.export import contact_positions
from train.metrics import score
from train.models import methods
from train.reports import contact_plot, contact_table, marked_text, plots, provenance, uncertainty_report


def register(add: Add) -> None:
    """methods, evaluate, stress, certainty, calibrate, cnn-curve, alignment."""
    add("methods", run_methods, "list the methods that evaluate knows")
    _add_evaluate(add)
    _add_stress(add)
    _add_certainty(add)
    calibrate = add(
        "calibrate", run_calibrate, "compare the simulator with the twenty accuracies that the paper prints"
    )
    calibrate.add_argument("--seeds", default="201-208", metavar="FIRST-LAST", help="of the simulated worlds (201-208)")
    calibrate.add_argument("--ablate", action="store_true", help="also without each of its effects in turn")
    calibrate.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    options.add_jobs(calibrate)
    follow = add("cnn-curve", run_cnn_curve, "follow the paper's CNN while it learns the simulated skin")
    follow.set_defaults(resumes=True)
    follow.add_argument("--size", choices=("small", "whole"), default="small",
                       help="small (a stand-in of a minute) or whole (an hour of one core)")  # fmt: skip
    follow.add_argument(
        "--seed",
        type=numbers.whole("--seed", 0),
        default=1,
        metavar="N",
        help="of the simulated world and the training (1)",
    )
    follow.add_argument("--remove-means", action="store_true", help="take each window's mean away, taxel by taxel")
    follow.add_argument("--steps", type=numbers.whole("--steps", 1), metavar="N", help="iterations (those of the size)")
    follow.add_argument("--out", type=Path, required=True, metavar="FILE",
                       help="where the curve goes; an interrupted training goes on from there")  # fmt: skip
    alignment = add(
        "alignment",
        run_alignment,
        "measure whether a skin that has moved is flagged before accuracy is lost (simulated)",
    )
    alignment.add_argument("--bundle", type=Path, default=bundle.DEFAULT, metavar="DIR", help="(the packaged one)")
    alignment.add_argument("--seen", default="sim:T-REAL:1-6:2", metavar="SET", help="what it was trained on")
    alignment.add_argument("--unseen", default="sim:T-REAL:101-104:2", metavar="SET", help="moved from these places")
    alignment.add_argument("--hard", default="sim:T-HARD:101-136:2", metavar="SET", help="a row ahead")
    alignment.add_argument("--out", type=Path, required=True, metavar="DIR", help="where place.json and place.svg go")


def _add_evaluate(add: Add) -> None:
    command = add("evaluate", run_evaluate, "train and test methods under a protocol")
    options.add_set(command)
    command.add_argument("--protocol", action="append", required=True, metavar="PROTOCOL", dest="protocols",
                     help="random:10, leave:GROUP or split:GROUP=a,b->c; prefer those that leave groups out")  # fmt: skip
    command.add_argument("--method", required=True, metavar="NAME[,NAME...]", help="or all; see palpate-train methods")
    command.add_argument("--remove-means", action="store_true", help="take each window's mean away, taxel by taxel")
    command.add_argument("--seeds", type=int, default=1, metavar="N", help="of training and random folds: 1 to N (1)")
    command.add_argument("--each", type=int, default=0, metavar="N",
                     help="train on N sweeps of each material, drawn by the seed: a point of a learning curve (all)")  # fmt: skip
    command.add_argument("--json", type=Path, metavar="FILE", help="write the results there")
    options.add_effort(command)
    options.add_where(command)


def _add_stress(add: Add) -> None:
    command = add("stress", run_stress, "test trained methods on corrupted sweeps, one corruption at a time")
    options.add_set(command)
    command.add_argument(
        "--test", required=True, metavar="SET", help="the set that is corrupted; a simulated one is drawn anew"
    )
    command.add_argument("--method", required=True, metavar="NAME[,NAME...]", help="or all; see palpate-train methods")
    command.add_argument("--seeds", type=int, default=1, metavar="N", help="of training and corruptions: 1 to N (1)")
    command.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="for results.json, table.md and curves.svg"
    )
    command.add_argument("--strong", default="compact,minirocket", metavar="A,B", help="methods drawn with their bands")
    options.add_effort(command)
    options.add_where(command)


def _add_certainty(add: Add) -> None:
    command = add(
        "certainty",
        run_certainty,
        "measure how far a model's probabilities can be trusted: calibration, more sweeps, unknown materials, enrolment",
    )
    options.add_set(command)
    command.add_argument("--test", metavar="SET", help="test on this set")
    command.add_argument(
        "--protocol", default="leave:position", help="what is tested on where --test is not given (leave:position)"
    )
    command.add_argument("--method", default=methods.SHIPPED, metavar="NAME",
                         help=f"{methods.SHIPPED}, compact or one of its family ({methods.SHIPPED})")  # fmt: skip
    command.add_argument("--seed", type=numbers.whole("--seed", 0), default=1, help="of training and draws (1)")
    command.add_argument(
        "--out", type=Path, default=Path("docs/certainty"), metavar="DIR", help="where it goes (docs/certainty)"
    )
    command.add_argument("--kept", action="store_true", help="train nothing, report what an earlier run has finished")
    options.add_effort(command)
    options.add_where(command)


def run_methods(args: argparse.Namespace) -> None:
    """One line for each method."""
    for method in methods.every().values():
        extra = f" (needs pip install 'palpate-train[{method.extra}]')" if method.extra else ""
        print(f"{method.name:<20} {method.about}{extra}")


def run_evaluate(args: argparse.Namespace) -> None:
    """Print each result as it is finished, and write all of them; name a method that cannot be used, and go on.

    Raises FormatError at the end where there was one.
    """
    sweeps = options.load(args)
    names = options.names(args)
    if args.each < 0:
        raise FormatError(f"--each {args.each} is no number of sweeps; use 1 or more, or leave it out for all")
    seeds, effort = options.seeds(args), options.effort(args)
    plan = evaluate.Plan(names, tuple(args.protocols), seeds, args.remove_means, effort, args.each)
    results: list[dict[str, Any]] = []
    refused: dict[str, str] = {}
    log = options.Log()
    print(evaluate.HEADER)
    for result in evaluate.evaluate(sweeps, plan, options.where(args), log):
        if result.refused:
            if result.method not in refused:
                log.keep(f"{result.method} cannot be used here: {result.refused}; left out")
            refused.setdefault(result.method, result.refused)
            continue
        results.append(result.json() | {"only": args.only, "each": args.each})
        print(evaluate.line(results[-1]), flush=True)
        if args.json:
            results.sort(key=lambda r: (args.protocols.index(r["protocol"]), names.index(r["method"]), r["seed"]))
            _write(args.json, results)
    if refused:
        raise FormatError(f"{', '.join(refused)} left out of {', '.join(names)}; the lines above say why")


def _write(path: Path, results: Iterable[dict[str, Any]]) -> None:
    """Write a JSON list, one line each, whole or not at all."""
    put(path, ("[\n" + ",\n".join(json.dumps(result) for result in results) + "\n]\n").encode(), parents=True)


def run_stress(args: argparse.Namespace) -> None:
    """Write the curves as JSON and as a plot, and the table; print the table."""
    train = options.load(args)
    simulated = args.test.startswith("sim:")
    test = (
        EvaluationSweeps.simulated(args.test)
        if simulated
        else EvaluationSweeps.of(sets.load(args.test).select(args.only))
    )
    result = robustness.run(
        options.names(args),
        train,
        test,
        options.where(args),
        seeds=options.seeds(args),
        effort=options.effort(args),
        log=options.Log(),
    )
    result["box"] = robustness.box_answers(bundle.load(bundle.DEFAULT))
    result |= {"train": train.source, "digest": sets.digest(train), "format": str(train.format)} | score.provenance()
    table = robustness.table(result)
    put(args.out / "results.json", (json.dumps(result) + "\n").encode(), parents=True)
    put(args.out / "table.md", table.encode(), parents=True)
    picture = provenance.in_svg(plots.robustness(result, args.strong.split(",")), provenance.of(result))
    put(args.out / "curves.svg", picture.encode(), parents=True)
    print(table)


def run_certainty(args: argparse.Namespace) -> None:
    """Write the figures and the page; print the page's path."""
    test = sets.load(args.test).select(args.only) if args.test else None
    result = uncertainty.run(
        options.load(args), test, args.protocol, args.method, options.where(args), options.Log(), options.effort(args),
        args.seed,
    )  # fmt: skip
    print(uncertainty_report.write(result, args.out))


def run_calibrate(args: argparse.Namespace) -> None:
    """Print the table; write the figures as JSON where a file is named."""
    first, _, last = args.seeds.partition("-")
    if not first.isdigit() or not (last or first).isdigit() or int(last or first) < int(first):
        raise FormatError(f"--seeds {args.seeds} cannot be read; write FIRST-LAST, e.g. 201-208")
    seeds = range(int(first), int(last or first) + 1)
    result = sim_calibration.measure(seeds, args.ablate, options.Log(), jobs=args.jobs) | score.provenance()
    if args.json:
        put(args.json, (json.dumps(result, indent=1) + "\n").encode(), parents=True)
    print(sim_calibration.table(result))


def run_cnn_curve(args: argparse.Namespace) -> None:
    """Train, write the curve, print it."""
    log = options.Log()
    from train.evaluation import cnn_curve  # here: it imports PyTorch

    print(cnn_curve.table(cnn_curve.follow(
        args.out, args.size, args.seed, args.remove_means, steps=args.steps, log=log
    )))  # fmt: skip


def run_alignment(args: argparse.Namespace) -> None:
    """Measure, write the figures and the plot, the table into the page where one lies there, and print a summary."""
    box = Classifier(bundle.load(args.bundle), SystemClock())
    displacements = len(contact_positions.DIRECTIONS) * (2 * len(contact_positions.OFF_MM) + 1)
    progress = Progress(displacements, options.Log())
    result = contact_positions.measure(box, args.unseen, args.seen, args.hard, progress.begin)
    args.out.mkdir(parents=True, exist_ok=True)
    put(args.out / "place.json", (json.dumps(result, indent=1) + "\n").encode(), parents=True)
    about = provenance.of(result)
    put(args.out / "place.svg", (provenance.in_svg(contact_plot.draw(result), about) + "\n").encode(), parents=True)
    page = args.out / "README.md"
    if page.exists():
        text = marked_text.insert(page.read_text(encoding="utf-8"), "alignment", contact_table.table(result), str(page))
        put(page, provenance.in_markdown(text, about).encode())
    print("\n".join(contact_positions.lines(result)))
