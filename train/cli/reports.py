"""The commands that write pages and pictures: paper, chart, matrix, overview, bench-table."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from appliance.core.errors import FormatError
from appliance.core.storage import put
from train.cli import options
from train.cli.options import Add
from train.reports import bench_table, chart_report, overview_plot, paper_experiment, plots


def register(add: Add) -> None:
    """paper, chart, matrix, overview, bench-table."""
    one = add("paper", run_paper, "run the paper's experiment on the simulated skin and tell it as a page")
    one.add_argument("--out", type=Path, default=Path("docs/paper"), metavar="DIR", help="where it goes (docs/paper)")
    one.add_argument(
        "--quick", action="store_true", help="small sets, hardly trained: everything is tried, nothing told"
    )
    one.add_argument("--kept", action="store_true", help="train nothing, tell what an earlier run has finished")
    three = add("chart", run_chart, "chart accuracy against cost: every method as a bundle, timed as on the box")
    three.add_argument("--out", type=Path, default=Path("docs/chart"), metavar="DIR", help="where it goes (docs/chart)")
    three.add_argument("--quick", action="store_true", help="small sets, hardly trained: all is tried, nothing told")
    three.add_argument("--kept", action="store_true", help="train nothing, chart what an earlier run has finished")
    three.add_argument("--data", type=Path, default=os.environ.get("PALPATE_DATA"), metavar="DIR",
                     help="folder of real sweeps (PALPATE_DATA)")  # fmt: skip
    three.add_argument("--seeds", type=int, default=1, metavar="N", help="of training: 1 to N (1)")
    three.add_argument("--certainty", type=Path, action="append", default=[], metavar="FILE",
                     help="results.json of palpate-train certainty, for the touch time of its method")  # fmt: skip
    for command in (one, three):
        options.add_effort(command)
        options.add_where(command)
    two = add("matrix", run_matrix, "draw what evaluate wrote: methods by protocols")
    two.add_argument("results", type=Path, nargs="+", metavar="FILE", help="of evaluate --json; several are joined")
    two.add_argument("--out", type=Path, required=True, metavar="FILE.svg")
    two.add_argument("--recordings", action="store_true", help="count recordings instead of windows")
    four = add("overview", run_overview, "draw the README's picture: a simulated sweep and what the box answers")
    four.add_argument(
        "--out", type=Path, default=Path("docs/overview.svg"), metavar="FILE.svg", help="(docs/overview.svg)"
    )
    four.add_argument("--material", default="wood", metavar="NAME", help="of the tube (wood)")
    five = add("bench-table", run_bench_table, "write the figures of make bench into the tables of documents")
    five.add_argument("figures", type=Path, metavar="FILE", help="of palpate bench --json")
    five.add_argument("documents", type=Path, nargs="+", metavar="FILE.md", help="each with <!-- bench --> markers")


def run_paper(args: argparse.Namespace) -> None:
    """All of it; the page is named at the end."""
    print(paper_experiment.run(args.out, args.quick, options.where(args), options.Log(), options.effort(args)))


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


def run_chart(args: argparse.Namespace) -> None:
    """All of it, written to --out; the page is named at the end. Raises FormatError where nothing is left to draw."""
    chart, effort = (
        (chart_report.QUICK, chart_report.QUICK_EFFORT) if args.quick else (chart_report.FULL, options.effort(args))
    )
    touch = chart_report.touch_shares(args.certainty)
    charting = chart_report.Charting(
        chart, options.where(args), options.Log(), args.data, effort, options.seeds(args), touch
    )
    found = charting.dots()
    for name, why in charting.left_out.items():
        print(f"left out: {name}: {why}")
    if not found:
        raise FormatError("no model is left to chart; see above, and run it without --kept")
    print(chart_report.write(args.out, found, args.quick, charting.left_out))


def run_overview(args: argparse.Namespace) -> None:
    """The picture's name."""
    put(args.out, overview_plot.draw(args.material).encode(), parents=True)
    print(args.out)


def run_bench_table(args: argparse.Namespace) -> None:
    """The table is printed, and stands in each document."""
    figures = bench_table.read(args.figures)
    bench_table.write(figures, args.documents)
    print(bench_table.table(figures))
