"""The promises about any input, as functions of bytes.

A target raises an AssertionError if a promise is broken; any other error would have ended the box.
It depends on its bytes alone: its folder only holds files that it wrote itself.
"""

import json
import re
import struct
import zlib
from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from operator import xor
from pathlib import Path
from typing import Any

from palpate.core import sentences
from palpate.core.errors import FormatError, SensorMismatch
from palpate.core.types import SweepFormat
from palpate.io import packets as wire
from palpate.io import robot_link, sensor, usb_sensor
from palpate.service import feed_reader
from tests.fuzz import enrolments, far_sides, files, skins
from tests.fuzz.files import one_line

Target = Callable[[bytes, Path], None]

SKIN = SweepFormat(4, 4, 750.0, 1500, "uint8")
LONGEST = wire.HEADER.size + wire.MAX_PAYLOAD + wire.CRC.size
REQUEST = 1024
"""Largest request to the feed in bytes (PROTOCOL.md, part 4)."""
LINE = 128
"""Largest sentence or command in characters (PROTOCOL.md, part 2)."""
ITEM_SIZES = {0: 1, 1: 2, 2: 2, 3: 4}


class Scanned(bytes):
    """Bytes that count how often they are searched from each position."""

    searches = 0

    def find(self, *args: Any) -> int:
        """As bytes.find."""
        self.searches += 1
        return super().find(*args)


