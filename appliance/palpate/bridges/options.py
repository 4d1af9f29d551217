"""The options of the bridges, for `palpate bridge` and `python -m palpate.bridges`. Imports no
bridge."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from palpate.core.config import Config, SerialConfig, StoreConfig
from palpate.core.errors import ConfigError
from palpate.core.outputs import Row, add_options

FEED, BAUD = str(StoreConfig().feed), SerialConfig().baud
MOST = 16
"""Default for the largest number of connections."""
PORTS = {"tcp": 1503, "modbus": 1502, "opcua": 4840}
LINKS = {kind: f"/run/palpate-{kind}/line" for kind in ("tcp", "modbus", "mqtt", "opcua")}
"""Values of `serial.port` for a bridge on the box itself: the link that the bridge makes. Their
folders belong to palpate-bridge@.service."""
FEED_KINDS = ("modbus", "mqtt", "opcua")
"""Bridges that can read the feed, as long as nobody commands."""
SETTINGS = ("allow_writes", "short", "anonymous", "broker", "login", "ca", "name")
"""Options of some bridges, and settings of the same names."""


def _number(text: str) -> int:
    """A number of connections, for argparse."""
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is not a number of connections; use 1 to 1000")
    return int(text)


_LINE = "the box's serial line: a device, or socket://HOST:PORT"
_FLAG = {"action": "store_true"}
_PATH = {"type": Path, "metavar": "PATH"}
# fmt: off
OPTIONS: Mapping[str, Row] = {
    "baud": ("--baud", f"baud rate of the serial line (default {BAUD})",
        {"type": int, "default": BAUD, "metavar": "N"}),
    "port": ("--port", _LINE, {"metavar": "PORT"}),
    "link": ("--link", "on the box: make the link PATH (default if serial.port is"
        " /run/palpate-KIND/line)", _PATH),
    "feed": ("--feed", f"on the box: read the feed at PATH (default {FEED})",
        {"nargs": "?", "const": FEED, "metavar": "PATH"}),
    "writes": ("--allow-writes",
        "peers may start, stop, tare and abort, even if bridge.allow_writes is false", _FLAG),
    "listen": ("--listen", "default: bridge.address of the settings, and port "
        + ", ".join(f"{port} ({kind})" for kind, port in PORTS.items()), {"metavar": "HOST:PORT"}),
    "most": ("--most", f"most connections at a time (default {MOST})",
        {"type": _number, "default": MOST, "metavar": "N"}),
    "short": ("--short",
        "sentences of at most 80 characters, without their last fields (bridge.short)", _FLAG),
    "folder": ("--folder", "its certificate, and `login`: user on one line, password on the next"
        " (bridge.opcua)", _PATH),
    "anonymous": ("--anonymous",
        "everybody may read, also without encryption (bridge.anonymous)", _FLAG),
    "name": ("--name", "of the box; default: of the computer (bridge.name)", {"metavar": "NAME"}),
    "broker": ("--broker", "mqtt://HOST:PORT, or mqtts://HOST:PORT for TLS (bridge.broker)",
        {"metavar": "URL"}),
    "login": ("--login", "user on its first line, password on its second (bridge.login)",
        {"metavar": "FILE"}),
    "ca": ("--ca", "certificates to trust; default: the system's (bridge.ca)",
        {"metavar": "FILE"}),
    "of-box": ("--feed", "the box's feed (store.runtime)", {"metavar": "PATH"}),
    "file": ("--file", "SQLite (bridge.memory)", _PATH),
    "fingers": ("--fingers",
        "2 to 4 units, as in palpate@NAME, or the paths of their feeds (bridge.fingers)",
        {"nargs": "+", "metavar": "NAME[=FEED]"}),
    "robot": ("--port", "the serial line to the robot (serial.port)", {"metavar": "PORT"}),
    "ros": ("--ros-args", "parameters and names of ROS; the last option",
        {"nargs": argparse.REMAINDER, "default": [], "metavar": "..."}),
}
KINDS: Mapping[str, tuple[str, str]] = {
    "tcp": ("the sentences of the serial line on a TCP port",
        "baud port|link writes listen short most"),
    "modbus": ("the box as a Modbus TCP server", "baud port|link|feed writes listen most"),
    "opcua": ("the box as an OPC UA server",
        "baud port|link|feed writes listen folder anonymous name most"),
    "mqtt": ("the box at an MQTT broker, with Home Assistant's discovery",
        "baud port|link|feed writes broker login ca name"),
    "memory": ("every verdict of 90 days in a file, for palpate status --since", "of-box file"),
    "ros": ("the box as a ROS 2 node", "ros"),
    "fuse": ("the answers of several fingers, each with a unit of its own, fused to one answer",
        "baud fingers robot"),
}
# fmt: on
"""The kinds of bridges: what each offers, and its options."""


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the kinds of bridges, with the options of each."""
    kinds = command.add_subparsers(dest="kind", metavar="KIND", required=True)
    for kind, (text, names) in KINDS.items():
        one = kinds.add_parser(kind, help=text, description=f"{text[0].upper()}{text[1:]}.")
        one.set_defaults(feed=None)
        add_options(one, names, OPTIONS)


