"""The room of the commands that write what people look at: paper, stress, matrix. In: arguments. Out: pages, pictures."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from appliance.bundle import bundle
from appliance.core.errors import FormatError
from appliance.core.storage import put
from train.cli import options
from train.data import sets
from train.evaluation import robustness, robustness_data
from train.metrics import score
from train.reports import paper_experiment, plots


def register(add: Callable[..., argparse.ArgumentParser]) -> None:
    """The commands that write what people look at."""
    one = add("paper", run_paper, "run the paper's experiment on the simulated skin and tell it as a page")
    one.add_argument("--out", type=Path, default=Path("docs/paper"), metavar="DIR", help="where it goes (docs/paper)")
    one.add_argument(
        "--quick", action="store_true", help="small sets, hardly trained: everything is tried, nothing told"
    )
    one.add_argument("--kept", action="store_true", help="train nothing, tell what an earlier run has finished")
    two = add("stress", run_stress, "put trained methods under what goes wrong, one thing at a time")
    options.add_set(two)
    two.add_argument("--test", required=True, metavar="SET", help="what is stressed; simulated, it is drawn anew")
    two.add_argument("--method", required=True, metavar="NAME[,NAME...]", help="or all; see palpate-train methods")
    two.add_argument("--seeds", type=int, default=1, metavar="N", help="of training and stress: 1 to N (1)")
    two.add_argument("--out", type=Path, required=True, metavar="DIR", help="for results.json, table.md and curves.svg")
    two.add_argument("--strong", default="compact,minirocket", metavar="A,B", help="methods drawn with their bands")
    for command in (one, two):
        options.add_effort(command)
        options.add_where(command)
    three = add("matrix", run_matrix, "draw what evaluate wrote: methods by protocols")
    three.add_argument("results", type=Path, nargs="+", metavar="FILE", help="of evaluate --json; several are joined")
    three.add_argument("--out", type=Path, required=True, metavar="FILE.svg")
    three.add_argument("--recordings", action="store_true", help="count recordings instead of windows")


def run_paper(args: argparse.Namespace) -> None:
    """All of it; the page is named at the end."""
    print(paper_experiment.run(args.out, args.quick, options.where(args), options.Log(), options.effort(args)))


def run_stress(args: argparse.Namespace) -> None:
    """Curves as JSON and as a picture, and the table."""
    train = options.load(args)
    simulated = args.test.startswith("sim:")
    test = (
        robustness_data.Trial.simulated(args.test)
        if simulated
        else robustness_data.Trial.of(sets.load(args.test).select(args.only))
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
    told["box"] = robustness.box_trouble(bundle.load(bundle.DEFAULT))
    told |= {"train": train.source, "digest": sets.digest(train), "format": str(train.format)} | score.provenance()
    table = robustness.table(told)
    put(args.out / "results.json", (json.dumps(told) + "\n").encode(), parents=True)
    put(args.out / "table.md", table.encode(), parents=True)
    put(args.out / "curves.svg", plots.stress(told, args.strong.split(",")).encode(), parents=True)
    print(table)


def run_matrix(args: argparse.Namespace) -> None:
    """The picture's name."""
    results: list[dict[str, Any]] = []
    for path in args.results:
        try:
            results += json.loads(path.read_bytes())
        except ValueError as e:
            raise FormatError(f"{path.name}: not what evaluate wrote: {e}") from e
    put(args.out, plots.matrix(results, count="recording" if args.recordings else "window").encode(), parents=True)
    print(args.out)
