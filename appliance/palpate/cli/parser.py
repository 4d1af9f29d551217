"""The command line of `palpate`: its commands in groups, and the options of each.

It imports neither numpy nor devices, so that help answers at once.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_type_hints

from palpate import __version__
from palpate.bridges import options as bridges
from palpate.core import outputs
from palpate.core.config import TriggerConfig
from palpate.core.menu import CommandParser, Menu

EXIT_CODES = """\
exit codes: 0 done, and all is well; 1 another error or a failed check; 2 wrong
arguments; 65 a file of another format; 69 hardware, an address or a port is missing;
70 the model failed; 75 not possible now; 78 settings or bundle; 130 interrupted. `run`
waits for a skin or a serial port without limit; `check` names what is missing"""
MENU = Menu(
    "palpate",
    "Names the material that a robot has just touched.",
    {
        "run": {
            "run": "classify sweeps until SIGTERM",
            "demo": "watch simulated sweeps being classified",
            "bench": "measure latency, memory, start and processor share on this machine",
        },
        "look": {
            "check": "test bundle, golden sweeps and devices",
            "status": "show the state of the service, and its last verdicts",
            "watch": "show the running box live: a line a verdict, or a page",
            "align": "show where the contact lies on the skin, and where it should",
            "replay": "classify a capture, a kept sweep or a folder of them again",
            "config": "print each setting with its source",
        },
        "record and learn": {
            "record": "keep each sweep with its label, for training; needs no bundle",
            "teach": "learn materials from sweeps beside the robot, without a desktop",
        },
        "bundles": {
            "bundles": "list, install, verify, commit, rollback or promote bundles of this box",
        },
        "devices": {
            "skin": "list, detect, check or show skins, without a bundle",
            "bridge": "pass answers on to other machines of the cell: TCP, Modbus TCP, ROS 2",
        },
    },
    version=f"palpate {__version__}",
    ending=EXIT_CODES,
)
BUNDLE_ACTIONS = {
    "list": "show which bundle runs, and which bundle `rollback` returns to",
    "install": "check the signed bundle in DIR, and run it on trial from the next start on",
    "verify": "check the signed bundle in DIR, and change nothing",
    "commit": "end the trial of the bundle that runs: it stays",
    "rollback": "go back to the previous bundle, from the next start on",
    "promote": "run the candidate on trial from the next start on",
}
SKIN_ACTIONS = {
    "list": "show all profiles, with missing features, and whether a device was measured",
    "detect": "find connected skins and the profiles that fit; sends nothing",
    "check": "compare the skin with PROTOCOL.md part by part, or its bytes with its profile",
    "show": "show the skin live: rate, noise, dead and stuck taxels; --web with a heat map",
}
WEB_PORT, TEACH_PORT = 8137, 8138
"""Default ports of pages. Both pages can be served side by side."""


def parser(name: str) -> CommandParser:
    """The parser of one command."""
    text = MENU.commands[name]
    command = CommandParser(
        f"palpate {name}", description=f"{text[0].upper()}{text[1:]}.", epilog=EXIT_CODES
    )
    if name != "bridge":
        add_settings(command)
    if name in _ARGUMENTS:
        _ARGUMENTS[name](command)
    return command


def arguments(name: str, words: list[str]) -> argparse.Namespace:
    """The arguments of one command; ends the program if they are wrong, or with help."""
    command = parser(name)
    if name == "bridge":
        return bridges.parse(command, words)
    return command.parse(words)


def add_settings(command: argparse.ArgumentParser) -> None:
    """Add the options of all commands that have settings."""
    command.add_argument("--board", help="board file to use: firmware_config/board-NAME.toml")
    command.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one value"
    )
    command.add_argument(
        "--config-dir", type=Path, metavar="DIR", help="where skin.toml and the board files are"
    )


def _devices(add: Callable[..., argparse.Action]) -> None:
    add(
        "--sim",
        metavar="skin[:MATERIAL]|rest|replay:FILE",
        help="simulated tubes, one of them, a finger at rest on one, or a sweep set, instead of the"
        " devices",
    )
    add(
        "--skin",
        metavar="NAME",
        help="profile of the skin, or its file (skin.profile)",
    )
    add("--virtual", action="store_true", help="with --sim: do not wait for the time to pass")
    add("--seed", type=int, default=0, help="seed of the simulated tubes (default 0)")


def _skin_port(add: Callable[..., argparse.Action], text: str = "") -> None:
    text = text or "serial port of the skin (skin.port)"
    add("--port", dest="skin_port", metavar="PATH", help=text)


def _web(add: Callable[..., argparse.Action], text: str, port: int = WEB_PORT) -> None:
    add("--web", nargs="?", const=port, type=int, metavar="PORT", help=text)


def _one_skin(command: argparse.ArgumentParser) -> None:
    """Add the options of a command that uses one skin, also of several."""
    _devices(command.add_argument)
    _skin_port(command.add_argument)
    _finger(command.add_argument)


def _finger(add: Callable[..., argparse.Action], **more: Any) -> None:
    """Add --finger. more: `default=argparse.SUPPRESS` for a command that does not need one."""
    text = "of a box with several skins: the finger to use, [skins.NAME]"
    add("--finger", metavar="NAME", help=text, **more)


def _answers(command: argparse.ArgumentParser) -> None:
    command.add_argument("--sweeps", type=_count, metavar="N", help="stop after N answers")


def _trigger(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--trigger",
        choices=get_args(get_type_hints(TriggerConfig)["mode"]),
        metavar="MODE",
        help="trigger.mode: two-lines or one-line; serial: commands START and STOP; key: the space"
        " bar; timed",
    )
    command.add_argument(
        "--every", type=_short, metavar="S", help="timed: seconds from one start to the next (5)"
    )
    command.add_argument(
        "--sweep", type=_short, metavar="S", help="timed: seconds from start to stop (3)"
    )


def _capture(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--capture", type=Path, metavar="FILE", help="write all input to FILE, for replay"
    )


def _count(text: str) -> int:
    """A number of sweeps, for argparse."""
    if not text.isdecimal() or not 1 <= (number := int(text)) <= 1_000_000_000:
        raise argparse.ArgumentTypeError(
            f"{text} is not a number of sweeps; use a whole number from 1 on"
        )
    return number


def _seconds(text: str, least: float = 1.0) -> float:
    """A length of time, for argparse."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not least <= seconds <= 3600:
        raise argparse.ArgumentTypeError(
            f"{text} is not a number of seconds; use {least:g} to 3600"
        )
    return seconds


