"""The commands that publish: reports, pages, tables, overview."""

from __future__ import annotations

import argparse
from pathlib import Path

from palpate.core.outputs import Row, add_rows
from palpate.core.storage import put
from palpate_studies import overview_plot, pages, reports, tables
from palpate_studies.study import DATA
from palpate_train.arguments import options
from palpate_train.arguments.options import FLAG, WHERE
from palpate_train.arguments.program import Add
from palpate_train.metrics import score
from palpate_train.reports import provenance

OVERVIEW = Path("docs/overview.svg")


# fmt: off
_REPORTS: tuple[Row, ...] = (
    ("names", f"some of {', '.join(reports.names())}", {"nargs": "*", "metavar": "NAME"}),
    ("--list", "run nothing: say which results are stale, and why", FLAG),
    *WHERE,
)
_PAGES: tuple[Row, ...] = (
    ("names", f"some of {', '.join(pages.PAGES)} (all)", {"nargs": "*", "metavar": "NAME"}),
    options.folder("a folder for each page is made there"),
    ("--results", f"folder of the files of results ({DATA})", options.path("DIR", default=DATA)),
)
# fmt: on


def register(add: Add) -> None:
    """Add all commands of this module."""
    add_rows(add("reports", run_reports), *_REPORTS)
    add_rows(add("pages", run_pages), *_PAGES)
    add("tables", run_tables)
    add("overview", run_overview)


def run_reports(args: argparse.Namespace) -> None:
    """List results, or make them one after another, and write the tables in documents. Raises
    FormatError for an unknown name, and at the end if one failed."""
    reports.require_project()
    if args.list:
        print(reports.table(reports.named(args.names)))
        return
    where = ["--jobs", str(args.jobs), "--cache", str(args.cache)] + (
        ["--scheduler", args.scheduler] if args.scheduler else []
    )
    reports.make(args.names, where, options.Log().keep)
    run_tables(args)


def run_pages(args: argparse.Namespace) -> None:
    """Write the pages and print their paths."""
    for path in pages.write(args.names, args.out, args.results):
        print(path)


def run_tables(args: argparse.Namespace) -> None:
    """Write tables and the chart of results; print each file that has changed. Raises FormatError
    outside of the project's folder."""
    reports.require_project()
    for name in tables.write():
        print(name)


def run_overview(args: argparse.Namespace) -> None:
    """Write the plot and print its path. Raises FormatError outside of the project's folder."""
    reports.require_project()
    about = provenance.of(
        score.provenance()
        | {"set": f"sim:T-REAL/level-blind:{overview_plot.SEED}", "seed": overview_plot.SEED}
    )
    put(OVERVIEW, provenance.in_svg(overview_plot.draw("wood"), about).encode())
    print(OVERVIEW)
