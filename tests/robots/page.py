"""Writes the tables of docs/robots/README.md between their markers; other lines stay."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SENTENCE = "$PPLP,RES,7,5021.384,ok,plastic rough,0.987,0.981,1,0,0.41,9f3c2a1b,usb,1.00,*hh\r\n"
BAUD, BITS = 115200, 10
NAMES = {
    "lines": "lines: RESULT VALID, simulated lines in the box's process",
    "serial": "serial line, Python client, without the time on the wire",
    "tcp": "`bridge tcp` behind the serial line, Python client on loopback",
    "feed": "feed, a program on the box",
    "modbus": "`bridge modbus` on the feed, pymodbus's client that reads every {poll:g} ms",
    "mqtt": "`bridge mqtt` on the feed, mosquitto, mosquitto_sub on loopback",
    "opcua": "`bridge opcua` on the feed, asyncua's client on loopback, told at once",
    "ros": "`bridge ros` on the feed, another node on loopback",
}


def table(found: Mapping[str, Any]) -> str:
    """The table of the measurements in Markdown."""
    rows = ["| connection | median | longest |", "|---|---|---|"]
    for name, text in NAMES.items():
        one = found["connections"][name]
        rows.append(
            f"| {text.format(poll=found['poll_ms'])} | {one['median_ms']} ms "
            f"| {one['longest_ms']} ms |"
        )
    fewest = min(one["n"] for one in found["connections"].values())
    wire = len(SENTENCE) * BITS / BAUD * 1000
    return "\n".join(
        [
            "Measured by `python -m tests.robots`, all but the first at the same time, "
            f"on {found['cores']} cores ({found['machine']}), which",
            f"other work shares: load average {found['load']:.1f}, "
            f"scheduling class {found['scheduler']}; commit {found['commit'][:12]}. "
            "From the verdict to the robot's",
            f"program, {fewest} answers or more of each. On a wire at {BAUD} baud a RES of "
            f"{len(SENTENCE)} characters takes {wire:.1f} ms more; networks add their own time.",
            "",
            *rows,
            "",
            "Resident memory of a bridge: "
            + ", ".join(f"{kind} {mib} MiB" for kind, mib in found["memory_mib"].items())
            + ".",
        ]
    )


def write(path: Path, marker: str, text: str) -> None:
    """Replace the text between the markers of this name."""
    page = path.read_text("utf-8")
    begin, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    path.write_text(
        re.sub(f"{begin}.*{end}", lambda m: f"{begin}\n{text}\n{end}", page, flags=re.S), "utf-8"
    )
