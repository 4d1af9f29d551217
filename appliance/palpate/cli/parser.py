"""The command line of `palpate`: its commands in groups, and the options of each. It imports
neither numpy nor devices, so that help answers at once."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any, NamedTuple

from palpate import __version__
from palpate.cli import options
from palpate.core.outputs import add_options

EXIT_CODES = """\
exit codes: 0 done, and all is well; 1 another error or a failed check; 2 wrong
arguments; 65 a file of another format; 69 hardware, an address or a port is missing;
70 the model failed; 75 not possible now; 78 settings or bundle; 130 interrupted. `run`
waits for a skin or a serial port without limit; `check` says what is missing"""
Parser = argparse.ArgumentParser


class CommandEntry(NamedTuple):
    """A command. run: its function below `palpate`, imported when it is called. options: see
    `add_options`. actions: its actions, if it has any."""

    text: str
    run: str
    options: str = ""
    actions: Mapping[str, CommandEntry] = {}


_SKIN = "sim skin virtual seed port"
_TIMES = "trigger every sweep capture"
_Row = CommandEntry
# fmt: off
_BUNDLES = {
    "list": _Row("show which bundle runs, and which bundle `rollback` returns to",
        "cli.bundle_commands.run_list", "json"),
    "install": _Row("check the signed bundle in DIR, and run it on trial from the next start on",
        "cli.bundle_commands.run_install", "folder candidate other-skin"),
    "verify": _Row("check the signed bundle in DIR, and change nothing",
        "cli.bundle_commands.run_verify", "folder"),
    "commit": _Row("end the trial of the bundle that runs: it stays",
        "cli.bundle_commands.run_commit"),
    "rollback": _Row("go back to the previous bundle, from the next start on",
        "cli.bundle_commands.run_rollback"),
    "promote": _Row("run the candidate on trial from the next start on",
        "cli.bundle_commands.run_promote"),
}
_SKINS = {
    "list": _Row("show all profiles, with missing features, and whether a device was measured",
        "cli.skin_commands.run_list"),
    "detect": _Row("find connected skins and the profiles that fit; sends nothing, and opens only"
        " the ports on USB, or --port", "cli.skin_commands.run_detect", "port write"),
    "new": _Row("write a profile for the lines of numbers that a skin sends",
        "cli.skin_commands.run_new", "profile needed-port baud grid profiles"),
    "check": _Row("compare the skin with PROTOCOL.md part by part, or its bytes with its profile",
        "cli.skin_commands.run_check", f"{_SKIN} seconds"),
    "show": _Row("show the skin live: rate, noise, dead and stuck taxels; --web with a heat map",
        "cli.skin_commands.run_show", f"{_SKIN} local-page"),
    "align": _Row("show where the contact lies on the skin, and where it should",
        "cli.skin_commands.run_align", f"{_SKIN} local-page"),
}
GROUPS: Mapping[str, Mapping[str, CommandEntry]] = {
    "run": {
        "run": _Row("classify sweeps until SIGTERM", "cli.run_command.run",
            f"{_SKIN} sweeps {_TIMES} shadow"),
        "demo": _Row("watch simulated sweeps being classified", "cli.simulated_commands.run_demo",
            f"{_SKIN} sweeps raw"),
    },
    "look": {
        "check": _Row("test bundle, golden sweeps and devices, or show the settings",
            "cli.look_commands.run_check", f"{_SKIN} settings"),
        "status": _Row("show the state of the service, and its last verdicts",
            "cli.status_command.run", "json since network"),
        "watch": _Row("show the running box live: a line a verdict, or a page",
            "cli.look_commands.run_watch", "feed|watch-page"),
        "replay": _Row("classify a capture, a kept sweep or a folder of them again",
            "cli.look_commands.run_replay", "file mcap"),
    },
    "record and learn": {
        "record": _Row("keep each sweep with its label, for training; needs no bundle",
            "cli.record_command.run", f"{_SKIN} sweeps {_TIMES} out material position session"
            " format window target record-page"),
        "teach": _Row("learn materials from sweeps at the robot, without a desktop",
            "cli.teach_command.run", f"{_SKIN} {_TIMES} label good place attachment format window"
            " use unknown forget by steps teach-page"),
    },
    "bundles": {
        "bundles": _Row("list, install, verify, commit, rollback or promote bundles of this box",
            "cli.bundle_commands.run_list", "json", _BUNDLES),
    },
    "devices": {
        "skin": _Row("list, detect, describe, check, show or align skins", "", "", _SKINS),
        "bridge": _Row("pass answers on to other machines of the cell: TCP, Modbus TCP, ROS 2",
            "bridges.command.run"),
    },
}
# fmt: on
"""All commands of `palpate`, by heading."""
LOOK: Any = {"epilog": EXIT_CODES, "formatter_class": argparse.RawDescriptionHelpFormatter}
COMMANDS: Mapping[str, CommandEntry] = {n: c for group in GROUPS.values() for n, c in group.items()}


def parser(*names: str) -> Parser:
    """The parser of `palpate`, with the options of the commands `names`; of all without any."""
    width = max(map(len, COMMANDS))
    lines = ["Classifies the material that a robot has just touched."]
    for heading, commands in GROUPS.items():
        lines += ["", f"{heading}:", *(f"  {n:<{width}}  {c.text}" for n, c in commands.items())]
    lines += ["", "palpate COMMAND --help shows the options of a command."]
    top = Parser("palpate", "palpate COMMAND [OPTIONS]", "\n".join(lines), **LOOK)
    top.add_argument("--version", action="version", version=f"palpate {__version__}")
    top.set_defaults(**options.NO_SETTINGS, json=None, sweeps=None)
    subparsers = top.add_subparsers(
        dest="command", metavar="COMMAND", help=argparse.SUPPRESS, prog="palpate"
    )
    for name in names or COMMANDS:
        _add(subparsers, name, COMMANDS[name])
    return top


def _add(subparsers: Any, name: str, command: CommandEntry) -> None:
    """Add a command with its options and its actions."""
    about = f"{command.text[0].upper()}{command.text[1:]}."
    one = subparsers.add_parser(name, help=command.text, description=about, **LOOK)
    if name == "bridge":
        from palpate.bridges.options import add_arguments

        add_arguments(one)
    else:
        options.add_settings(one)
    add_options(one, command.options, options.OPTIONS)
    one.set_defaults(run=command.run)
    if command.actions:
        actions = one.add_subparsers(dest="action", metavar="ACTION", required=not command.run)
        for action, of_it in command.actions.items():
            _add(actions, action, of_it)


def arguments(name: str, words: list[str]) -> argparse.Namespace:
    """The arguments of one command; ends the program if they are wrong, or with help."""
    top = parser(*[name] if name in COMMANDS else [])
    return top.parse_args([name, *words])
