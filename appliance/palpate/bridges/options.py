"""The options of the bridges, for `palpate bridge` and `python -m palpate.bridges`. Imports no
bridge."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from palpate.core.config import Config, SerialConfig, StoreConfig
from palpate.core.errors import ConfigError

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
TEXTS = {
    "tcp": "the sentences of the serial line on a TCP port",
    "modbus": "the box as a Modbus TCP server",
    "opcua": "the box as an OPC UA server",
    "mqtt": "the box at an MQTT broker, with Home Assistant's discovery",
    "memory": "every verdict of 90 days in a file, for palpate status --since",
    "ros": "the box as a ROS 2 node",
    "fuse": "the answers of several fingers, each with a unit of its own, as those of one hand",
}


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the kinds of bridges, with the options of each."""
    kinds = command.add_subparsers(dest="kind", metavar="KIND", required=True)
    for kind, text in TEXTS.items():
        one = kinds.add_parser(kind, help=text, description=f"{text[0].upper()}{text[1:]}.")
        add = one.add_argument
        if kind == "ros":
            text = "parameters and names of ROS; the last option"
            add("--ros-args", nargs=argparse.REMAINDER, default=[], metavar="...", help=text)
            continue
        if kind == "memory":
            add("--feed", metavar="PATH", help="the box's feed (store.runtime)")
            add("--file", type=Path, metavar="FILE", help="SQLite (bridge.memory)")
            continue
        text = f"baud rate of the serial line (default {BAUD})"
        add("--baud", type=int, default=BAUD, metavar="N", help=text)
        if kind == "fuse":
            text = "2 to 4 units, as in palpate@NAME, or the paths of their feeds (bridge.fingers)"
            add("--fingers", nargs="+", metavar="NAME[=FEED]", help=text)
            add("--port", metavar="PORT", help="the serial line to the robot (serial.port)")
        else:
            _add_ways(one, kind)
            text = "peers may start, stop, tare and abort, even if bridge.allow_writes is false"
            one.add_argument("--allow-writes", action="store_true", help=text)
            _add_broker(one) if kind == "mqtt" else _add_server(one, kind)


def _add_ways(one: argparse.ArgumentParser, kind: str) -> None:
    """Add the ways to the box."""
    way = one.add_mutually_exclusive_group()
    text = "the box's serial line: a device, or socket://HOST:PORT"
    way.add_argument("--port", metavar="PORT", help=text)
    text = f"on the box: make the link PATH; default if serial.port is {LINKS[kind]}"
    way.add_argument("--link", type=Path, metavar="PATH", help=text)
    one.set_defaults(feed=None)
    if kind in FEED_KINDS:
        text = f"on the box: read the feed at PATH (default {FEED})"
        way.add_argument("--feed", nargs="?", const=FEED, metavar="PATH", help=text)


def _add_server(one: argparse.ArgumentParser, kind: str) -> None:
    text = f"default: bridge.address of the settings, and port {PORTS[kind]}"
    one.add_argument("--listen", metavar="HOST:PORT", help=text)
    if kind == "tcp":
        text = "sentences of at most 80 characters, without their last fields (bridge.short)"
        one.add_argument("--short", action="store_true", help=text)
    if kind == "opcua":
        text = "its certificate, and `login`: user on one line, password on the next (bridge.opcua)"
        one.add_argument("--folder", type=Path, metavar="DIR", help=text)
        text = "everybody may read, also without encryption (bridge.anonymous)"
        one.add_argument("--anonymous", action="store_true", help=text)
        text = "of the box; default: of the computer (bridge.name)"
        one.add_argument("--name", metavar="NAME", help=text)
    text = f"most connections at a time (default {MOST})"
    one.add_argument("--most", type=_number, default=MOST, metavar="N", help=text)


def _add_broker(one: argparse.ArgumentParser) -> None:
    for name, metavar, text in (
        ("broker", "URL", "mqtt://HOST:PORT, or mqtts://HOST:PORT for TLS (bridge.broker)"),
        ("login", "FILE", "user on its first line, password on its second (bridge.login)"),
        ("ca", "FILE", "certificates to trust; default: those of the system (bridge.ca)"),
        ("name", "NAME", "of the box, in topics; default: of the computer (bridge.name)"),
    ):
        one.add_argument(f"--{name}", metavar=metavar, help=text)


def _number(text: str) -> int:
    """A number of connections, for argparse."""
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is not a number of connections; use 1 to 1000")
    return int(text)


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


@contextmanager
def needed(what: str, extra: str) -> Iterator[None]:
    """Raises ConfigError if an import fails: `what` is not installed, and `extra` has it."""
    try:
        yield
    except ImportError as e:
        raise ConfigError(f"{what} is not installed ({e}); pip install 'palpate[{extra}]'") from e