def _short(text: str) -> float:
    """The time of a sweep, for argparse."""
    return _seconds(text, least=0.1)


def _run(command: CommandParser) -> None:
    _devices(command.add_argument)
    _skin_port(command.add_argument)
    _answers(command)
    _trigger(command)
    _capture(command)
    command.add_argument(
        "--shadow",
        nargs="?",
        const="",
        metavar="DIR",
        help="also classify with the bundle in DIR, by default the candidate of the store; its"
        " answers are only compared",
    )


def _demo(command: CommandParser) -> None:
    _devices(command.add_argument)
    _skin_port(command.add_argument)
    _answers(command)
    command.add_argument("--raw", action="store_true", help="print the sentences alone")


def _bench(command: CommandParser) -> None:
    command.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    command.add_argument(
        "--seed", type=int, default=2000, help="seed of the simulated sweeps (default 2000)"
    )
    command.add_argument(
        "--references",
        type=Path,
        default=Path("build/references"),
        help="folder of fp32.onnx and paper_int8.onnx",
    )
    command.add_argument(
        "--part",
        choices=("memory", "stream", "hand"),
        help="measure a part alone, as JSON, with the sweeps of --acts",
    )
    command.add_argument("--acts", type=Path, metavar="FILE", help=argparse.SUPPRESS)


def _check(command: CommandParser) -> None:
    _devices(command.add_argument)
    _skin_port(command.add_argument)
    _answers(command)


def _status(command: CommandParser) -> None:
    command.add_argument("--json", action="store_true", help="print the state as JSON")


def _watch(command: CommandParser) -> None:
    shown = command.add_mutually_exclusive_group()
    shown.add_argument(
        "--json", action="store_true", help="the feed's lines as they are (PROTOCOL.md, part 4)"
    )
    _web(
        shown.add_argument,
        f"as a page (default port {WEB_PORT}); watch.address and its token open it to the network",
    )


def _align(command: CommandParser) -> None:
    _one_skin(command)
    _web(command.add_argument, f"also as a page on localhost (default port {WEB_PORT})")
    command.set_defaults(sweeps=None)


def _replay(command: CommandParser) -> None:
    command.add_argument("file", type=Path, metavar="FILE")
    _finger(command.add_argument, default=argparse.SUPPRESS)


