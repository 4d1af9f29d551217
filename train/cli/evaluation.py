"""The commands that judge methods: methods, evaluate, stress, certainty, calibrate, alignment."""

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
from train.cli import options
from train.cli.options import Add
from train.data import sets
from train.evaluation import evaluate, robustness, sim_calibration, uncertainty
from train.evaluation.corruptions import EvaluationSweeps
from train.export import contact_positions
from train.metrics import score
from train.models import methods
from train.reports import contact_plot, plots, uncertainty_report


def register(add: Add) -> None:
    """methods, evaluate, stress, certainty, calibrate, alignment."""
    add("methods", run_methods, "list the methods that evaluate knows")
    _add_evaluate(add)
    _add_stress(add)
    _add_certainty(add)
    one = add("calibrate", run_calibrate, "compare the simulator with the twenty accuracies that the paper prints")
    one.add_argument("--seeds", default="201-208", metavar="FIRST-LAST", help="of the simulated worlds (201-208)")
    one.add_argument("--ablate", action="store_true", help="also without each of its effects in turn")
    one.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    one.add_argument("--jobs", type=int, default=-1, metavar="N", help="processes (one for each core)")
    two = add(
        "alignment", run_alignment, "tell whether a skin that has moved is flagged before accuracy is lost (simulated)"
    )
    two.add_argument("--bundle", type=Path, default=bundle.DEFAULT, metavar="DIR", help="(the packaged one)")
    two.add_argument("--seen", default="sim:T-REAL:1-6:2", metavar="SET", help="what it was trained on")
    two.add_argument("--unseen", default="sim:T-REAL:101-104:2", metavar="SET", help="moved from these places")
    two.add_argument("--hard", default="sim:T-HARD:101-136:2", metavar="SET", help="a row ahead")
    two.add_argument("--out", type=Path, required=True, metavar="DIR", help="where place.json and place.svg go")


def _add_evaluate(add: Add) -> None:
    one = add("evaluate", run_evaluate, "train and test methods under a protocol")
    options.add_set(one)
    one.add_argument("--protocol", action="append", required=True, metavar="PROTOCOL", dest="protocols",
                     help="random:10, leave:GROUP or split:GROUP=a,b->c; hard ones tell more")  # fmt: skip
    one.add_argument("--method", required=True, metavar="NAME[,NAME...]", help="or all; see palpate-train methods")
    one.add_argument("--remove-means", action="store_true", help="take each window's mean away, taxel by taxel")
    one.add_argument("--seeds", type=int, default=1, metavar="N", help="of training and random folds: 1 to N (1)")
    one.add_argument("--json", type=Path, metavar="FILE", help="write the results there")
    options.add_effort(one)
    options.add_where(one)


def _add_stress(add: Add) -> None:
    one = add("stress", run_stress, "put trained methods under what goes wrong, one thing at a time")
    options.add_set(one)
    one.add_argument("--test", required=True, metavar="SET", help="what is stressed; simulated, it is drawn anew")
    one.add_argument("--method", required=True, metavar="NAME[,NAME...]", help="or all; see palpate-train methods")
    one.add_argument("--seeds", type=int, default=1, metavar="N", help="of training and stress: 1 to N (1)")
    one.add_argument("--out", type=Path, required=True, metavar="DIR", help="for results.json, table.md and curves.svg")
    one.add_argument("--strong", default="compact,minirocket", metavar="A,B", help="methods drawn with their bands")
    options.add_effort(one)
    options.add_where(one)


def _add_certainty(add: Add) -> None:
    one = add(
        "certainty",
        run_certainty,
        "tell how sure a model may be: calibration, more sweeps, unknown materials, enrolment",
    )
    options.add_set(one)
    one.add_argument("--test", metavar="SET", help="test on this set")
    one.add_argument(
        "--protocol", default="leave:position", help="what is tested on where --test is not given (leave:position)"
    )
    one.add_argument("--method", default="compact", metavar="NAME", help="compact or one of its family (compact)")
    one.add_argument("--seed", type=int, default=1, help="of training and draws (1)")
    one.add_argument(
        "--out", type=Path, default=Path("docs/certainty"), metavar="DIR", help="where it goes (docs/certainty)"
    )
    one.add_argument("--kept", action="store_true", help="train nothing, tell what an earlier run has finished")
    options.add_effort(one)
    options.add_where(one)


