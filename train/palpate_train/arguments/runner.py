"""Runs one command of a program: help in groups, the command's own parser, exit codes.

A table holds the names and descriptions of all commands, so that help needs no import. The module
of a command is imported only if the command is called, since training takes seconds to import.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module

from palpate.core.errors import ApplianceError
from palpate.core.interrupts import INTERRUPTED, during_imports, during_work
from palpate.core.menu import Menu
from palpate_train.arguments.types import Run


@dataclass(frozen=True)
class Program:
    """A program and its commands.

    groups: the commands with their descriptions, by heading. modules: by module below `package`,
    the commands that it registers.
    """

    name: str
    about: str
    package: str
    groups: Mapping[str, Mapping[str, str]]
    modules: Mapping[str, tuple[str, ...]]

    @property
    def menu(self) -> Menu:
        """All commands in groups; no command is imported."""
        return Menu(self.name, self.about, self.groups)

    def descriptions(self) -> dict[str, str]:
        """The description of each command."""
        return self.menu.commands

    def parser(self, wanted: str) -> argparse.ArgumentParser:
        """The parser of one command; `args.run` is the function of the command."""
        parser = argparse.ArgumentParser(prog=self.name, description=self.about)
        commands = parser.add_subparsers(required=True, metavar="COMMAND")
        descriptions = self.descriptions()

        def add(name: str, run: Run) -> argparse.ArgumentParser:
            text = descriptions[name]
            command = commands.add_parser(
                name, help=text, description=f"{text[0].upper()}{text[1:]}."
            )
            command.set_defaults(run=run)
            return command

        module = next(name for name, commands in self.modules.items() if wanted in commands)
        import_module(f"{self.package}.{module}").register(add)
        return parser

    def run(self, argv: Sequence[str] | None = None) -> int:
        """Run one command; its exit code. An error of this project is a line on standard error."""
        words = sys.argv[1:] if argv is None else list(argv)
        answered = self.menu.answer(words)
        return self._run(words) if answered is None else answered

    def _run(self, words: Sequence[str]) -> int:
        args = argparse.Namespace()
        try:
            with during_imports(self.name):
                parser = self.parser(words[0])
                from palpate_train.metrics import score  # here: it imports onnxruntime
            args = parser.parse_args(words)
            args.words = words
            score.provenance()  # read now: a later commit is not of the code that runs
            with during_work():
                args.run(args)
            sys.stdout.flush()
        except ApplianceError as e:
            print(f"{self.name}: {e}", file=sys.stderr)
            return e.exit_code
        except BrokenPipeError:
            # the reader of the output has closed it; nothing can be printed any more, not even when
            # the process ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except (OSError, MemoryError) as e:
            print(f"{self.name}: {_fault(e)}", file=sys.stderr)
            return ApplianceError.exit_code
        except KeyboardInterrupt:
            resumes = getattr(args, "resumes", hasattr(args, "cache"))
            kept = "goes on where it was" if resumes else "begins anew"
            print(f"{self.name}: interrupted; the same command {kept}", file=sys.stderr)
            return INTERRUPTED
        return 0


def _fault(e: OSError | MemoryError) -> str:
    """A message about an error of the system. It has a remedy if there is one."""
    if isinstance(e, MemoryError):
        cause = f": {e}" if str(e) else ""
        return f"not enough memory{cause}; use fewer sweeps (--only), or a machine with more"
    # an error of a library may name neither file nor cause
    return str(e) if e.filename is None else f"{e.filename}: {e.strerror}"
