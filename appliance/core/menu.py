"""The command line of a program with several commands: help in groups, and advice for a misspelt
word.

It imports next to nothing, so that help answers at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

from appliance.core.schema import closest

USAGE_ERROR = 2
"""Exit code of argparse for arguments that it refuses."""
HELP = ("-h", "--help", "help")


@dataclass(frozen=True, slots=True)
class Menu:
    """The commands of a program.

    groups: the commands with their descriptions, by heading. version: the answer to --version, ""
    without this option. ending: last lines of the help.
    """

    program: str
    about: str
    groups: Mapping[str, Mapping[str, str]]
    version: str = ""
    ending: str = ""

    @property
    def commands(self) -> dict[str, str]:
        """The descriptions of all commands, by name."""
        return {name: text for group in self.groups.values() for name, text in group.items()}

    def help(self) -> str:
        """All commands in groups."""
        width = max(map(len, self.commands))
        lines = [f"usage: {self.program} COMMAND [OPTIONS]", "", self.about]
        for heading, commands in self.groups.items():
            lines += ["", f"{heading}:"]
            lines += [f"  {name:<{width}}  {text}" for name, text in commands.items()]
        lines += ["", f"{self.program} COMMAND --help shows the options of a command."]
        return "\n".join(lines + ["", self.ending] * bool(self.ending))

    def answer(self, words: Sequence[str]) -> int | None:
        """Answer arguments that name no command, with help, the version or advice.

        Returns the exit code, or None where the first word is a command.
        """
        if not words or words[0] in HELP:
            print(self.help())
        elif words[0] == "--version" and self.version:
            print(self.version)
        elif words[0] not in self.commands:
            hint = advice(words[0], self.commands, f"`{self.program} --help` lists them")
            print(f"{self.program}: there is no command {words[0]!r}; {hint}", file=sys.stderr)
            return USAGE_ERROR
        else:
            return None
        return 0


class CommandParser(argparse.ArgumentParser):
    """A parser whose error is one line, as all errors of the program are."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE_ERROR, f"{self.prog}: {message}; `{self.prog} --help` shows the options\n")


def advice(word: str, known: Iterable[str], otherwise: str) -> str:
    """Which of the `known` names a misspelt word may stand for; `otherwise` if none is similar."""
    near = closest(word, known)
    return f"did you mean {near[0]!r}?" if near else otherwise


def one_of(kind: str, known: Sequence[str]) -> Callable[[str], str]:
    """An argparse type for one of the `known` names; `kind` names it in the error."""

    def read(text: str) -> str:
        if text not in known:
            hint = advice(text, known, f"use one of {', '.join(known)}")
            raise argparse.ArgumentTypeError(f"there is no {kind} {text!r}; {hint}")
        return text

    return read
