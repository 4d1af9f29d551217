"""The command `palpate-train`. In: arguments. Out: an exit code; each group of commands is a module
of this package."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from appliance.core.errors import ApplianceError
from appliance.core.interrupts import INTERRUPTED, during_imports
from train.metrics import score

GROUPS = {
    "sets": ("sets", "pull"),
    "importing": ("import",),
    "evaluation": (
        "methods",
        "evaluate",
        "stress",
        "certainty",
        "calibrate",
        "cnn-curve",
        "alignment",
    ),
    "bundles": ("fit", "export", "pack", "references", "score", "parity"),
    "signing": ("sign",),
    "choose": ("choose",),
    "reports": (
        "reports",
        "figures",
        "paper",
        "chart",
        "development",
        "fabrics",
        "matrix",
        "overview",
        "report",
    ),
}
"""The modules of this package and their commands: only the one that is wanted is imported, since
that takes seconds."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code. An error of this project is one line on the error stream."""
    args = argparse.Namespace()
    try:
        words = sys.argv[1:] if argv is None else list(argv)
        with during_imports("palpate-train"):
            known = parser(words[0] if words else "")
        args = known.parse_args(words)
        score.provenance()  # read once, now: the code that runs is of this commit
        args.run(args)
        sys.stdout.flush()
    except ApplianceError as e:
        print(f"palpate-train: {e}", file=sys.stderr)
        return e.exit_code
    except BrokenPipeError:
        # the reader of the output has closed it; nothing can be printed any more, not even when the
        # process ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as e:
        # one of a library may name neither file nor cause
        print(
            f"palpate-train: {e if e.filename is None else f'{e.filename}: {e.strerror}'}",
            file=sys.stderr,
        )
        return ApplianceError.exit_code
    except KeyboardInterrupt:
        kept = (
            "goes on where it was"
            if getattr(args, "resumes", hasattr(args, "cache"))
            else "begins anew"
        )
        print(f"palpate-train: interrupted; the same command {kept}", file=sys.stderr)
        return INTERRUPTED
    return 0


def parser(wanted: str = "") -> argparse.ArgumentParser:
    """The parser of the command `wanted`, or of all where there is no such command; `args.run` is
    what the one given runs."""
    parser = argparse.ArgumentParser(
        prog="palpate-train", description="Trains, judges and exports Palpate's models."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(
        name: str, run: Callable[[argparse.Namespace], None], text: str
    ) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text.capitalize() + ".")
        command.set_defaults(run=run)
        return command

    of_wanted = [group for group, names in GROUPS.items() if wanted in names]
    for group in of_wanted or GROUPS:
        import_module(f"train.cli.{group}").register(add)
    return parser