def cuts(data: bytes) -> set[int]:
    """Positions at which to cut the input: the middle, and a place that the last byte gives."""
    return {len(data) // 2, data[-1] % len(data)} if data else {0}


def by_the_document(data: bytes) -> list[bytes]:
    """All whole packets in `data` by PROTOCOL.md's table, in short, slow code."""
    found, at = [], 0
    while (at := data.find(b"\x50\xc1", at)) >= 0 and len(data) - at >= 20:
        version, kind, n, _, count, rows, cols, digit, axes = struct.unpack_from(
            "<BBHBBBBBB", data, at + 2
        )
        end = at + 20 + n + 4
        frames = version == 1 and digit in ITEM_SIZES and axes <= 8
        frames = frames and n == count * rows * cols * max(axes, 1) * ITEM_SIZES[digit] > 0
        if n <= 4096 and (kind == 1 or (kind == 0 and frames)):
            if end > len(data):
                break
            if zlib.crc32(data[at : end - 4]) == int.from_bytes(data[end - 4 : end], "little"):
                found.append(data[at:end])
                at = end
                continue
        at += 1
    return found


def shown(packets: list[wire.Packet], replies: list[wire.Reply]) -> list[tuple[object, ...]]:
    """Packets and replies as values that can be compared."""
    frames = [
        (p.seq, p.t_us, p.flags, p.taxels.shape, p.taxels.dtype.str, p.taxels.tobytes())
        for p in packets
    ]
    return [*frames, *((r.request, r.payload) for r in replies)]


def unpack(data: bytes, folder: Path) -> None:
    """wire.unpack: the document's packets, every byte accounted for, also in parts."""
    scanned = Scanned(data)
    got = wire.unpack(scanned)
    assert scanned.searches <= 1 + data.count(wire.MAGIC), (
        f"{scanned.searches} searches in {len(data)} bytes"
    )
    raw = by_the_document(data)
    assert len(got.packets) + len(got.replies) == len(raw)
    assert [p.taxels.tobytes() for p in got.packets] == [r[20:-4] for r in raw if r[3] == 0]
    assert [p.seq for p in got.packets] == [
        int.from_bytes(r[12:16], "little") for r in raw if r[3] == 0
    ]
    assert [r.payload for r in got.replies] == [r[20:-4] for r in raw if r[3] == 1]
    assert sum(map(len, raw)) + got.garbage + len(got.leftover) == len(data)
    assert data.endswith(got.leftover)
    assert len(got.leftover) < LONGEST
    assert wire.MAGIC.startswith(got.leftover[:2])
    for cut in cuts(data):
        first = wire.unpack(data[:cut])
        then = wire.unpack(first.leftover + data[cut:])
        parts = shown(first.packets + then.packets, first.replies + then.replies)
        assert parts == shown(got.packets, got.replies), f"cut at {cut}, other packets come out"
        assert first.garbage + then.garbage == got.garbage
        assert then.leftover == got.leftover
        _stream(data, cut, sum(len(p.taxels) for p in got.packets))
    _follow(got.packets)
    _replies(data, got.replies)


def _stream(data: bytes, cut: int, sent: int) -> None:
    """The frames of a sensor: numbers rise, and each frame that came is returned or counted."""
    counters = sensor.SensorCounters()
    stream = usb_sensor.Stream(SKIN, counters)
    stream.restart()
    numbers = [-1]
    try:
        for i, part in enumerate((data[:cut], data[cut:])):
            frames = stream.feed(part, (i + 1) * 8_000_000)
            assert len(frames.t_ns) == len(frames.seq) == len(frames.taxels)
            numbers += frames.seq.tolist()
        assert counters.frames + counters.stale_frames + counters.lost_frames >= sent, (
            f"{counters} for {sent} frames"
        )
    except SensorMismatch as e:
        one_line(e)
    assert all(a < b for a, b in pairwise(numbers)), f"numbers {numbers} do not rise"
    assert counters.frames == len(numbers) - 1
    assert counters.garbage_bytes <= len(data)


def _follow(packets: list[wire.Packet]) -> None:
    """Each frame is fresh or stale, and the numbers of fresh frames rise."""
    fresh, place, lost, stale = wire.follow(packets, wire.StreamPosition(0))
    sizes = [len(p.taxels) for p in packets]
    assert sum(len(p.taxels) for _, p in fresh) + stale == sum(sizes)
    ends = [0, *(start + len(p.taxels) for start, p in fresh)]
    assert all(end <= start for end, (start, _) in zip(ends, fresh, strict=False)), "frames overlap"
    assert lost >= 0
    assert place.next is None or place.next == ends[-1]


def _replies(data: bytes, replies: list[wire.Reply]) -> None:
    """Identity and format are read, or refused by FormatError."""
    for payload in (data, *(r.payload for r in replies)):
        try:
            who = wire.unpack_identity(payload)
            assert (who.board + who.serial).isprintable()
            assert len(wire.pack_identity(who)) == 36
        except FormatError as e:
            one_line(e)
        try:
            axes = payload[3:4].replace(b"\1", b"\0")
            assert (
                wire.pack_format(skin := wire.unpack_format(payload))
                == payload[:3] + axes + payload[4:16]
            ), skin
        except FormatError as e:
            one_line(e)


def command(data: bytes, folder: Path) -> None:
    """sink.parse: one Command a line, also in parts, a bounded rest, an answer to each."""
    got, rest = robot_link.parse(data)
    assert len(rest) <= LINE + 1
    *lines, last = re.split(rb"[\r\n]+", data)
    lines = [line for line in lines if line]
    assert len(got) == len(lines) + (len(last) > LINE)
    for line, parsed in zip(lines, got, strict=False):
        assert bool(parsed.error) != _is_command(line, parsed.name), (
            f"{line!r} was taken as {parsed}"
        )
    for parsed in got:
        _answer(parsed)
    for cut in cuts(data):
        first, left = robot_link.parse(data[:cut])
        then, left = robot_link.parse(data[cut:], left)
        assert (first + then, left) == (got, rest), f"cut at {cut}, other commands come out"


def _is_command(line: bytes, name: str) -> bool:
    """Whether a line is this command by PROTOCOL.md."""
    body, star, given = line.strip().rpartition(b"$")[2].partition(b"*")
    fields = re.split(
        "[, ]", body.decode("ascii", "replace"), maxsplit=2
    )  # people may type spaces instead of commas
    known = (
        fields[:2] == ["PPLP", name]
        and name in robot_link.COMMANDS
        and (name == "START" or (len(fields) == 3) == (name in robot_link.TEXT_COMMANDS))
    )
    # characters that a sentence may not hold (PROTOCOL.md); a command has one field, and the
    # trigger checks those of START
    if name == "START":
        known = known and not re.search(rb"[^ -~]", body)
    else:
        known = known and "," not in "".join(fields[2:])
        known = known and not re.search(rb"[^ -~]|[!\\~^]", body)
    sealed = not star or given.upper() == b"%02X" % reduce(xor, body, 0)
    return known and sealed and len(line) <= LINE


def _answer(parsed: robot_link.Command) -> None:
    """The sentence that answers a command has all its fields, whatever the line contained."""
    line = sentences.sentence("ANS", parsed.name, "error" if parsed.error else "ok", parsed.error)
    assert len(line) <= LINE
    body, given = line.removeprefix(b"$").removesuffix(b"\r\n").split(b"*")
    assert body.decode("ascii").isprintable()
    assert given == b"%02X" % reduce(xor, body, 0)
    kind, name, outcome, _ = body.decode().split(",", 4)[1:5]
    assert (kind, outcome) == ("ANS", "error" if parsed.error else "ok")
    assert parsed.error or name == parsed.name


def requests(data: bytes, folder: Path) -> None:
    """feed_reader.requests: requests as in PROTOCOL.md are accepted, all others are refused with a
    one-line message. The result is the same if the bytes come in parts."""
    *lines, last = data.split(b"\n")
    right = len(last) <= REQUEST and all(map(_is_request, lines))
    try:
        got, rest = feed_reader.requests(data)
    except FormatError as e:
        refused = one_line(e)
    else:
        refused = ""
    assert right != bool(refused), f"{data!r}: {refused or got}"
    if refused:
        return
    assert len(got) == len(lines)
    assert rest == last
    for asked in got:
        assert asked.frames is None or 0 <= asked.frames <= 20
        assert asked.sweeps in (None, True, False)
        assert asked != feed_reader.FeedRequest()
    for cut in cuts(data):
        first, left = feed_reader.requests(data[:cut])
        then, left = feed_reader.requests(data[cut:], left)
        assert (first + then, left) == (got, rest), f"cut at {cut}, other requests come out"


def _is_request(line: bytes) -> bool:
    """Whether a line is a request by PROTOCOL.md."""
    try:
        asked = json.loads(line)
    except (ValueError, RecursionError):
        return False
    if (
        len(line) > REQUEST
        or not isinstance(asked, dict)
        or set(asked) - {"frames", "sweeps"}
        or not asked
    ):
        return False
    hz, sweeps = asked.get("frames", 0), asked.get("sweeps", True)
    return (
        not isinstance(hz, bool)
        and isinstance(hz, (int, float))
        and 0 <= hz <= 20
        and isinstance(sweeps, bool)
    )


TARGETS: dict[str, Target] = {
    "unpack": unpack,
    "command": command,
    "feed": requests,
    "settings": files.settings,
    "manifest": files.manifest,
    "enrolment": enrolments.target,
    "recording": files.recording,
    "capture": files.played,
    **skins.TARGETS,
    **far_sides.TARGETS,
}