def read_login(path: Path) -> tuple[str, str]:
    """User and password. Raises ConfigError for a file that others may read, or without two
    lines."""
    try:
        if path.stat().st_mode & 0o007:
            raise ConfigError(
                f"{path}: everybody may read the password; chmod o= {path}, and give it to "
                "the bridge's user"
            )
        # editors of Windows put a mark first
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as e:
        why = str(getattr(e, "strerror", None) or "not a text").lower()
        raise ConfigError(f"{path}: {why}; name a file with user and password") from e
    if len(lines) < 2 or not lines[0]:
        raise ConfigError(
            f"{path}: it needs two lines; put the user on the first, the password on the second"
        )
    return lines[0], lines[1]


def settle(kind: str, args: argparse.Namespace, settings: Config) -> None:
    """Fill in missing options from the settings of the box. Raises ConfigError if the settings give
    the bridge no serial line."""
    bridge = settings.bridge
    if kind in PORTS and args.listen is None:
        args.listen = f"{bridge.address}:{PORTS[kind]}"
    for name in SETTINGS:
        setattr(args, name, getattr(args, name, None) or getattr(bridge, name))
    args.folder = getattr(args, "folder", None) or Path(bridge.opcua)
    args.memory = Path(bridge.memory)
    if args.port or args.link or args.feed:
        return
    if settings.serial.port == LINKS[kind]:
        args.link = Path(LINKS[kind])
    elif kind in FEED_KINDS and settings.store.feed and not args.allow_writes:
        args.feed = str(settings.store.feed)
    else:
        why = " and the feed is read-only" if kind in FEED_KINDS else ""
        raise ConfigError(
            f'serial.port = "{settings.serial.port}" is not a serial line for this bridge{why}; '
            "set serial.port = "
            f'"{LINKS[kind]}", or name the box\'s serial line with --port'
        )


class _Later(ModuleType):
    """Stands in for a module that is loaded at its first use."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(import_module(self.__name__), name)


@contextmanager
def needed(what: str, extra: str, *hardly: str) -> Iterator[None]:
    """Raises ConfigError if an import fails: `what` is not installed, and `extra` has it. hardly:
    modules that it imports and no bridge uses; they take 2 MiB."""
    absent = [_Later(name) for name in hardly if name not in sys.modules]
    for one in absent:
        above, _, own = one.__name__.rpartition(".")
        sys.modules[one.__name__] = one
        if above:
            setattr(import_module(above), own, one)
    try:
        yield
    except ImportError as e:
        raise ConfigError(f"{what} is not installed ({e}); pip install 'palpate[{extra}]'") from e
    finally:
        for one in absent:
            if sys.modules.get(one.__name__) is one:
                del sys.modules[one.__name__]
