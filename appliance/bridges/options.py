"""The options of the bridges, for both ways of starting one; nothing of a bridge is imported for
them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from appliance.core.config import SerialConfig, StoreConfig

FEED, BAUD = str(StoreConfig().feed), SerialConfig().baud
MOST = 16
"""Connections at a time."""
PORTS = {"tcp": 1503, "modbus": 1502}
LINKS = {"tcp": "/run/palpate-tcp/line", "modbus": "/run/palpate-modbus/line"}
"""The box's line on the box itself, where `serial.port` has this value; their folders are of
palpate-bridge@.service."""
TEXTS = {
    "tcp": "the sentences of the serial line on a TCP port",
    "modbus": "the box as a Modbus TCP server",
    "ros": "the box as a ROS 2 node",
}


def add_arguments(add: Callable[[str, str], argparse.ArgumentParser]) -> None:
    """The options of all bridges. add: makes the parser of one, from its name and a text."""
    for name in TEXTS:
        command = add(name, TEXTS[name])
        if name == "ros":
            command.add_argument(
                "--ros-args",
                nargs=argparse.REMAINDER,
                default=[],
                metavar="...",
                help="parameters and names, as ROS has them; comes last",
            )
            continue
        box = command.add_mutually_exclusive_group()
        box.add_argument(
            "--port", metavar="PORT", help="the box's serial line: a device, or socket://HOST:PORT"
        )
        link = f"on the box: make PATH, for serial.port; the default where that is {LINKS[name]}"
        box.add_argument("--link", type=Path, metavar="PATH", help=link)
        if name == "modbus":
            box.add_argument(
                "--feed",
                nargs="?",
                const=FEED,
                metavar="PATH",
                help=f"on the box: read its feed ({FEED}); else the default",
            )
        command.add_argument(
            "--baud", type=int, default=BAUD, metavar="N", help=f"of the serial line ({BAUD})"
        )
        listen = f"default: bridge.address of the settings, port {PORTS[name]}"
        command.add_argument("--listen", metavar="HOST:PORT", help=listen)
        writes = "peers may start, stop, tare and abort, also where bridge.allow_writes is false"
        command.add_argument("--allow-writes", action="store_true", help=writes)
        command.add_argument(
            "--most",
            type=_number,
            default=MOST,
            metavar="N",
            help=f"connections at a time ({MOST})",
        )


def _number(text: str) -> int:
    """A number of connections, for argparse."""
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is no number of connections; use 1 to 1000")
    return int(text)