def _record(command: CommandParser) -> None:
    _one_skin(command)
    _answers(command)
    _trigger(command)
    _capture(command)
    command.add_argument(
        "--out",
        type=outputs.folder,
        metavar="DIR",
        help="folder of the sweeps (default: sweeps/ in the store's folder)",
    )
    _labels(command)
    command.add_argument(
        "--format",
        metavar="RxC:TYPE:HZ",
        help="format of the skin, e.g. 5x3:float32:100 (default: the announced format)",
    )
    command.add_argument(
        "--window",
        type=partial(_seconds, least=0.01),
        metavar="S",
        help="seconds of each sweep that are kept (default 2)",
    )
    command.add_argument(
        "--target",
        type=_count,
        default=10,
        metavar="N",
        help="sweeps wanted per material and position (default 10)",
    )
    _web(
        command.add_argument,
        f"also as a page, on which the labels are set (default port {WEB_PORT}); watch.address"
        " opens it to the network",
    )


def _labels(command: CommandParser) -> None:
    for name in ("material", "position", "session"):
        command.add_argument(
            f"--{name}",
            default="",
            metavar="TEXT",
            help="until a command on the serial line or the page changes it",
        )


def _places(add: Callable[..., argparse.Action]) -> None:
    add("--position", default="1", metavar="TEXT", help="place on the object (default 1)")
    add(
        "--session", default="", metavar="TEXT", help="name of the session, if the skin is put back"
    )


def _teach(command: CommandParser) -> None:
    _one_skin(command)
    _trigger(command)
    _capture(command)
    add = command.add_argument
    add(
        "--label",
        action="append",
        default=[],
        metavar="NAME",
        dest="labels",
        help="record sweeps of this material; may be repeated, then one after another",
    )
    add(
        "--sweeps",
        type=_count,
        default=8,
        dest="good",
        metavar="N",
        help="number of good sweeps of each --label (default 8)",
    )
    _places(add)
    add("--format", metavar="RxC:TYPE:HZ", help="format of the skin, as for record")
    add(
        "--window",
        type=partial(_seconds, least=0.01),
        metavar="S",
        help="seconds of each sweep that are learnt (default 2)",
    )
    add(
        "--use",
        action="store_true",
        help="make a bundle of all sweeps, after those of --label; it runs on trial",
    )
    add(
        "--unknown",
        nargs="?",
        const=0,
        type=_count,
        metavar="NUMBER",
        help="take kept sweeps (store.black_box) that were answered `unknown, as sweep N` as sweeps"
        " of --label: those that sweep NUMBER belongs to. Without --label, list them",
    )
    add("--forget", metavar="NAME", help="teach the sweeps of this material no longer; they stay")
    add("--by", default="", metavar="NAME", help="who teaches, for the bundle (default: this user)")
    add("--json", action="store_true", help="with --use alone: print its steps as JSON")
    _web(add, f"also as a page, for a person at the robot (default port {TEACH_PORT})", TEACH_PORT)
    command.set_defaults(sweeps=None)


def _bundles(command: CommandParser) -> None:
    command.choose("action", BUNDLE_ACTIONS, default="list")
    command.only_for("install", "verify")(
        "folder", needed=True, nargs="?", type=Path, metavar="DIR", help="folder of the bundle"
    )
    command.only_for("list")("--json", action="store_true", help="print the list as JSON")
    install = command.only_for("install")
    install("--shadow", action="store_true", help="as the candidate of `run --shadow` instead")
    install(
        "--other-skin",
        action="store_true",
        help="even if another skin streams",
    )


def _skin(command: CommandParser) -> None:
    command.choose("action", SKIN_ACTIONS)
    _skin_port(
        command.only_for("detect", "check", "show"),
        "serial port of the skin; detect opens no other port",
    )
    _devices(command.only_for("check", "show"))
    _finger(command.only_for("check", "show"), default=argparse.SUPPRESS)
    command.only_for("check")(
        "--seconds",
        type=_seconds,
        metavar="S",
        help="time to listen, 1 to 3600 (default: 10; a skin with a profile: 2)",
    )
    command.only_for("detect")(
        "--write",
        action="store_true",
        help="with --port: also ask the skin, and send start commands",
    )
    _web(command.only_for("show"), f"also as a page on localhost (default port {WEB_PORT})")
    command.set_defaults(sweeps=None)


_ARGUMENTS: Mapping[str, Callable[[CommandParser], None]] = {
    "run": _run,
    "demo": _demo,
    "bench": _bench,
    "check": _check,
    "status": _status,
    "watch": _watch,
    "align": _align,
    "replay": _replay,
    "record": _record,
    "teach": _teach,
    "bundles": _bundles,
    "skin": _skin,
    "bridge": bridges.add_arguments,
}
