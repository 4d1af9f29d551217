"""The command `palpate`: help, or one command with its exit code."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module

from appliance.cli import parser
from appliance.core.errors import ApplianceError
from appliance.core.interrupts import INTERRUPTED, during_imports
from appliance.core.log import to_stderr

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
    "enrol": "cli.enrol_command.run",
    "bundles": "cli.bundle_commands.run",
    "skin": "cli.skin_commands.run",
    "bridge": "bridges.command.run",
}
"""The functions of the commands, below `appliance`. They are imported when they are needed."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; its exit code."""
    words = sys.argv[1:] if argv is None else list(argv)
    answered = parser.MENU.answer(words)
    if answered is not None:
        return answered
    args = parser.arguments(words[0], words[1:])
    to_stderr()
    try:
        with during_imports("palpate"):
            run = _function(words[0])
        code = run(args)
        sys.stdout.flush()
        return code
    except ApplianceError as e:
        print(f"palpate: {e}", file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        print("palpate: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # the reader of standard output has closed it: write nothing more to it, not even at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as e:
        print(
            f"palpate: {e.filename or 'a file'}: {e.strerror}; check its path and who may use it",
            file=sys.stderr,
        )
        return 1


def _function(name: str) -> Callable[[argparse.Namespace], int]:
    module, _, function = COMMANDS[name].rpartition(".")
    found: Callable[[argparse.Namespace], int] = getattr(
        import_module(f"appliance.{module}"), function
    )
    return found
