"""The options of the bridges, for `palpate bridge` and `python -m appliance.bridges`. Imports no
bridge."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from appliance.core.config import SerialConfig, StoreConfig

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


def add_arguments(add: Callable[[str, str], argparse.ArgumentParser]) -> None:
    """Add the options of all bridges. add: makes the parser of a bridge, from its name and help."""
    for name in TEXTS:
        command = add(name, TEXTS[name])
        if name == "ros":
            command.add_argument(
                "--ros-args",
                nargs=argparse.REMAINDER,
                default=[],
                metavar="...",
                help="parameters and names of ROS; the last option",
            )
            continue
        box = command.add_mutually_exclusive_group()
        box.add_argument(
            "--port", metavar="PORT", help="the box's serial line: a device, or socket://HOST:PORT"
        )
        link = f"on the box: make the link PATH; default if serial.port is {LINKS[name]}"
        box.add_argument("--link", type=Path, metavar="PATH", help=link)
        if name == "modbus":
            box.add_argument(
                "--feed",
                nargs="?",
                const=FEED,
                metavar="PATH",
                help=f"on the box: read the feed at PATH (default {FEED})",
            )
        command.add_argument(
            "--baud",
            type=int,
            default=BAUD,
            metavar="N",
            help=f"baud rate of the serial line (default {BAUD})",
        )
        listen = f"default: bridge.address of the settings, port {PORTS[name]}"
        command.add_argument("--listen", metavar="HOST:PORT", help=listen)
        writes = "peers may start, stop, tare and abort, even if bridge.allow_writes is false"
        command.add_argument("--allow-writes", action="store_true", help=writes)
        command.add_argument(
            "--most",
            type=_number,
            default=MOST,
            metavar="N",
            help=f"most connections at a time (default {MOST})",
        )


def _number(text: str) -> int:
    """A number of connections, for argparse."""
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is not a number of connections; use 1 to 1000")
    return int(text)
