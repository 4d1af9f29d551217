"""The commands about sweep sets: sets, sets describe, sets view, pull."""

from __future__ import annotations

import argparse
from pathlib import Path

from appliance.core.errors import FormatError
from appliance.core.storage import put
from train.cli import options
from train.cli.options import Add
from train.data import pull, summary
from train.reports import sweep_plot


def register(add: Add) -> None:
    """sets and pull."""
    parts = add("sets", run_known, "tell what sweep sets can be named, what is in some, or show one sweep")
    more = parts.add_subparsers(metavar="COMMAND")
    one = more.add_parser("describe", help="count what is in sets: materials by position and session, frames lost")
    one.add_argument("sets", nargs="+", metavar="SET", help=options.SET)
    one.set_defaults(run=run_describe)
    two = more.add_parser("view", help="draw one sweep: its taxels over time, and their spectrum")
    two.add_argument("sweep", metavar="SWEEP", help="an .npy that the box recorded, or a SET with --number")
    two.add_argument("--number", type=int, metavar="N", help="which sweep of the set, from 0 on")
    two.add_argument("--out", type=Path, required=True, metavar="FILE.svg")
    two.set_defaults(run=run_view)
    three = add("pull", run_pull, "fetch what a box has recorded and is not here yet")
    three.add_argument("host", metavar="HOST", help="as for ssh: user@box")
    three.add_argument("--from", default=pull.FOLDER, metavar="DIR", dest="folder", help=f"on the box ({pull.FOLDER})")
    three.add_argument("--out", type=Path, required=True, metavar="DIR", help="here; its folders are those of the box")
    three.add_argument("--port", type=int, metavar="N", help="of the box's sshd")
    three.add_argument(
        "--ssh-option", action="append", default=[], metavar="OPTION", help="as for ssh -o, e.g. User=pi"
    )


def run_known(args: argparse.Namespace) -> None:
    """What can be named."""
    print(summary.known())


def run_describe(args: argparse.Namespace) -> None:
    """What is in the sets named."""
    print("\n\n".join(summary.describe(spec) for spec in args.sets))


def run_view(args: argparse.Namespace) -> None:
    """The picture's name."""
    put(args.out, sweep_plot.draw(sweep_plot.load(args.sweep, args.number)).encode(), parents=True)
    print(args.out)


def run_pull(args: argparse.Namespace) -> None:
    """Say what was fetched and what was not."""
    chosen = [part for option in args.ssh_option for part in ("-o", option)]
    box = pull.RecordingHost(args.host, args.folder, [*chosen, *(["-p", str(args.port)] if args.port else [])])
    tally = pull.PullReport()
    try:
        pull.pull(box, args.out, tally, options.Log())
    finally:
        print(
            f"fetched {len(tally.fetched)}, there already {len(tally.there)}, refused {len(tally.refused)}", flush=True
        )
        _tell(tally, args.out)
    if bad := len(tally.refused) + len(tally.others):
        raise FormatError(f"{bad} recordings of {args.host} were not taken; the lines above say why")


def _tell(tally: pull.PullReport, out: Path) -> None:
    """A line for each kind of recording that needs somebody's eyes."""
    for names, what in (
        (tally.halves, "without its .json or .npy on the box; left there"),
        (
            tally.relabelled,
            f"described otherwise on the box; what is in {out} stays: remove its .npy and .json to take the box's",
        ),
        (
            tally.others,
            f"another sweep on the box under the same name; the one in {out} stays: remove it, or pull into another folder",
        ),
        (tally.refused, "refused"),
    ):
        if names:
            more = f" and {len(names) - pull.SHOWN} more" if len(names) > pull.SHOWN else ""
            print(f"{', '.join(sorted(names)[: pull.SHOWN])}{more}: {what}")
