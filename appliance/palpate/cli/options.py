"""The options of each command of `palpate`, as functions that add them to its parser."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core import outputs

WEB_PORT, TEACH_PORT = 8137, 8138
"""Default ports of pages. Both pages can be served side by side."""
NO_SETTINGS: Mapping[str, Any] = {"board": None, "set": [], "config_dir": None, "unit": ""}
"""The options of `add_settings` where none is given."""
Parser = argparse.ArgumentParser
Add = Callable[..., argparse.Action]


def run(command: Parser) -> None:
    _devices(command.add_argument)
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


def demo(command: Parser) -> None:
    _devices(command.add_argument)
    _answers(command)
    command.add_argument("--raw", action="store_true", help="print the sentences alone")


def check(command: Parser) -> None:
    _devices(command.add_argument)
    command.set_defaults(sweeps=None)
    what = command.add_mutually_exclusive_group()
    what.add_argument(
        "--settings",
        action="store_const",
        dest="run",
        const="cli.settings_command.run",
        help="print each setting with its source instead",
    )
    what.add_argument(
        "--bench",
        action="store_const",
        dest="run",
        const="cli.simulated_commands.run_bench",
        help="measure latency, memory, start and processor share of this machine instead, with"
        " sweeps of --seed (default 2000)",
    )
    command.add_argument("--json", type=Path, metavar="FILE", help="bench: write the figures")
    command.add_argument(
        "--references",
        type=Path,
        default=Path("build/references"),
        metavar="DIR",
        help="bench: folder of fp32.onnx and paper_int8.onnx",
    )
    command.add_argument(
        "--part",
        choices=("memory", "stream"),
        help="bench: measure a part alone, as JSON, with the sweeps of --acts",
    )
    command.add_argument("--acts", type=Path, metavar="FILE", help=argparse.SUPPRESS)


def status(command: Parser) -> None:
    command.add_argument("--json", action="store_true", help="print the state as JSON")


def watch(command: Parser) -> None:
    shown = command.add_mutually_exclusive_group()
    shown.add_argument(
        "--json", action="store_true", help="the feed's lines as they are (PROTOCOL.md, part 4)"
    )
    _web(
        shown.add_argument,
        f"as a page (default port {WEB_PORT}); watch.address and its token open it to the network",
    )


def replay(command: Parser) -> None:
    command.add_argument("file", type=Path, metavar="FILE")


def record(command: Parser) -> None:
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


def _labels(command: Parser) -> None:
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


def teach(command: Parser) -> None:
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
    _lesson(add)
    _web(add, f"also as a page, for a person at the robot (default port {TEACH_PORT})", TEACH_PORT)
    command.set_defaults(sweeps=None)


def _lesson(add: Add) -> None:
    """Add what is done with the sweeps."""
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


def nothing(command: Parser) -> None:
    """A command without options of its own."""


def as_json(command: Parser) -> None:
    command.add_argument(
        "--json", action="store_true", default=argparse.SUPPRESS, help="print the list as JSON"
    )
    command.set_defaults(json=False)


def bundle_folder(command: Parser) -> None:
    command.add_argument("folder", type=Path, metavar="DIR", help="folder of the bundle")


def install(command: Parser) -> None:
    bundle_folder(command)
    command.add_argument(
        "--shadow", action="store_true", help="as the candidate of `run --shadow` instead"
    )
    command.add_argument("--other-skin", action="store_true", help="even if another skin streams")


def detect(command: Parser) -> None:
    _skin_port(command.add_argument, "serial port of the skin; no other port is opened")
    command.add_argument(
        "--write",
        action="store_true",
        help="with --port: also ask the skin, and send start commands",
    )


def skin_check(command: Parser) -> None:
    _looked_at(command)
    command.add_argument(
        "--seconds",
        type=_seconds,
        metavar="S",
        help="time to listen, 1 to 3600 (default: 10; a skin with a profile: 2)",
    )


def _looked_at(command: Parser) -> None:
    _devices(command.add_argument)
    command.set_defaults(sweeps=None)


def align(command: Parser) -> None:
    _one_skin(command)
    _web(command.add_argument, f"also as a page on localhost (default port {WEB_PORT})")


def show(command: Parser) -> None:
    _looked_at(command)
    _web(command.add_argument, f"also as a page on localhost (default port {WEB_PORT})")


def bridge(command: Parser) -> None:
    from palpate.bridges import options

    options.add_arguments(command)


def add_settings(command: Parser) -> None:
    """Add the options of all commands that have settings; NO_SETTINGS are their defaults."""
    add = partial(command.add_argument, default=argparse.SUPPRESS)
    add("--board", help="board file to use: firmware_config/board-NAME.toml")
    add("--set", action="append", metavar="SECTION.KEY=VALUE", help="override one value")
    add("--config-dir", type=Path, metavar="DIR", help="where skin.toml and the board files are")
    add("--unit", metavar="NAME", help="the unit palpate@NAME, with its own settings")


def _devices(add: Add) -> None:
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
    _skin_port(add)


def _skin_port(add: Add, text: str = "") -> None:
    text = text or "serial port of the skin (skin.port)"
    add("--port", dest="skin_port", metavar="PATH", help=text)


def _web(add: Add, text: str, port: int = WEB_PORT) -> None:
    add("--web", nargs="?", const=port, type=int, metavar="PORT", help=text)


def _one_skin(command: Parser) -> None:
    """Add the options of a command that uses the skin."""
    _devices(command.add_argument)
    command.set_defaults(sweeps=None)


def _answers(command: Parser) -> None:
    command.add_argument("--sweeps", type=_count, metavar="N", help="stop after N answers")


def _trigger(command: Parser) -> None:
    command.add_argument(
        "--trigger",
        choices=("two-lines", "one-line", "serial", "key", "timed"),
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


def _capture(command: Parser) -> None:
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
