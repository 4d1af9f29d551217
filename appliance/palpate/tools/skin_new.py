"""A profile for an unknown skin, for `palpate skin new`: proposals in words, and the text of the
file."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from palpate.core.clock import Clock
from palpate.core.errors import ConfigError, SensorMismatch, SensorSilent
from palpate.io import skin_codecs, skin_profile
from palpate.io.serial_port import PortInfo
from palpate.io.serial_sensor import BytePort
from palpate.tools.skin_detect import BOOT_S, HeardBytes, collect, measured_hz
from palpate.tools.stream_analysis import Grid, Proposal, Read, analyse, obstacle

BAUDS = 115_200, 2_000_000, 921_600, 1_000_000, 460_800, 230_400
"""Speeds that makers use, the most frequent first. A port that is USB down to the microcontroller
works at any speed."""


FEWEST, FITS = 4, 0.75
"""Frames, and share of the bytes, that a profile must read before it is proposed or written."""
MOST_SHOWN = 6
"""Largest number of proposals that are printed."""


@dataclass(frozen=True, slots=True)
class PortSample:
    """The bytes of a port at a speed, and their possible meanings, the most likely first."""

    baud: int
    reads: Sequence[Read]
    proposals: Sequence[Proposal]


def listen(
    open_port: Callable[[int], BytePort], bauds: Sequence[int], seconds: float, clock: Clock
) -> PortSample:
    """The bytes within `seconds` at the first of the `bauds` that shows a pattern. Nothing is
    written.

    open_port: opens the port at a speed. Raises SensorSilent without a byte, SensorMismatch without
    a pattern, and other SensorErrors.
    """
    count, tried, why = 0, ", ".join(map(str, bauds)), ""
    for baud in bauds:
        port = open_port(baud)
        try:
            # a board that boots when its port is opened does so at every speed
            heard = collect(port, clock, seconds, boot_s=0 if count or baud != bauds[0] else BOOT_S)
        finally:
            port.close()
        # the first read holds older bytes, and may begin within a frame
        reads = [Read(t_ns, data) for data, t_ns in heard[1:]]
        count += sum(len(read.data) for read in reads)
        if found := proposals(reads):
            return PortSample(baud, reads, found)
        why = why or obstacle(reads)
    if not count:
        raise SensorSilent(
            f"nothing came in {seconds:g} s at {tried} baud; if the skin waits for a command, copy"
            " matrix.toml and write it there"
        )
    if why:
        raise SensorMismatch(
            f"{why}; let it send numbers alone, or copy matrix.toml and describe the line there"
        )
    raise SensorMismatch(
        f"{count} bytes at {tried} baud have no pattern; name the skin's speed with --baud N, or"
        " listen longer"
    )


def proposals(reads: Sequence[Read], values: int = 0) -> list[Proposal]:
    """The formats of `reads` with which a profile reads their frames, with the measured rate.
    values: see `analyse`."""
    found = [one for one in analyse(reads, values) if _reads(one, reads)]
    rates: dict[tuple[bool, int], float] = {}
    for one in found:
        kind = one.framing == "text", one.length
        if kind not in rates:
            text = profile(one, _any_grid(one), BAUDS[0], PortInfo(""))
            made = skin_profile.from_json(tomllib.loads(text), "the new profile")
            heard = HeardBytes([(read.data, read.t_ns) for read in reads])
            rates[kind] = measured_hz(made, heard) or one.rate_hz
    return [replace(one, rate_hz=rates[one.framing == "text", one.length]) for one in found]


def _any_grid(proposal: Proposal) -> Grid:
    """A grid with as many values; (0, 0, 0) if there is none."""
    for rows in range(1, 256):
        if proposal.framing == "text" and proposal.length not in (1, rows):
            continue
        if proposal.values % rows == 0 and proposal.values // rows <= 255:
            return rows, proposal.values // rows, 1
    return 0, 0, 0


def _reads(proposal: Proposal, reads: Sequence[Read]) -> bool:
    """Whether a profile of this proposal reads frames from the bytes that it was made from."""
    grid = _any_grid(proposal)
    if not grid[0]:
        return False
    frames, garbage = decoded(profile(proposal, grid, BAUDS[0], PortInfo("")), reads)
    total = sum(len(read.data) for read in reads)
    return frames >= FEWEST and garbage <= (1 - FITS) * total + 2 * total / frames


def words(proposal: Proposal) -> str:
    """A proposal in one line."""
    mark, keys = proposal.mark.hex(" "), proposal.keys
    order = ", high byte first" * proposal.big_endian
    numbers = f"{proposal.values} x {proposal.dtype}{order}"
    count = f", a {proposal.sequence} that counts the frames" * bool(proposal.sequence)
    columns = keys.get("skip_columns")
    more = [
        _ignored(keys.get("skip_before", 0)),
        numbers,
        _ignored(keys.get("skip_after", 0)),
        f"checksum {keys['checksum']}" if "checksum" in keys else "",
        f"trailer {keys['trailer']}" if "trailer" in keys else "",
    ]
    content = ", ".join(part for part in more if part)
    text = [
        numbers,
        f"without column {', '.join(str(i + 1) for i in columns)} (time or count)"
        if columns
        else "",
        f"between {keys['around'][:40]!r}" if "around" in keys else "",
        "with decimal commas" if "decimal" in keys else "",
    ]
    frame = {
        "marker": f"{proposal.length} bytes: marker {mark}{count}, {content}",
        "trailer": f"{proposal.length} bytes: {content}{count}, trailer {mark}",
        "text": f"{proposal.length} line{'s' * (proposal.length > 1)} of text: "
        + ", ".join(part for part in text if part),
    }[proposal.framing]
    fits = ", ".join(map(grid_text, proposal.grids)) or "none"
    return f"{frame}; {proposal.rate_hz:.1f} Hz, {proposal.share:.0%} of the bytes; grids: {fits}"


def _ignored(count: int) -> str:
    return f"{count} byte{'s' * (count > 1)} ignored" if count else ""


def grid_text(grid: Grid) -> str:
    """4x4, or 3x3x3 with several axes."""
    rows, cols, axes = grid
    return f"{rows}x{cols}" + f"x{axes}" * (axes > 1)


def choose(heard: PortSample, text: str, number: int) -> tuple[Proposal, Grid]:
    """The proposal `number`, counted from 1, with the grid in `text`. 0 takes the first proposal
    with as many values. Raises ConfigError if there is none."""
    if number > len(heard.proposals):
        raise ConfigError(f"--proposal {number} is not there; use 1 to {len(heard.proposals)}")
    parts = text.split("x")
    offered = heard.proposals[number - 1 : number] if number else heard.proposals
    if len(parts) in (2, 3) and all(part.isdecimal() and 1 <= int(part) <= 255 for part in parts):
        rows, cols, axes = (*map(int, parts), 1)[:3]
        others = [] if number else proposals(heard.reads, rows * cols * axes)
        for proposal in (*offered, *others):
            if rows * cols * axes == proposal.values:
                return proposal, (rows, cols, axes)
    fits = (
        ", ".join(grid_text(grid) for proposal in offered for grid in proposal.grids)
        or "rows x columns"
    )
    raise ConfigError(f"no proposal has as many values as --grid {text}; use a grid such as {fits}")


def profile(proposal: Proposal, grid: Grid, baud: int, port: PortInfo) -> str:
    """The text of the profile's file (firmware_config/skins/matrix.toml explains each key)."""
    rows, cols, axes = grid
    values: dict[str, Any] = {
        "about": f"{rows} x {cols} taxels" + f" with {axes} axes" * (axes > 1),
        "source": "palpate skin new: what the skin sent",
        "codec": "text" if proposal.framing == "text" else "fixed",
        "baud": baud,
    }
    if port.vendor_id:
        values["usb_ids"] = [f"{port.vendor_id:04x}:{port.product_id:04x}"]
    if proposal.framing == "text":
        values["lines"] = "frames" if proposal.length == 1 else "rows"
    else:
        values[proposal.framing] = proposal.mark.hex(" ")
    if proposal.sequence:
        values["sequence"] = proposal.sequence
    values |= proposal.keys
    values |= {
        "number": proposal.dtype,
        "rows": rows,
        "cols": cols,
        "rate_hz": float(f"{proposal.rate_hz:.3g}"),
    }
    if proposal.big_endian:
        values["byte_order"] = "big"
    if axes > 1:
        values |= {"values": axes, "take": list(range(axes))}
    head = (
        "# Written by `palpate skin new`. Compare it with what the maker says; matrix.toml"
        " explains each key.\n"
    )
    return head + "".join(
        f"{name} = {json.dumps(value, ensure_ascii=False)}\n" for name, value in values.items()
    )


def decoded(text: str, reads: Sequence[Read]) -> tuple[int, int]:
    """(frames, left-over bytes) of `reads`, decoded with the profile in `text`. Raises ConfigError
    if they cannot be decoded."""
    made = skin_profile.from_json(tomllib.loads(text), "the new profile")
    found = skin_codecs.codec(made)(skin_codecs.Rest(), b"".join(read.data for read in reads))
    return len(found), found.garbage
