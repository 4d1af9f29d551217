"""The commands that write pages and plots: reports, figures, paper, chart, development, fabrics,
matrix, overview, report."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from appliance.core.errors import FormatError
from appliance.core.storage import put
from train.arguments import options
from train.arguments.types import Add
from train.data import sets
from train.evaluation.evaluate import Where
from train.metrics import score
from train.models.methods import Effort
from train.reports import provenance
from train.studies import (
    chart_report,
    development_experiment,
    development_report,
    development_times,
    docs_pages,
    document_figures,
    fabrics_report,
    matrix_table,
    overview_plot,
    paper_experiment,
)


def register(add: Add) -> None:
    """reports, figures, paper, chart, development, fabrics, matrix, overview, report."""
    _add_reports(add)
    add("figures", run_figures)
    paper = _add_paper(add)
    chart = add("chart", run_chart)
    chart.add_argument(
        "--out",
        type=Path,
        default=Path("docs/chart"),
        metavar="DIR",
        help="where it goes (docs/chart)",
    )
    chart.add_argument(
        "--quick",
        action="store_true",
        help="small sets, hardly trained: to try everything out, not for figures",
    )
    chart.add_argument(
        "--kept", action="store_true", help="train nothing, chart what an earlier run has finished"
    )
    chart.add_argument(
        "--data",
        type=Path,
        default=os.environ.get("PALPATE_DATA"),
        metavar="DIR",
        help="folder of real sweeps (PALPATE_DATA)",
    )
    chart.add_argument("--seeds", type=int, default=1, metavar="N", help="of training: 1 to N (1)")
    chart.add_argument(
        "--draw",
        action="store_true",
        help="run nothing: draw the page of chart.json in --out again",
    )
    chart.add_argument(
        "--certainty",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="results.json of palpate-train certainty, for the touch time of its method",
    )
    development = _add_development(add)
    fabrics = _add_fabrics(add)
    for command in (paper, chart, development, fabrics):
        options.add_effort(command)
        options.add_where(command)
    matrix = add("matrix", run_matrix)
    matrix.add_argument(
        "results",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="of evaluate --json; several are joined",
    )
    matrix.add_argument("--out", type=Path, required=True, metavar="FILE.svg")
    matrix.add_argument(
        "--recordings", action="store_true", help="count recordings instead of windows"
    )
    matrix.add_argument(
        "--page",
        type=Path,
        metavar="FILE.md",
        help="write a table, ours beside the best of the others, between its <!-- matrix --> markers",
    )
    overview = add("overview", run_overview)
    overview.add_argument(
        "--out",
        type=Path,
        default=Path("docs/overview.svg"),
        metavar="FILE.svg",
        help="(docs/overview.svg)",
    )
    overview.add_argument("--material", default="wood", metavar="NAME", help="of the tube (wood)")


def _add_fabrics(add: Add) -> argparse.ArgumentParser:
    """fabrics."""
    fabrics = add("fabrics", run_fabrics)
    fabrics.add_argument(
        "--out",
        type=Path,
        default=Path("docs/fabricslide"),
        metavar="DIR",
        help="where it goes (docs/fabricslide)",
    )
    fabrics.add_argument(
        "--data",
        type=Path,
        default=os.environ.get("PALPATE_DATA"),
        metavar="DIR",
        help="folder of real sweeps (PALPATE_DATA)",
    )
    fabrics.add_argument(
        "--method",
        default="all",
        metavar="NAME[,NAME...]",
        help="run these; all others stay as results.json in --out has them (all)",
    )
    fabrics.add_argument(
        "--kept", action="store_true", help="train nothing, report what an earlier run has finished"
    )
    fabrics.add_argument(
        "--draw",
        action="store_true",
        help="run nothing: draw the page of results.json in --out again",
    )
    return fabrics


def _add_paper(add: Add) -> argparse.ArgumentParser:
    """paper."""
    paper = add("paper", run_paper)
    paper.add_argument(
        "--out",
        type=Path,
        default=Path("docs/paper"),
        metavar="DIR",
        help="where it goes (docs/paper)",
    )
    paper.add_argument(
        "--quick",
        action="store_true",
        help="small sets, hardly trained: to try everything out, not for figures",
    )
    paper.add_argument(
        "--draw",
        action="store_true",
        help="run nothing: draw the page of results.json in --out again",
    )
    paper.add_argument(
        "--kept", action="store_true", help="train nothing, report what an earlier run has finished"
    )
    paper.add_argument(
        "--method",
        metavar="NAME[,NAME...]",
        help="run these; all others stay as results.json in --out has them (all)",
    )
    return paper


def _add_reports(add: Add) -> None:
    command = add("reports", run_reports)
    command.add_argument(
        "pages", nargs="*", metavar="PAGE", help=f"some of {', '.join(docs_pages.names())}"
    )
    command.add_argument(
        "--list", action="store_true", help="run nothing: say which page is stale, and why"
    )
    command.add_argument(
        "--draw",
        action="store_true",
        help="measure nothing: draw them of the results that are there",
    )
    options.add_where(command)


def _add_development(add: Add) -> argparse.ArgumentParser:
    command = add("development", run_development)
    command.add_argument(
        "--out",
        type=Path,
        default=Path("docs/development"),
        metavar="DIR",
        help="where it goes (docs/development)",
    )
    command.add_argument(
        "--method", metavar="NAME[,NAME...]", help="(ours, as fit trains it, and the peers)"
    )
    command.add_argument(
        "--quick",
        action="store_true",
        help="small sets, hardly trained: to try everything out, not for figures",
    )
    command.add_argument(
        "--kept", action="store_true", help="train nothing, report what an earlier run has finished"
    )
    command.add_argument(
        "--data",
        type=Path,
        default=os.environ.get("PALPATE_DATA"),
        metavar="DIR",
        help="folder of real sweeps (PALPATE_DATA)",
    )
    command.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="of training: 1 to N (1)"
    )
    command.add_argument(
        "--leave-out",
        action="append",
        default=[],
        metavar="CASE",
        help="a case, or a point of its learning curve, that is not run, as the page names it",
    )
    command.add_argument(
        "--join",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="results.json of an earlier run, whose methods join those of this one",
    )
    again = command.add_mutually_exclusive_group()
    again.add_argument(
        "--draw",
        action="store_true",
        help="run nothing: draw the pages of results.json in --out again",
    )
    again.add_argument(
        "--times",
        action="store_true",
        help="measure the times of results.json in --out again, keep its accuracies, and draw the pages",
    )
    return command


def run_paper(args: argparse.Namespace) -> None:
    """Run the experiment; print the page's path. With --draw only write the page of what lies in
    --out."""
    if args.draw:
        print(paper_experiment.draw(args.out))
        return
    only = args.method.split(",") if args.method else ()
    print(
        paper_experiment.run(
            args.out, args.quick, options.where(args), options.Log(), options.effort(args), only
        )
    )


def run_reports(args: argparse.Namespace) -> None:
    """List, or make one page after another. Raises FormatError for an unknown page, and at the end
    where one failed."""
    docs_pages.require_project()
    if args.list:
        print(docs_pages.table(docs_pages.named(args.pages)))
        return
    where = ["--jobs", str(args.jobs), "--cache", str(args.cache)] + (
        ["--scheduler", args.scheduler] if args.scheduler else []
    )
    log = options.Log().keep
    if args.draw:
        docs_pages.draw(args.pages, log)
    else:
        docs_pages.make(args.pages, where, log)
    run_figures(args)


def run_matrix(args: argparse.Namespace) -> None:
    """Write the plot, and the table into a page; print their paths."""
    results: list[dict[str, Any]] = []
    for path in args.results:
        try:
            results += json.loads(path.read_bytes())
        except ValueError as e:
            raise FormatError(f"{path.name}: not what evaluate wrote: {e}") from e
    matrix_table.draw(results, args.out, args.recordings)
    print(args.out)
    if args.page:
        matrix_table.insert(results, args.page)
        print(args.page)


def run_fabrics(args: argparse.Namespace) -> None:
    """Evaluate, write the page and print its path; with --draw write it of what lies in --out."""
    if not args.draw:
        where, log, effort = options.where(args), options.Log(), options.effort(args)
        left_out = fabrics_report.run(args.out, args.data, options.names(args), where, log, effort)
        for name, why in left_out.items():
            print(f"left out: {name}: {why}")
    print(fabrics_report.draw(args.out))


def run_chart(args: argparse.Namespace) -> None:
    """Measure, write the page to --out and print its path; with --draw write it of what lies there.

    Raises FormatError where nothing is left to draw.
    """
    if args.draw:
        print(chart_report.write(args.out, chart_report.read(args.out), args.quick))
        return
    chart, effort = (
        (chart_report.QUICK, chart_report.QUICK_EFFORT)
        if args.quick
        else (chart_report.FULL, options.effort(args))
    )
    touch = chart_report.touch_shares(args.certainty)
    charting = chart_report.Charting(
        chart, options.where(args), options.Log(), args.data, effort, options.seeds(args), touch
    )
    dots = charting.dots()
    for name, why in charting.left_out.items():
        print(f"left out: {name}: {why}")
    if not dots:
        raise FormatError("no model is left to chart; see above, and run it without --kept")
    print(chart_report.write(args.out, dots, args.quick, charting.left_out))


def run_development(args: argparse.Namespace) -> None:
    """Evaluate, time, write the pages to --out and print their path; with --draw write them of what
    lies there, with --times after timing alone.

    Raises FormatError where no result of ours is there.
    """
    quick: bool = args.quick
    where, log = options.where(args), options.Log()
    effort = development_experiment.QUICK_EFFORT if quick else options.effort(args)
    figures = (
        _results(args.out / "results.json")
        if args.draw or args.times
        else _developed(args, where, log, effort)
    )
    if args.times or not (args.draw or args.kept):
        train = (
            sets.load(chart_report.QUICK.train).select(chart_report.QUICK.only)
            if quick
            else sets.load(development_times.SET)
        )
        figures["times"] = development_times.measured(
            figures["methods"], train, 1, where.cache, log, effort
        )
    print(development_report.write(figures, args.out, quick))


def _developed(
    args: argparse.Namespace, where: Where, log: options.Log, effort: Effort
) -> dict[str, Any]:
    """What `development` has evaluated, joined with earlier runs."""
    names = (
        development_experiment.QUICK_METHODS
        if args.quick
        else development_experiment.usual_methods()
    )
    cases = development_experiment.QUICK if args.quick else development_experiment.CASES
    run = development_experiment.Development(
        cases,
        tuple(args.method.split(",")) if args.method else names,
        where,
        log,
        args.data,
        effort,
        options.seeds(args),
        args.leave_out,
    )
    figures = development_experiment.join(run.results(), [_results(path) for path in args.join])
    for name, why in figures["left_out"].items():
        print(f"left out: {name}: {why}")
    return figures


def _results(path: Path) -> dict[str, Any]:
    """What an earlier run of `development` wrote. Raises FormatError where the file has another
    content."""
    keys = {"methods", "runs", "cases", "results", "left_out"}
    return options.earlier_run(
        path,
        "development",
        keys,
        "name the results.json of an earlier run",
        "name its results.json",
    )


def run_overview(args: argparse.Namespace) -> None:
    """Write the plot and print its path."""
    about = provenance.of(
        score.provenance() | {"set": f"sim:T-REAL:{overview_plot.SEED}", "seed": overview_plot.SEED}
    )
    put(
        args.out, provenance.in_svg(overview_plot.draw(args.material), about).encode(), parents=True
    )
    print(args.out)


def run_figures(args: argparse.Namespace) -> None:
    """Name each document that has changed. Raises FormatError outside of the project's folder."""
    docs_pages.require_project()
    for name in document_figures.write():
        print(name)
