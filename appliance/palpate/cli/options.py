"""The options of the commands of `palpate`, each once, by name."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core import outputs
from palpate.core.outputs import Row

WEB_PORT, TEACH_PORT = 8137, 8138
"""Default ports of the pages of `palpate watch`; and of `palpate record` or `palpate teach`, which
run next to it."""
NO_SETTINGS: Mapping[str, Any] = {"board": None, "set": [], "config_dir": None, "unit": ""}
"""The options of `add_settings` where none is given."""


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= (number := int(text)) <= 1_000_000_000:
        raise argparse.ArgumentTypeError(f"{text} is not a number of sweeps; use one from 1 on")
    return number


def _seconds(text: str, least: float = 1.0) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not least <= seconds <= 3600:
        raise argparse.ArgumentTypeError(f"{text} is not a time; use {least:g} to 3600 seconds")
    return seconds


def _span(text: str) -> float:
    """Seconds of a number of minutes, hours or days."""
    unit = {"m": 60.0, "h": 3600.0, "d": 86400.0}.get(text[-1:])
    if unit is None or not text[:-1].isdecimal() or len(text) > 6:
        raise argparse.ArgumentTypeError(f"{text} is not a time; use 30m, 8h or 30d")
    return int(text[:-1]) * unit


_FLAG = {"action": "store_true"}
_FOLDER, _FILE = {"type": outputs.folder, "metavar": "DIR"}, {"type": Path, "metavar": "FILE"}
_LEAST_S, _LEAST_WINDOW = partial(_seconds, least=0.1), partial(_seconds, least=0.01)
_CHANGED = "until a command on the serial line or the page changes it"
_OPEN = "watch.address and its token open it to the network"


def _text(metavar: str = "TEXT", default: str | None = "", **more: Any) -> dict[str, Any]:
    return {"metavar": metavar, "default": default, **more}


def _count_of(metavar: str = "N", default: int | None = None, **more: Any) -> dict[str, Any]:
    return {"type": _count, "metavar": metavar, "default": default, **more}


def _time(kind: Callable[[str], float], metavar: str = "S") -> dict[str, Any]:
    return {"type": kind, "metavar": metavar, "default": None}


def _web(help: str, port: int = WEB_PORT) -> Row:
    text = f"{help} (default port {port})"
    return "--web", text, {"nargs": "?", "const": port, "type": int, "metavar": "PORT"}


def _instead(name: str, run: str, help: str) -> Row:
    return name, help, {"action": "store_const", "dest": "run", "const": run}


# fmt: off
OPTIONS: Mapping[str, Row] = {
    "sim": ("--sim", "simulated tubes, one of them, a finger at rest on one, or a sweep set,"
        " instead of the devices", _text("skin[:MATERIAL]|rest|replay:FILE", None)),
    "skin": ("--skin", "profile of the skin, or its file (skin.profile)", _text("NAME", None)),
    "virtual": ("--virtual", "with --sim: do not wait for the time to pass", _FLAG),
    "seed": ("--seed", "seed of the simulated tubes (default 0)", {"type": int, "default": 0}),
    "port": ("--port", "serial port of the skin (skin.port)",
        _text("PATH", None, dest="skin_port")),
    "sweeps": ("--sweeps", "stop after N answers", {"type": _count, "metavar": "N"}),
    "trigger": ("--trigger", "trigger.mode: two-lines or one-line; serial: commands START and STOP;"
        " key: the space bar; timed",
        {"choices": ("two-lines", "one-line", "serial", "key", "timed"), "metavar": "MODE"}),
    "every": ("--every", "timed: seconds from one start to the next (5)", _time(_LEAST_S)),
    "sweep": ("--sweep", "timed: seconds from start to stop (3)", _time(_LEAST_S)),
    "capture": ("--capture", "write all input to FILE, for replay", _FILE),
    "mcap": ("--mcap", "write the sweeps and their recorded verdicts to the new FILE, for Foxglove,"
        " instead", _FILE),
    "shadow": ("--shadow", "also classify with the bundle in DIR, by default the candidate of the"
        " store; its answers are only compared", _text("DIR", None, nargs="?", const="")),
    "raw": ("--raw", "print the sentences alone", _FLAG),
    "settings": _instead("--settings", "cli.look_commands.run_settings",
        "print each setting with its source instead"),
    "json": ("--json", "print it as JSON", _FLAG | {"default": argparse.SUPPRESS}),
    "network": ("--network", "what is open on which box of this network (zeroconf)", _FLAG),
    "since": ("--since", "what the verdicts of this time were, such as 8h or 30d (palpate bridge"
        " memory)", _time(_span, "SPAN")),
    "feed": ("--json", "the feed's lines as they are (PROTOCOL.md, part 4)", _FLAG),
    "watch-page": _web(f"as a page; {_OPEN}"),
    "record-page": _web(f"also as a page, on which the labels are set; {_OPEN}", TEACH_PORT),
    "teach-page": _web("also as a page, for a person at the robot", TEACH_PORT),
    "local-page": _web("also as a page on localhost"),
    "file": ("file", "the capture, sweep or folder", _FILE),
    "out": ("--out", "folder of the sweeps (default: sweeps/ in the store's folder)", _FOLDER),
    "material": ("--material", _CHANGED, _text()),
    "position": ("--position", _CHANGED, _text()),
    "session": ("--session", _CHANGED, _text()),
    "place": ("--position", "place on the object (default 1)", _text(default="1")),
    "attachment": ("--session", "name of the session, if the skin is put back", _text()),
    "format": ("--format", "format of the skin, e.g. 5x3:float32:100 (default: the announced"
        " format)", _text("RxC:TYPE:HZ", None)),
    "window": ("--window", "seconds of each sweep that are used (default 2)", _time(_LEAST_WINDOW)),
    "target": ("--target", "sweeps wanted per material and position (default 10)",
        _count_of(default=10)),
    "label": ("--label", "record sweeps of this material; may be repeated, then one after another",
        {"action": "append", "default": [], "metavar": "NAME", "dest": "labels"}),
    "good": ("--sweeps", "number of good sweeps of each --label (default 8)",
        _count_of(default=8, dest="good")),
    "use": ("--use", "make a bundle of all sweeps, after the sweeps of --label; it runs on trial",
        _FLAG),
    "unknown": ("--unknown", "take kept sweeps (store.black_box) that were answered `unknown, as"
        " sweep N` as sweeps of --label: those that sweep NUMBER belongs to. Without --label,"
        " list them",
        _count_of("NUMBER", nargs="?", const=0)),
    "forget": ("--forget", "teach the sweeps of this material no longer; they stay",
        _text("NAME", None)),
    "by": ("--by", "who teaches, for the bundle (default: this user)", _text("NAME")),
    "steps": ("--json", "with --use alone: print its steps as JSON", _FLAG),
    "folder": ("folder", "folder of the bundle", {"type": Path, "metavar": "DIR"}),
    "candidate": ("--shadow", "as the candidate of `run --shadow` instead", _FLAG),
    "other-skin": ("--other-skin", "even if another skin streams", _FLAG),
    "profile": ("name", "name of the profile", {"metavar": "NAME"}),
    "needed-port": ("--port", "serial port of the skin",
        _text("PATH", None, dest="skin_port", required=True)),
    "baud": ("--baud", "its speed (default: common speeds in turn)", _count_of()),
    "grid": ("--grid", "rows and columns (default: the squarest)", _text("RxC", None)),
    "profiles": ("--out", "folder of the profile (default: /etc/palpate/skins)", _FOLDER),
    "write": ("--write", "with --port: also ask the skin, and send start commands", _FLAG),
    "seconds": ("--seconds", "time to listen, 1 to 3600 (default: 10; a skin with a profile: 2)",
        _time(_seconds)),
}
# fmt: on
"""Options by name: flag, help, and the rest as argparse has it."""


def add_settings(command: argparse.ArgumentParser) -> None:
    """Add the options of all commands that have settings; NO_SETTINGS are their defaults."""
    add = partial(command.add_argument, default=argparse.SUPPRESS)
    add("--board", help="board file to use: firmware_config/board-NAME.toml")
    add("--set", action="append", metavar="SECTION.KEY=VALUE", help="override one value")
    add("--config-dir", type=Path, metavar="DIR", help="where skin.toml and the board files are")
    add("--unit", metavar="NAME", help="the unit palpate@NAME, with its own settings")
