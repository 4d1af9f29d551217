"""`palpate skin detect` and `list`: connected skins, and all profiles. A port is compared by its
ids, then by listening. Commands are written only to a port that the user has named."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise

from palpate.core.clock import Clock
from palpate.core.config import SkinConfig
from palpate.core.errors import FormatError, SensorError
from palpate.core.types import SweepFormat, shown
from palpate.io import packets, skin_codecs, wire_numbers
from palpate.io.sensor import BytePort, reply_to
from palpate.io.serial_port import PortInfo
from palpate.io.serial_sensor import requests, started
from palpate.io.skin_codecs import Rest
from palpate.io.skin_profile import DEFAULT, SkinProfile
from palpate.tools import skin_text

LISTEN_S = 2.0
"""Time for each speed of a port: 56 frames of the slowest skin."""
FITS = 0.9
"""Share of the bytes that must be in frames of a profile."""
FEWEST_FRAMES = 4
"""Number of frames that cannot be chance."""
SAME_RATE = 0.02
"""Relative difference of rates that needs no setting."""
BAUDS = (115200, 9600, 57600, 250000, 500000, 1000000, 2000000)
"""Speeds at which sketches print lines of numbers."""
OpenPort = Callable[[str, int], BytePort]


LINES = (
    "let it print equal lines of numbers, or describe them as matrix.toml explains: `start` or"
    " `poll` for what it waits for, `prefix` or `index` for how its lines begin, `lines` for rows,"
    " which `palpate skin new` writes with --grid; lines of changes cannot be described, so print"
    " all taxels"
)
"""The remedy for text that is no lines of numbers."""


@dataclass(frozen=True, slots=True)
class PortFinding:
    """The skin on a port. profile: its name, "" if no profile fits. detail: the evidence, and the
    settings or the remedy. proposal: the text of a profile for lines of numbers, "" for others."""

    port: PortInfo
    profile: str
    detail: str
    proposal: str = ""


@dataclass(frozen=True, slots=True)
class HeardBytes:
    """Bytes of a port. reads: (bytes, time of arrival in ns)."""

    reads: list[tuple[bytes, int]]

    @property
    def data(self) -> bytes:
        return b"".join(data for data, _ in self.reads)


def table(profiles: Mapping[str, SkinProfile]) -> list[str]:
    """All profiles in lines: name, format, missing features, and kind of skin. A last line
    lists the profiles that nobody has compared with a device."""
    rows = [("profile", "format", "lacks", "skin")]
    for name, one in profiles.items():
        format = "as its board says" if one.codec == DEFAULT else described(one.format)
        measured = f" (measured: {one.measured})" if one.measured else ""
        rows.append((name, format, ", ".join(one.lacks) or "nothing", one.about + measured))
    wide = [max(len(row[i]) for row in rows) for i in range(3)]
    lines = ["  ".join([*map(str.ljust, row[:3], wide), row[3]]) for row in rows]
    if not any(one.measured for one in profiles.values()):
        return [*lines, "none was measured on a device"]
    never = [name for name, one in profiles.items() if not one.measured]
    return [*lines, f"not measured on a device: {', '.join(never)}"] if never else lines


def described(format: SweepFormat) -> str:
    """Shape, type and rate for a person."""
    return f"{shown(format.shape)} {format.dtype} at {format.rate_hz:g} Hz"


@dataclass(frozen=True, slots=True)
class Ports:
    """Serial ports with unknown skins. open_port: opens one at a speed; raises SensorError."""

    open_port: OpenPort
    clock: Clock

    def detect(
        self, ports: Iterable[PortInfo], profiles: Mapping[str, SkinProfile], *, write: bool = False
    ) -> Iterator[PortFinding]:
        """The skins on the ports. write: also ask, and send start commands."""
        for port in ports:
            try:
                yield self._on_port(port, profiles, write)
            except SensorError as e:
                yield PortFinding(port, "", str(e))

    def _on_port(
        self, port: PortInfo, profiles: Mapping[str, SkinProfile], write: bool
    ) -> PortFinding:
        by_ids = [n for n, p in profiles.items() if (port.vendor_id, port.product_id) in p.ids]
        known = f"ids as {', '.join(by_ids)}; " if by_ids else ""
        others = {name: p for name, p in profiles.items() if p.codec != DEFAULT}
        heard: dict[int, HeardBytes] = {}
        # profiles with the port's ids first; each speed once, for all profiles that use it
        first = sorted(others, key=lambda name: name not in by_ids)
        for baud in dict.fromkeys(others[name].baud for name in first):
            these = {name: p for name, p in others.items() if p.baud == baud}
            asked = [p for p in these.values() if write and (p.start or requests(p))]
            for starter in (None, *asked):
                heard[baud] = self.listen(port.path, baud, starter)
                if fitting := [n for n in these if fits(these[n], heard[baud])]:
                    found = _settings(port, fitting, these, heard[baud])
                    return PortFinding(port, fitting[0], known + found)
        for name, p in others.items():
            if taxels := other_grid(p, heard[p.baud]):
                return PortFinding(port, name, known + _another_grid(port, name, taxels))
        if write and (who := self._asked(port.path)):
            told = f'{known}{who}; set skin.link = "serial", skin.port = "{port.path}"'
            return PortFinding(port, DEFAULT, told)
        proposal, sample = self.propose(port.path, heard)
        nothing = _nothing(sample, others, write, bool(proposal))
        return PortFinding(port, "", known + nothing, proposal)

    def propose(
        self,
        path: str,
        heard: dict[int, HeardBytes],
        grid: tuple[int, int] | None = None,
        bauds: Iterable[int] = BAUDS,
    ) -> tuple[str, HeardBytes]:
        """The text of a profile for the lines of numbers at a port, or "", and all bytes heard
        there. heard: by speed so far; `bauds` follow until one gives text. Raises SensorError."""
        for baud in dict.fromkeys((*heard, *bauds)):
            if baud not in heard:
                if heard and not any(one.reads for one in heard.values()):
                    break  # silent at any speed
                heard[baud] = self.listen(path, baud)
            if heard[baud].reads and skin_text.is_text(heard[baud].data):
                return _proposed(baud, heard[baud], grid), heard[baud]
        return "", max(heard.values(), key=lambda one: len(one.data))

    def listen(
        self, path: str, baud: int, starter: SkinProfile | None = None, seconds: float = LISTEN_S
    ) -> HeardBytes:
        """The bytes of a port. starter: its commands and requests are written. Raises
        SensorError."""
        port, now_ns = self.open_port(path, baud), self.clock.now_ns
        reads: list[tuple[bytes, int]] = []
        link = started(port, starter, starter.rate_hz, self.clock) if starter else port
        with closing(link):
            until_ns = now_ns() + round(seconds * 1e9)
            while (left_ns := until_ns - now_ns()) > 0:
                if data := link.read(1 << 16, max(1, left_ns // 1_000_000)):
                    if not reads:  # a board may boot first
                        until_ns = now_ns() + round(seconds * 1e9)
                    reads.append((data, now_ns()))
        return HeardBytes(reads)

    def _asked(self, path: str) -> str:
        """The answer of a board of PROTOCOL.md, "" if there is none."""
        with closing(self.open_port(path, SkinProfile().baud)) as port:
            try:
                port.write(bytes([packets.Request.IDENTITY]))
                reply = reply_to(packets.Request.IDENTITY, port.read, self.clock)
                who = packets.unpack_identity(reply)
            except (SensorError, FormatError):
                return ""
        return f"board {who.board} {who.serial} speaks PROTOCOL.md, version {who.protocol}"


def _another_grid(port: PortInfo, name: str, taxels: int) -> str:
    return (
        f"the marks of {name}, but {taxels} taxels a frame; set skin.grid to their rows x columns,"
        f' skin.profile = "{name}", skin.port = "{port.path}"; if it is another skin, copy'
        " matrix.toml and describe it there"
    )


def fits(profile: SkinProfile, heard: HeardBytes) -> bool:
    """Whether frames of a profile explain nearly all bytes."""
    found = skin_codecs.codec(profile)(Rest(), heard.data)
    # opening the port cut the first frame, closing it cut the last frame
    most = len(heard.data) - len(found.rest.data) - found.size
    return len(found) >= FEWEST_FRAMES and len(found) * found.size >= FITS * most


def measured_hz(profile: SkinProfile, heard: HeardBytes) -> float:
    """Frames per second by their arrivals; 0 for fewer than two."""
    codec, rest, seen = skin_codecs.codec(profile), Rest(), []
    for data, t_ns in heard.reads:
        found = codec(rest, data)
        rest = found.rest
        if len(found):
            seen.append((len(found), t_ns))
    if len(seen) < 2:
        return 0.0
    return sum(n for n, _ in seen[1:]) * 1e9 / (seen[-1][1] - seen[0][1])


def _settings(
    port: PortInfo, fitting: list[str], profiles: Mapping[str, SkinProfile], heard: HeardBytes
) -> str:
    profile = profiles[fitting[0]]
    hz = measured_hz(profile, heard)
    sets = [f'skin.profile = "{fitting[0]}"', f'skin.port = "{port.path}"']
    if hz and not profile.rates_hz and abs(hz / profile.rate_hz - 1) > SAME_RATE:
        sets.append(f"skin.rate_hz = {hz:.1f}")
    more = f" (and as {', '.join(fitting[1:])})" if len(fitting) > 1 else ""
    format = replace(profile.format, rate_hz=round(hz, 1)) if hz else profile.format
    return f"sends {described(format)}{more}; set {', '.join(sets)}"


def _proposed(baud: int, sample: HeardBytes, grid: tuple[int, int] | None) -> str:
    """The text of a profile for lines of numbers at a speed, "" for other bytes."""
    times = [t_ns for _, t_ns in sample.reads]
    if len(times) < 2 or times[-1] == times[0]:
        return ""
    text = skin_text.proposed(sample.data, (times[-1] - times[0]) / 1e9, grid)
    return f"{text}baud = {baud}" if text else ""


def _nothing(
    heard: HeardBytes, profiles: Mapping[str, SkinProfile], write: bool, proposed: bool
) -> str:
    """The reason why no profile fits, and the remedy."""
    if proposed:
        return (
            "sends lines of numbers; `palpate skin new NAME --port PATH --grid ROWSxCOLUMNS` writes"
            " what follows, and `palpate skin check --skin NAME` checks it"
        )
    if line := skin_text.odd_line(heard.data):
        return f"sends {line!r}; {LINES}"
    if heard.data:
        return (
            f"sends {len(heard.data)} bytes, but no frames of a profile; try skin.grid, or copy"
            " matrix.toml, write marker, number, rows and cols (length, index and zeros for frames"
            " in parts) there and check it with `palpate skin check`; frames without a marker or of"
            " changes alone cannot be described: send a marker and all taxels"
        )
    if write:
        return (
            "sends nothing and answers nothing; if it waits for a request of its own, copy"
            " matrix.toml and write it there as `poll`"
        )
    asking = ", ".join(name for name, p in profiles.items() if p.start or requests(p))
    return (
        f"sends nothing unasked; {asking} and boards of PROTOCOL.md may have to be asked: add"
        " --write --port with its path"
    )


def other_grid(profile: SkinProfile, heard: HeardBytes) -> int:
    """Taxels of a frame, by the distance between marks; 0 if it is not constant."""
    mark, data = profile.trailer + profile.marker, heard.data
    places = [at for at in range(len(data)) if mark and data.startswith(mark, at)]
    steps = Counter(later - at for at, later in pairwise(places))
    if not steps:
        return 0
    step, times = steps.most_common(1)[0]
    each = wire_numbers.size(profile.number) * profile.values
    found, most = times * step, len(data) - 2 * step
    whole = times >= FEWEST_FRAMES and found >= FITS * most and (step - len(mark)) % each == 0
    return (step - len(mark)) // each if whole else 0


def on_usb(config: SkinConfig) -> list[str]:
    """A line for each board of PROTOCOL.md on USB; none is opened."""
    import usb.core

    try:
        found = list(usb.core.find(True, idVendor=config.vendor_id, idProduct=config.product_id))
    except usb.core.NoBackendError:
        return []
    ids = f"{config.vendor_id:04x}:{config.product_id:04x}"
    return [
        f"USB {d.bus}-{d.address} ({ids}): {DEFAULT}: it has the ids of skin.usb" for d in found
    ]
