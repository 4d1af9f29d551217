"""A program with commands: an argparse parser for each, and exit codes.

Only the module of the command that is called is imported, since training takes seconds to import.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module

from palpate.core.errors import ApplianceError
from palpate.core.interrupts import INTERRUPTED, during_imports, during_work
from palpate.core.text import replace_unprintable, say

Run = Callable[[argparse.Namespace], None]
"""Runs a command."""
Add = Callable[[str, Run], argparse.ArgumentParser]
"""The parser of a command, given its name and the function that runs it."""


@dataclass(frozen=True)
class Program:
    """A program and its commands. package: where the modules of the commands are. commands: by
    name, the module and a description. The function `register(add)` of a module adds the options
    of its commands."""

    name: str
    about: str
    package: str
    commands: Mapping[str, tuple[str, str]]

    def parser(self, *wanted: str) -> argparse.ArgumentParser:
        """The parser, with the options of the commands `wanted` alone; `args.run` is the function
        of the command."""
        parser = argparse.ArgumentParser(prog=self.name, description=self.about)
        subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
        parsers = {
            name: subparsers.add_parser(
                name, help=text, description=f"{text[0].upper()}{text[1:]}."
            )
            for name, (_, text) in self.commands.items()
        }

        def add(name: str, run: Run) -> argparse.ArgumentParser:
            parsers[name].set_defaults(run=run)
            return parsers[name]

        for module in {self.commands[name][0] for name in wanted if name in self.commands}:
            import_module(f"{self.package}.{module}").register(add)
        return parser

    def run(self, argv: Sequence[str] | None = None) -> int:
        """Run one command; its exit code. An error of this project is a line on standard error."""
        words = sys.argv[1:] if argv is None else list(argv)
        replace_unprintable()
        # OpenBLAS would start a thread for each core. They spend as much of a processor again in
        # waiting for one another, and their sums differ from machine to machine.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        args = argparse.Namespace()
        try:
            with during_imports(self.name):
                parser = self.parser(*words[:1])
            args = parser.parse_args(words or ["--help"])
            args.words = words
            with during_imports(self.name):
                from palpate_train.metrics import score  # here: it imports onnxruntime
            score.provenance()  # read now: a later commit is not of the code that runs
            with during_work():
                args.run(args)
            sys.stdout.flush()
        except ApplianceError as e:
            say(f"{self.name}: {e}", file=sys.stderr)
            return e.exit_code
        except BrokenPipeError:
            # the reader of the output has closed it; nothing can be printed any more, not even when
            # the process ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except (OSError, MemoryError) as e:
            say(f"{self.name}: {_fault(e)}", file=sys.stderr)
            return ApplianceError.exit_code
        except KeyboardInterrupt:
            resumes = getattr(args, "resumes", hasattr(args, "cache"))
            kept = "goes on where it was" if resumes else "begins anew"
            say(f"{self.name}: interrupted; the same command {kept}", file=sys.stderr)
            return INTERRUPTED
        return 0


def _fault(e: OSError | MemoryError) -> str:
    """A message about an error of the system. It has a remedy if there is one."""
    if isinstance(e, MemoryError):
        cause = f": {e}" if str(e) else ""
        return f"not enough memory{cause}; use fewer sweeps (--only), or a machine with more"
    # an error of a library may give neither file nor cause
    return str(e) if e.filename is None else f"{e.filename}: {e.strerror}"
