"""The commands that publish: reports, pages, figures, matrix, overview."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from palpate.core import outputs
from palpate.core.errors import FormatError
from palpate.core.storage import put
from palpate_studies import document_figures, matrix_table, overview_plot, pages, reports
from palpate_studies.study import DATA
from palpate_train.arguments import options
from palpate_train.arguments.program import Add
from palpate_train.metrics import score
from palpate_train.reports import provenance


def register(add: Add) -> None:
    """Add all commands of this module."""
    command = add("reports", run_reports)
    command.add_argument(
        "names", nargs="*", metavar="NAME", help=f"some of {', '.join(reports.names())}"
    )
    command.add_argument(
        "--list", action="store_true", help="run nothing: say which results are stale, and why"
    )
    options.add_where(command)
    command = add("pages", run_pages)
    command.add_argument(
        "names", nargs="*", metavar="NAME", help=f"some of {', '.join(pages.PAGES)} (all)"
    )
    command.add_argument(
        "--out",
        type=outputs.folder,
        required=True,
        metavar="DIR",
        help="a folder for each page is made there",
    )
    command.add_argument(
        "--results",
        type=Path,
        default=DATA,
        metavar="DIR",
        help=f"folder of the files of results ({DATA})",
    )
    add("figures", run_figures)
    _add_matrix(add)
    overview = add("overview", run_overview)
    overview.add_argument(
        "--out",
        type=outputs.file(".svg"),
        default=Path("docs/overview.svg"),
        metavar="FILE.svg",
        help="(docs/overview.svg)",
    )
    overview.add_argument("--material", default="wood", metavar="NAME", help="of the tube (wood)")


def _add_matrix(add: Add) -> None:
    matrix = add("matrix", run_matrix)
    matrix.add_argument(
        "results",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="of evaluate --json; several are joined",
    )
    matrix.add_argument("--out", type=outputs.file(".svg"), required=True, metavar="FILE.svg")
    matrix.add_argument(
        "--recordings", action="store_true", help="count recordings instead of windows"
    )
    matrix.add_argument(
        "--page",
        type=Path,
        metavar="FILE.md",
        help="write a table, ours beside the best of the others, between its <!-- matrix --> "
        "markers",
    )


def run_reports(args: argparse.Namespace) -> None:
    """List results, or make them one after another, and write the figures in documents. Raises
    FormatError for an unknown name, and at the end if one failed."""
    reports.require_project()
    if args.list:
        print(reports.table(reports.named(args.names)))
        return
    where = ["--jobs", str(args.jobs), "--cache", str(args.cache)] + (
        ["--scheduler", args.scheduler] if args.scheduler else []
    )
    reports.make(args.names, where, options.Log().keep)
    run_figures(args)


def run_pages(args: argparse.Namespace) -> None:
    """Write the pages and print their paths."""
    for path in pages.write(args.names, args.out, args.results):
        print(path)


def run_figures(args: argparse.Namespace) -> None:
    """Print each document and picture that has changed. Raises FormatError outside of the project's
    folder."""
    reports.require_project()
    for name in document_figures.write():
        print(name)


def run_matrix(args: argparse.Namespace) -> None:
    """Write the plot, and the table into a page; print their paths."""
    results: list[dict[str, Any]] = []
    for path in args.results:
        try:
            results += json.loads(path.read_bytes())
        except ValueError as e:
            raise FormatError(f"{path.name}: not of evaluate --json: {e}") from e
    matrix_table.draw(results, args.out, args.recordings)
    print(args.out)
    if args.page:
        matrix_table.insert(results, args.page)
        print(args.page)


def run_overview(args: argparse.Namespace) -> None:
    """Write the plot and print its path."""
    about = provenance.of(
        score.provenance()
        | {"set": f"sim:T-REAL/level-blind:{overview_plot.SEED}", "seed": overview_plot.SEED}
    )
    put(
        args.out, provenance.in_svg(overview_plot.draw(args.material), about).encode(), parents=True
    )
    print(args.out)
