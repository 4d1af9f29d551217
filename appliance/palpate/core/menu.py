"""The command line of a program with several commands: help in groups, and advice for a misspelt
word.

It imports next to nothing, so that help answers at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from typing import Any, NoReturn

from palpate.core.schema import closest

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

        From here on, characters that the output cannot show are replaced.
        Returns the exit code, or None where the first word is a command.
        """
        _replace_unprintable()
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
    """The parser of one command. Its errors are one line, as all errors of the program are.

    The first word after the command can choose an action. Options can then be for some actions.
    """

    def __init__(self, *args: Any, **more: Any) -> None:
        more.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(*args, **more)
        self.actions: Mapping[str, str] = {}
        self._kind = ""
        self._some: list[tuple[tuple[str, ...], argparse.Action, bool]] = []

    def choose(self, kind: str, actions: Mapping[str, str], default: str | None = None) -> None:
        """Let the first word choose one of the `actions`, which have descriptions.

        kind: "action" or another name for all of them; also the name of the argument. default: the
        action without a word; None if the word is required.
        """
        self._kind, self.actions = kind, actions
        self.add_argument(
            kind,
            metavar=kind.upper(),
            type=one_of(kind, [*actions]),
            nargs="?" if default else None,
            default=default,
            help=f"{', '.join(actions)}" + (f" (default {default})" if default else ""),
        )
        width = max(map(len, actions))
        lines = [f"  {name:<{width}}  {text}" for name, text in actions.items()]
        self.description = "\n".join([self.description or "", "", *lines])

    def only_for(self, *actions: str) -> Callable[..., argparse.Action]:
        """A function like add_argument, for arguments of these actions alone, under a heading. With
        needed=True the actions do not go without the argument.
        """
        group = self.add_argument_group(", ".join(actions))

        def add(*names: str, needed: bool = False, **how: Any) -> argparse.Action:
            option = group.add_argument(*names, **how)
            self._some.append((actions, option, needed))
            return option

        return add

    def actions_of(self, option: argparse.Action) -> tuple[str, ...]:
        """The actions that an option is for; () if it is for all."""
        return next((actions for actions, one, _ in self._some if one is option), ())

    def parse(self, words: Sequence[str]) -> argparse.Namespace:
        """The arguments; ends the program if they are wrong, or with help."""
        if not self.actions:
            return self.parse_args(words)
        args = self.parse_intermixed_args(words)
        action = getattr(args, self._kind)
        for actions, option, needed in self._some:
            value = getattr(args, option.dest, option.default)  # absent: argparse.SUPPRESS
            name = option.option_strings[0] if option.option_strings else option.metavar
            if needed and action in actions and value is None:
                self.error(f"{action} needs {name}")
            if action not in actions and value != option.default:
                self.error(f"{name} is for {' and '.join(actions)}, not for {action}")
        return args

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


def _replace_unprintable() -> None:
    """Show ? for a character that the terminal's encoding lacks: it must not end the program."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")