def run_methods(args: argparse.Namespace) -> None:
    """One line for each method."""
    for method in methods.every().values():
        extra = f" (needs pip install 'palpate-train[{method.extra}]')" if method.extra else ""
        print(f"{method.name:<16} {method.about}{extra}")


def run_evaluate(args: argparse.Namespace) -> None:
    """Say each result as it comes, and write all of them."""
    sweeps = options.load(args)
    names = options.names(args)
    plan = evaluate.Plan(names, tuple(args.protocols), options.seeds(args), args.remove_means, options.effort(args))
    done: list[dict[str, Any]] = []
    refused: dict[str, str] = {}
    print(evaluate.HEADER)
    for result in evaluate.evaluate(sweeps, plan, options.where(args), options.Log()):
        if result.refused:
            refused[result.method] = result.refused
            continue
        done.append(result.json() | {"only": args.only})
        print(evaluate.line(done[-1]), flush=True)
        if args.json:
            done.sort(key=lambda r: (args.protocols.index(r["protocol"]), names.index(r["method"]), r["seed"]))
            _write(args.json, done)
    if refused:
        raise FormatError("; ".join(f"{name} cannot be used here: {why}" for name, why in refused.items()))


def _write(path: Path, results: Iterable[dict[str, Any]]) -> None:
    """Write a JSON list, one line each, whole or not at all."""
    put(path, ("[\n" + ",\n".join(json.dumps(result) for result in results) + "\n]\n").encode(), parents=True)


def run_stress(args: argparse.Namespace) -> None:
    """Curves as JSON and as a picture, and the table."""
    train = options.load(args)
    simulated = args.test.startswith("sim:")
    test = (
        EvaluationSweeps.simulated(args.test)
        if simulated
        else EvaluationSweeps.of(sets.load(args.test).select(args.only))
    )
    told = robustness.run(
        options.names(args),
        train,
        test,
        options.where(args),
        seeds=options.seeds(args),
        effort=options.effort(args),
        log=options.Log(),
    )
    told["box"] = robustness.box_answers(bundle.load(bundle.DEFAULT))
    told |= {"train": train.source, "digest": sets.digest(train), "format": str(train.format)} | score.provenance()
    table = robustness.table(told)
    put(args.out / "results.json", (json.dumps(told) + "\n").encode(), parents=True)
    put(args.out / "table.md", table.encode(), parents=True)
    put(args.out / "curves.svg", plots.robustness(told, args.strong.split(",")).encode(), parents=True)
    print(table)


def run_certainty(args: argparse.Namespace) -> None:
    """All of it; the page is named at the end."""
    test = sets.load(args.test).select(args.only) if args.test else None
    told = uncertainty.run(
        options.load(args), test, args.protocol, args.method, options.where(args), options.Log(), options.effort(args),
        args.seed,
    )  # fmt: skip
    print(uncertainty_report.write(told, args.out))


def run_calibrate(args: argparse.Namespace) -> None:
    """The table; the figures as JSON where asked for."""
    first, _, last = args.seeds.partition("-")
    if not first.isdigit() or not (last or first).isdigit() or int(last or first) < int(first):
        raise FormatError(f"--seeds {args.seeds} cannot be read; write FIRST-LAST, e.g. 201-208")
    seeds = range(int(first), int(last or first) + 1)
    told = sim_calibration.measure(seeds, args.ablate, options.Log(), jobs=args.jobs) | score.provenance()
    if args.json:
        put(args.json, (json.dumps(told, indent=1) + "\n").encode(), parents=True)
    print(sim_calibration.table(told))


def run_alignment(args: argparse.Namespace) -> None:
    """Measure, write, and say the least of it."""
    box = Classifier(bundle.load(args.bundle), SystemClock())
    told = contact_positions.measure(box, args.unseen, args.seen, args.hard, options.Log())
    args.out.mkdir(parents=True, exist_ok=True)
    put(args.out / "place.json", (json.dumps(told, indent=1) + "\n").encode(), parents=True)
    put(args.out / "place.svg", (contact_plot.draw(told) + "\n").encode(), parents=True)
    print("\n".join(contact_positions.lines(told)))
