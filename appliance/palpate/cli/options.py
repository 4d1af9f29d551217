"""The options of the commands of `palpate`, each once, by name."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core import outputs

WEB_PORT, TEACH_PORT = 8137, 8138
"""Default ports of the pages of `palpate watch`; and of `palpate record` or `palpate teach`, which
run beside it."""
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


def _option(name: str, help: str, **how: Any) -> tuple[str, dict[str, Any]]:
    return name, {"help": help, **how}


def _flag(name: str, help: str, **how: Any) -> tuple[str, dict[str, Any]]:
    return _option(name, help, action="store_true", **how)


def _text(name: str, help: str, metavar: str = "TEXT", default: str = "", **how: Any) -> Any:
    return _option(name, help, metavar=metavar, default=default, **how)


def _web(help: str, port: int = WEB_PORT) -> tuple[str, dict[str, Any]]:
    text = f"{help} (default port {port})"
    return _option("--web", text, nargs="?", const=port, type=int, metavar="PORT")


def _instead(name: str, run: str, help: str) -> tuple[str, dict[str, Any]]:
    return _option(name, help, action="store_const", dest="run", const=run)


_CHANGED = "until a command on the serial line or the page changes it"
_OPEN = "watch.address and its token open it to the network"
_LEAST_S, _LEAST_WINDOW = partial(_seconds, least=0.1), partial(_seconds, least=0.01)
OPTIONS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "sim": _option(
        "--sim",
        "simulated tubes, one of them, a finger at rest on one, or a sweep set, instead of the"
        " devices",
        metavar="skin[:MATERIAL]|rest|replay:FILE",
    ),
    "skin": _option("--skin", "profile of the skin, or its file (skin.profile)", metavar="NAME"),
    "virtual": _flag("--virtual", "with --sim: do not wait for the time to pass"),
    "seed": _option("--seed", "seed of the simulated tubes (default 0)", type=int, default=0),
    "port": _option(
        "--port", "serial port of the skin (skin.port)", dest="skin_port", metavar="PATH"
    ),
    "sweeps": _option("--sweeps", "stop after N answers", type=_count, metavar="N"),
    "trigger": _option(
        "--trigger",
        "trigger.mode: two-lines or one-line; serial: commands START and STOP; key: the space bar;"
        " timed",
        choices=("two-lines", "one-line", "serial", "key", "timed"),
        metavar="MODE",
    ),
    "every": _option(
        "--every", "timed: seconds from one start to the next (5)", type=_LEAST_S, metavar="S"
    ),
    "sweep": _option(
        "--sweep", "timed: seconds from start to stop (3)", type=_LEAST_S, metavar="S"
    ),
    "capture": _option(
        "--capture", "write all input to FILE, for replay", type=Path, metavar="FILE"
    ),
    "shadow": _option(
        "--shadow",
        "also classify with the bundle in DIR, by default the candidate of the store; its answers"
        " are only compared",
        nargs="?",
        const="",
        metavar="DIR",
    ),
    "raw": _flag("--raw", "print the sentences alone"),
    "settings": _instead(
        "--settings", "cli.look_commands.run_settings", "print each setting with its source instead"
    ),
    "bench": _instead(
        "--bench",
        "cli.simulated_commands.run_bench",
        "measure latency, memory, start and processor share of this machine instead, with sweeps"
        " of --seed (default 2000)",
    ),
    "figures": _option("--json", "bench: write the figures", type=Path, metavar="FILE"),
    "references": _option(
        "--references",
        "bench: folder of fp32.onnx and paper_int8.onnx",
        type=Path,
        default=Path("build/references"),
        metavar="DIR",
    ),
    "part": _option(
        "--part",
        "bench: measure a part alone, as JSON, with the sweeps of --acts",
        choices=("memory", "stream"),
    ),
    "acts": _option("--acts", argparse.SUPPRESS, type=Path, metavar="FILE"),
    "json": _flag("--json", "print it as JSON", default=argparse.SUPPRESS),
    "network": _flag("--network", "what is open on which box of this network (zeroconf)"),
    "since": _option(
        "--since",
        "what the verdicts of this time were, such as 8h or 30d (palpate bridge memory)",
        type=_span,
        default=None,
        metavar="SPAN",
    ),
    "feed": _flag("--json", "the feed's lines as they are (PROTOCOL.md, part 4)"),
    "watch-page": _web(f"as a page; {_OPEN}"),
    "record-page": _web(f"also as a page, on which the labels are set; {_OPEN}", TEACH_PORT),
    "teach-page": _web("also as a page, for a person at the robot", TEACH_PORT),
    "local-page": _web("also as a page on localhost"),
    "file": _option("file", "the capture, sweep or folder", type=Path, metavar="FILE"),
    "out": _option(
        "--out",
        "folder of the sweeps (default: sweeps/ in the store's folder)",
        type=outputs.folder,
        metavar="DIR",
    ),
    "material": _text("--material", _CHANGED),
    "position": _text("--position", _CHANGED),
    "session": _text("--session", _CHANGED),
    "place": _text("--position", "place on the object (default 1)", default="1"),
    "attachment": _text("--session", "name of the session, if the skin is put back"),
    "format": _option(
        "--format",
        "format of the skin, e.g. 5x3:float32:100 (default: the announced format)",
        metavar="RxC:TYPE:HZ",
    ),
    "window": _option(
        "--window",
        "seconds of each sweep that are used (default 2)",
        type=_LEAST_WINDOW,
        metavar="S",
    ),
    "target": _option(
        "--target",
        "sweeps wanted per material and position (default 10)",
        type=_count,
        default=10,
        metavar="N",
    ),
    "label": _option(
        "--label",
        "record sweeps of this material; may be repeated, then one after another",
        action="append",
        default=[],
        metavar="NAME",
        dest="labels",
    ),
    "good": _option(
        "--sweeps",
        "number of good sweeps of each --label (default 8)",
        type=_count,
        default=8,
        dest="good",
        metavar="N",
    ),
    "use": _flag("--use", "make a bundle of all sweeps, after those of --label; it runs on trial"),
    "unknown": _option(
        "--unknown",
        "take kept sweeps (store.black_box) that were answered `unknown, as sweep N` as sweeps of"
        " --label: those that sweep NUMBER belongs to. Without --label, list them",
        nargs="?",
        const=0,
        type=_count,
        metavar="NUMBER",
    ),
    "forget": _option(
        "--forget", "teach the sweeps of this material no longer; they stay", metavar="NAME"
    ),
    "by": _text("--by", "who teaches, for the bundle (default: this user)", metavar="NAME"),
    "steps": _flag("--json", "with --use alone: print its steps as JSON"),
    "folder": _option("folder", "folder of the bundle", type=Path, metavar="DIR"),
    "candidate": _flag("--shadow", "as the candidate of `run --shadow` instead"),
    "other-skin": _flag("--other-skin", "even if another skin streams"),
    "profile": _option("name", "name of the profile", metavar="NAME"),
    "needed-port": _option(
        "--port", "serial port of the skin", dest="skin_port", metavar="PATH", required=True
    ),
    "baud": _option(
        "--baud", "its speed (default: common speeds in turn)", type=_count, metavar="N"
    ),
    "grid": _option("--grid", "rows and columns (default: the squarest)", metavar="RxC"),
    "profiles": _option(
        "--out",
        "folder of the profile (default: /etc/palpate/skins)",
        type=outputs.folder,
        metavar="DIR",
    ),
    "write": _flag("--write", "with --port: also ask the skin, and send start commands"),
    "seconds": _option(
        "--seconds",
        "time to listen, 1 to 3600 (default: 10; a skin with a profile: 2)",
        type=_seconds,
        metavar="S",
    ),
}


def add(command: argparse.ArgumentParser, names: str) -> None:
    """Add options by their names in OPTIONS; names with | between them exclude each other."""
    for word in names.split():
        group: Any = command.add_mutually_exclusive_group() if "|" in word else command
        for name in word.split("|"):
            flag, how = OPTIONS[name]
            group.add_argument(flag, **how)


def add_settings(command: argparse.ArgumentParser) -> None:
    """Add the options of all commands that have settings; NO_SETTINGS are their defaults."""
    add = partial(command.add_argument, default=argparse.SUPPRESS)
    add("--board", help="board file to use: firmware_config/board-NAME.toml")
    add("--set", action="append", metavar="SECTION.KEY=VALUE", help="override one value")
    add("--config-dir", type=Path, metavar="DIR", help="where skin.toml and the board files are")
    add("--unit", metavar="NAME", help="the unit palpate@NAME, with its own settings")
