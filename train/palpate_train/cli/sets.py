"""The commands `sets`, `sets describe`, `sets view`, `sets lerobot`, `sets mcap` and `pull`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from palpate.core.errors import FormatError
from palpate.core.outputs import Row, add_rows
from palpate.core.storage import put
from palpate.core.text import say
from palpate_train.arguments import numbers, options
from palpate_train.arguments.options import path, text
from palpate_train.arguments.program import Add, Run
from palpate_train.data import extras, lerobot_writer, mcap_writer, pull, sets, summary
from palpate_train.evaluate import set_warnings

# fmt: off
_PULL: tuple[Row, ...] = (
    ("host", "as for ssh: user@box", {"metavar": "HOST"}),
    ("--from", f"on the box ({pull.FOLDER})", text("DIR", pull.FOLDER, dest="folder")),
    options.folder("here; with the same folders as on the box"),
    ("--port", "of the box's sshd", text("N", type=int)),
    ("--ssh-option", "as for ssh -o, e.g. User=pi", text("OPTION", action="append", default=[])),
)
# fmt: on


def register(add: Add) -> None:
    """sets and pull."""
    commands = add("sets", run_known).add_subparsers(metavar="COMMAND")
    for name, about, run, rows in _of_sets():
        command = commands.add_parser(name, help=about)
        command.set_defaults(run=run)
        add_rows(command, *rows)
    command = add("pull", run_pull)
    command.set_defaults(resumes=True)
    add_rows(command, *_PULL)


def _of_sets() -> Iterator[tuple[str, str, Run, tuple[Row, ...]]]:
    """The commands below `sets`: name, description, function and options of each."""
    # fmt: off
    yield ("describe", "count what is in sets: materials by position and session, frames lost",
        run_describe, (("sets", options.SET, {"nargs": "+", "metavar": "SET"}),))
    yield ("view", "draw sweeps: taxels over time, spectrum, spectrogram", run_view, (
        ("sweep", f"an .npy that the box recorded, or a SET: {options.SET}", {"metavar": "SWEEP"}),
        ("--number", "which sweep of the set, from 0 on; of a page the first and the last",
            text("N[-LAST]", type=numbers.span("--number", "0-49"))),
        ("--out", "FILE.svg: the picture of one sweep; FILE.html: a page to leaf through the set",
            path(required=True)),
    ))
    yield ("lerobot", "write a set as a LeRobot data set, version 3.0", run_lerobot, (
        ("set", options.SET, {"metavar": "SET"}),
        ("out", "its folder, which is made", path("OUT")),
    ))
    yield ("mcap", "write sweeps as MCAP, which Foxglove draws", run_mcap, (
        ("set", f"{options.SET}; of a folder, verdicts too", {"metavar": "SET"}),
        ("out", "the new file, such as mine.mcap", path("OUT")),
    ))
    # fmt: on


def run_known(args: argparse.Namespace) -> None:
    """Print the sets that can be named."""
    say(*summary.known().split("\n"))


def run_describe(args: argparse.Namespace) -> None:
    """Print the content of the named sets."""
    for number, spec in enumerate(args.sets):
        say(*[""] * bool(number), *summary.describe(spec, set_warnings.of_set).split("\n"))


def run_view(args: argparse.Namespace) -> None:
    """Write the picture or the page and print its path."""
    with extras.needed_for("a picture of sweeps"):
        from palpate_train.reports import sweep_pages, sweep_plot
    kind, span = args.out.suffix.lower(), args.number
    if kind not in (".svg", ".html"):
        raise FormatError(
            f"--out {args.out}: one sweep is an .svg, a page of many an .html; name a file "
            "that ends so"
        )
    options.writable_file(args.out)
    if kind == ".svg":
        if span is not None and len(span) != 1:
            raise FormatError(
                f"--number {span.start}-{span.stop - 1}: an .svg shows one sweep; name an "
                ".html for more"
            )
        made = sweep_plot.draw(sweep_plot.load(args.sweep, None if span is None else span.start))
    else:
        found = sweep_plot.source(args.sweep)
        shown = sweep_pages.chosen(found, span)
        made = sweep_pages.page(found, shown, options.Log())
        if span is None and len(shown) < found.count:
            say(
                f"{len(shown)} of {found.count} sweeps, from all over the set; --number "
                "FIRST-LAST shows others"
            )
    put(args.out, made.encode(), parents=True)
    say(str(args.out))


def run_lerobot(args: argparse.Namespace) -> None:
    """Write the set and print its size."""
    sweeps = sets.load(args.set)
    lerobot_writer.write(sweeps, args.out)
    frames = len(sweeps) * sweeps.format.window
    say(f"{args.out}: {len(sweeps)} episodes of {len(sweeps.materials)} tasks, {frames} frames")


def run_mcap(args: argparse.Namespace) -> None:
    """Write the sweeps and print how many there are."""
    options.writable_file(args.out)
    sweeps, frames = mcap_writer.write(args.set, args.out)
    say(f"{args.out}: {sweeps} sweeps, {frames} frames")


def run_pull(args: argparse.Namespace) -> None:
    """Fetch recordings; print which were fetched and which were not."""
    ssh_options = [part for option in args.ssh_option for part in ("-o", option)]
    box = pull.RecordingHost(
        args.host, args.folder, [*ssh_options, *(["-p", str(args.port)] if args.port else [])]
    )
    report = pull.PullReport()
    try:
        pull.pull(box, args.out, report, options.Log())
    finally:
        say(
            f"fetched {len(report.fetched)}, there already {len(report.present)}, refused "
            f"{len(report.refused)}"
        )
        _print(report, args.out)
    if bad := len(report.refused) + len(report.different):
        raise FormatError(
            f"{bad} recordings of {args.host} were not taken; the lines above say why"
        )


def _print(report: pull.PullReport, out: Path) -> None:
    """Print a line for each kind of recording that needs attention."""
    relabelled = (
        f"the box has another description; the files in {out} stay: remove .npy and .json there to "
        "fetch the box's"
    )
    different = (
        f"the box has another sweep of the same name; the sweep in {out} stays: remove it, or pull "
        "into another folder"
    )
    for names, what in (
        (report.incomplete, "without its .json or .npy on the box; left there"),
        (report.relabelled, relabelled),
        (report.different, different),
        (report.refused, "refused"),
    ):
        if names:
            more = f" and {len(names) - pull.SHOWN} more" if len(names) > pull.SHOWN else ""
            say(f"{', '.join(sorted(names)[: pull.SHOWN])}{more}: {what}")
