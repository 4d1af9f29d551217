"""The options of the bridges, for `palpate bridge` and `python -m palpate.bridges`. Imports no
bridge."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from palpate.core.config import SerialConfig, StoreConfig
from palpate.core.menu import CommandParser

FEED, BAUD = str(StoreConfig().feed), SerialConfig().baud
MOST = 16
"""Default for the largest number of connections."""
PORTS = {"tcp": 1503, "modbus": 1502}
LINKS = {"tcp": "/run/palpate-tcp/line", "modbus": "/run/palpate-modbus/line"}
"""Values of `serial.port` for a bridge on the box itself: the link that the bridge makes. Their
folders belong to palpate-bridge@.service."""
TEXTS = {
    "tcp": "the sentences of the serial line on a TCP port",
    "modbus": "the box as a Modbus TCP server",
    "ros": "the box as a ROS 2 node",
}


def add_arguments(command: CommandParser) -> None:
    """Add the kind of bridge and the options of all kinds."""
    command.choose("kind", TEXTS)
    lines = command.only_for("tcp", "modbus")
    lines("--port", metavar="PORT", help="the box's serial line: a device, or socket://HOST:PORT")
    links = " or ".join(map(str, LINKS.values()))
    lines(
        "--link",
        type=Path,
        metavar="PATH",
        help=f"on the box: make the link PATH; default if serial.port is {links}",
    )
    lines(
        "--baud",
        type=int,
        default=BAUD,
        metavar="N",
        help=f"baud rate of the serial line (default {BAUD})",
    )
    ports = ", ".join(f"{kind} {port}" for kind, port in PORTS.items())
    lines(
        "--listen",
        metavar="HOST:PORT",
        help=f"default: bridge.address of the settings, and the port of the kind ({ports})",
    )
    lines(
        "--allow-writes",
        action="store_true",
        help="peers may start, stop, tare and abort, even if bridge.allow_writes is false",
    )
    lines(
        "--most",
        type=_number,
        default=MOST,
        metavar="N",
        help=f"most connections at a time (default {MOST})",
    )
    _add_feed(command)
    _add_ros(command)


def _add_feed(command: CommandParser) -> None:
    command.only_for("modbus")(
        "--feed",
        nargs="?",
        const=FEED,
        metavar="PATH",
        help=f"on the box: read the feed at PATH (default {FEED})",
    )


def _add_ros(command: CommandParser) -> None:
    command.only_for("ros")(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        metavar="...",
        help="parameters and names of ROS; the last option",
    )


def parse(command: CommandParser, words: Sequence[str]) -> argparse.Namespace:
    """The arguments of a bridge; ends the program if they are wrong, or with help."""
    args = command.parse(words)
    ways = [name for name in ("port", "link", "feed") if getattr(args, name)]
    if len(ways) > 1:
        command.error(f"--{ways[0]} and --{ways[1]} both name a way to the box; use one of them")
    return args


def _number(text: str) -> int:
    """A number of connections, for argparse."""
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is not a number of connections; use 1 to 1000")
    return int(text)
