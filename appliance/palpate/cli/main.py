"""The command `palpate`: help, or one command with its exit code."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module

from palpate.cli import parser
from palpate.core.errors import ApplianceError
from palpate.core.interrupts import INTERRUPTED, during_imports
from palpate.core.log import printable, to_stderr

COMMANDS: Mapping[str, str] = {
    "run": "cli.run_command.run",
    "demo": "cli.simulated_commands.run_demo",
    "bench": "cli.simulated_commands.run_bench",
    "check": "cli.look_commands.run_check",
    "status": "cli.look_commands.run_status",
    "watch": "cli.look_commands.run_watch",
    "align": "cli.look_commands.run_align",
    "replay": "cli.look_commands.run_replay",
    "config": "cli.look_commands.run_config",
    "record": "cli.record_command.run",
    "teach": "cli.teach_command.run",
    "bundles": "cli.bundle_commands.run",
    "skin": "cli.skin_commands.run",
    "bridge": "bridges.command.run",
}
"""The functions of the commands, below `palpate`. They are imported when they are needed."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; its exit code."""
    _fill_streams()
    # One loop, one thread. Otherwise OpenBLAS starts a thread for each core when numpy is imported,
    # and a product in the loop waits for a thread that a busy processor does not run.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    words = sys.argv[1:] if argv is None else list(argv)
    try:
        if (answered := parser.MENU.answer(words)) is not None:
            sys.stdout.flush()
            return answered
        with during_imports("palpate"):
            args = parser.arguments(words[0], words[1:])
            to_stderr()
            run = _function(words[0])
        code = run(args)
        _flush()
        return code
    except ApplianceError as e:
        print(printable(f"palpate: {e}"), file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        print("palpate: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        print("palpate: the reader of standard output has closed it", file=sys.stderr)
        _give_up_output()
        return 1
    except OSError as e:
        print(
            f"palpate: {e.filename or 'a file'}: {e.strerror}; check its path and who may use it",
            file=sys.stderr,
        )
        return 1


def _fill_streams() -> None:
    """Open /dev/null for each standard stream that is closed. Otherwise the next file that is
    opened, a device for example, would take its number, and Python would have no stream."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115


def _flush() -> None:
    """Write the rest of standard output; what a full disk or a slow reader does not take is
    lost."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except (OSError, ValueError) as e:
        print(f"palpate: standard output: {e}; the rest of it is lost", file=sys.stderr)
        _give_up_output()


def _give_up_output() -> None:
    """Write nothing more to standard output, not even at the end of the interpreter."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _function(name: str) -> Callable[[argparse.Namespace], int]:
    module, _, function = COMMANDS[name].rpartition(".")
    found: Callable[[argparse.Namespace], int] = getattr(
        import_module(f"palpate.{module}"), function
    )
    return found
