"""`palpate skin check`: compares a readout board with PROTOCOL.md, part 1.

Each part has one result, with advice if it fails. A part that cannot be decided over this link, or
in this time, is unknown.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import Literal

from palpate.core.clock import Clock, DeviceClock
from palpate.core.errors import FormatError, SensorError, SensorMismatch, SensorOverflow
from palpate.core.types import SweepFormat, shown
from palpate.io import packets
from palpate.io.packets import Packet, Request, SkinFormat
from palpate.io.sensor import SensorCounters, SkinLink
from palpate.io.usb_sensor import RATE_TOLERANCE, Stream

CLOCK_TOLERANCE = 200e-6
"""Largest relative deviation of a board's clock."""
LEAST_FIFO_S = 0.25
LONGEST_PACKET_S = 0.008
ANSWER_S = 1.0
"""Time for the first frames after START."""
QUIET_S = 0.3
"""Time without a frame after STOP; one packet may still arrive before."""
LONGEST_PAUSE_S = 20.0
PORT_BYTES = 140_000
"""Bytes that the kernel may keep for a serial port without a reader, and some more."""
SAMPLE_BYTES = 1 << 16
UNKNOWN_REQUEST = 0x51


@dataclass(frozen=True, slots=True)
class PartResult:
    """The result for a part of the protocol. detail: the observation, and the remedy."""

    part: str
    verdict: Literal["ok", "FAIL", "unknown"]
    detail: str


@dataclass(slots=True)
class Reception:
    """Bytes and packets of a stretch of listening, with their arrivals."""

    packets: list[tuple[int, Packet]] = field(default_factory=list)
    transfers: list[tuple[int, bytes]] = field(default_factory=list)
    garbage: int = 0
    size: int = 0
    sample: bytes = b""

    @property
    def frames(self) -> int:
        return sum(len(p.taxels) for _, p in self.packets)

    def followed(self) -> tuple[list[tuple[int, int, Packet]], int, int, int]:
        """(arrival, number, packet) of fresh packets; lost; stale frames; restarts."""
        fresh, position, lost, stale = packets.follow(
            [p for _, p in self.packets], packets.StreamPosition(0)
        )
        arrivals = {id(p): t_ns for t_ns, p in self.packets}
        return [(arrivals[id(p)], number, p) for number, p in fresh], lost, stale, position.epoch


class Fails(Exception):
    """The fault of a board in a part, and the remedy."""


class Undecided(Exception):
    """Why a part cannot be judged."""


def _result(part: str, judge: Callable[[], str]) -> PartResult:
    """The result of `judge`, which returns what it observed or raises one of these."""
    try:
        return PartResult(part, "ok", judge())
    except Fails as e:
        return PartResult(part, "FAIL", str(e))
    except Undecided as e:
        return PartResult(part, "unknown", str(e))


class Listener:
    """Reads a link for a while. The leftover of a stretch belongs to the next stretch."""

    def __init__(self, link: SkinLink, clock: Clock) -> None:
        self.link, self.clock = link, clock
        self._leftover = b""

    def listen(self, seconds: float) -> Reception:
        heard, end_ns = Reception(), self.clock.now_ns() + round(seconds * 1e9)
        while (left_ns := end_ns - self.clock.now_ns()) > 0:
            try:
                data = self.link.read(4096, max(1, min(100, left_ns // 1_000_000)))
            except SensorOverflow:
                continue  # its frames are missing in the count
            if data:
                self._add(heard, data)
        return heard

    def _add(self, heard: Reception, data: bytes) -> None:
        now = self.clock.now_ns()
        read = packets.unpack(self._leftover + data)
        self._leftover = read.leftover
        heard.packets += [(now, p) for p in read.packets]
        heard.transfers.append((now, data))
        heard.garbage += read.garbage
        heard.size += len(data)
        heard.sample += data[: SAMPLE_BYTES - len(heard.sample)]

    def quiet(self) -> bool:
        """Whether QUIET_S pass without a byte, within a second of the last request."""
        end_ns = self.clock.now_ns() + 1_000_000_000
        while self.listen(QUIET_S).size:
            if self.clock.now_ns() > end_ns:
                return False
        self._leftover = b""
        return True


def check(link: SkinLink, clock: Clock, seconds: float, *, port: bool) -> Iterator[PartResult]:
    """The results, one after the other. seconds: time for listening to frames. port: whether the
    link is a serial port, whose buffers are large. Raises SensorError if the link itself fails."""
    listener = Listener(link, clock)
    link.request(Request.STOP, 0)  # the board may still send for an earlier program
    yield _result("identity", lambda: _identity(link))
    sent: list[SkinFormat] = []
    yield _result("format", lambda: _format(link, sent))
    silent = listener.quiet()
    link.request(Request.START, 0)
    first = listener.listen(ANSWER_S)
    yield _result("start", lambda: _start(silent, first, listener))
    if not first.size:
        return
    heard = listener.listen(seconds)
    yield _result("crc", lambda: _crc(heard))
    if not sent or not heard.packets:
        yield PartResult("packets", "unknown", "needs FORMAT and whole packets; mend these first")
        return
    yield from _stream(heard, sent[0])
    yield _result("requests", lambda: _requests(listener))
    yield _result("overflow", lambda: _overflow(listener, sent[0], heard, port=port))
    yield _result("stop", lambda: _stop(listener))


def _identity(link: SkinLink) -> str:
    try:
        who = packets.unpack_identity(link.request(Request.IDENTITY, 64))
    except (SensorMismatch, FormatError) as e:
        raise Fails(f"{e}; PROTOCOL.md, IDENTITY, has its 36 bytes") from e
    if who.protocol != packets.VERSION:
        raise Fails(f"protocol version {who.protocol}; byte 0 must be {packets.VERSION}")
    if not who.board:
        raise Fails("the board's name is empty; write it to bytes 4 to 19")
    number = who.serial or "no serial number: two such boards look the same"
    return f"{who.board}, firmware {'.'.join(map(str, who.firmware))}, {number}"


def _format(link: SkinLink, found: list[SkinFormat]) -> str:
    """Judge the format, and put it into `found` if it can be used."""
    try:
        sent = packets.unpack_format(link.request(Request.FORMAT, 64))
        format = _sweep_format(sent)
    except (SensorMismatch, FormatError) as e:
        raise Fails(f"{e}; PROTOCOL.md, FORMAT, has its 16 bytes") from e
    found.append(sent)
    size = sent.packet_frames * format.channels * format.numpy_type.itemsize
    fifo_s, packet_s = (sent.fifo_frames / sent.rate_hz, sent.packet_frames / sent.rate_hz)
    text = (
        f"{sent.rows}x{sent.cols} {sent.dtype} at {sent.rate_hz:g} Hz,"
        f" FIFO {fifo_s:.2f} s, {sent.packet_frames} a packet"
    )
    if not (1 <= sent.packet_frames <= packets.MAX_FRAMES and size <= packets.MAX_PAYLOAD):
        raise Fails(f"{text}: {size} bytes a packet; use 1 to {packets.MAX_PAYLOAD}")
    if fifo_s < LEAST_FIFO_S:
        raise Fails(f"{text}; the FIFO must hold {LEAST_FIFO_S} s")
    if packet_s > LONGEST_PACKET_S and sent.packet_frames > 1:
        text += f"; {packet_s * 1000:.0f} ms a packet delay the answer, 2 to 8 ms are better"
    return text


def _sweep_format(sent: SkinFormat) -> SweepFormat:
    return SweepFormat(sent.rows, sent.cols, sent.rate_hz, 1, sent.dtype, sent.axes)


def _start(silent: bool, first: Reception, listener: Listener) -> str:
    if not silent:
        raise Fails("it sends before START; begin with request 3, end with request 4")
    if not first.size:
        raise Fails(f"no byte within {ANSWER_S:g} s of START; send frames after request 3")
    listener.link.request(Request.START, 0)
    again = listener.listen(QUIET_S)
    _, _, stale, restarts = Reception(first.packets + again.packets).followed()
    if not first.packets:
        raise Undecided(f"{first.size} bytes came after it, and no whole packet; mend that first")
    if stale or restarts or not again.packets:
        raise Fails("a second START disturbs the stream; it must change nothing then")
    return "silent before it, frames after it, a second START changes nothing"


def _crc(heard: Reception) -> str:
    if not heard.garbage and heard.packets:
        return f"{len(heard.packets)} packets, no byte between them"
    if not heard.size:
        raise Undecided("no byte came: nothing to judge")
    hint = _crc_fault(heard.sample)
    if not hint and heard.packets:
        hint = (
            "bytes were lost or added: check cable, baud, and that nothing else prints to this port"
        )
    hint = hint or "each packet begins with 50 C1 01 00, its length in bytes 4 and 5"
    raise Fails(f"{heard.garbage} of {heard.size} bytes are in no packet; {hint}")


def _crc_fault(sample: bytes) -> str:
    """The usual mistake that explains a wrong CRC; "" if none does."""
    at = sample.find(packets.MAGIC)
    while 0 <= at <= len(sample) - packets.HEADER.size:
        body = at + packets.HEADER.size
        end = body + int.from_bytes(sample[at + 4 : at + 6], "little")
        if end - body <= packets.MAX_PAYLOAD and end + 4 <= len(sample):
            right, got = zlib.crc32(sample[at:end]), sample[end : end + 4]
            payload = zlib.crc32(sample[body:end])
            mistakes = {
                right.to_bytes(4, "big"): "is big-endian; send its lowest byte first",
                (right ^ 0xFFFFFFFF).to_bytes(4, "little"): (
                    "lacks the inversion at its end; xor it with 0xFFFFFFFF"
                ),
                payload.to_bytes(4, "little"): "is that of the payload; begin with the header",
                bytes(4): "is 0; compute CRC-32 as in zlib over bytes 0 to 19+n",
            }
            if got in mistakes:
                return f"the CRC {mistakes[got]}"
        at = sample.find(packets.MAGIC, at + 1)
    return ""


def _stream(heard: Reception, sent: SkinFormat) -> Iterator[PartResult]:
    """Results for packets, sequence, loss, rate and clock."""
    yield _result("packets", lambda: _packets(heard, sent))
    fresh, lost, stale, restarts = heard.followed()
    yield _result("sequence", lambda: _sequence(heard, stale, restarts))
    yield _result("loss", lambda: _loss(heard, lost))
    period_ns, device = 1e9 / sent.rate_hz, DeviceClock()
    counted = [(round(number * period_ns), arrival) for arrival, number, _ in fresh]
    stamped = [(device.unwrap(p.t_us) * 1000, arrival) for arrival, _, p in fresh]
    said = f"FORMAT says {sent.rate_hz:g} Hz", "announce the real rate"
    rate = _result("rate", lambda: _compared(counted, RATE_TOLERANCE, *said))
    yield rate
    said = "bytes 16 to 19", "count microseconds"
    clock = _result("clock", lambda: _compared(stamped, CLOCK_TOLERANCE, *said))
    trouble = _refused(heard, sent) if rate.verdict == "ok" and clock.verdict != "FAIL" else ""
    yield PartResult("clock", "FAIL", trouble) if trouble else clock


def _loss(heard: Reception, lost: int) -> str:
    if not lost:
        return f"none of {heard.frames} frames is missing"
    flags = sum(map(_flagged, heard.packets))
    why = "no packet reports an overflow: the frames were never taken"
    why = f"{flags} packets report an overflow" if flags else why
    raise Fails(f"{lost} of {heard.frames + lost} frames are missing, {why}; lower the rate")


def _packets(heard: Reception, sent: SkinFormat) -> str:
    """Whether the packets agree with FORMAT."""
    for _, p in heard.packets:
        if p.taxels.shape[1:] != sent.shape or p.taxels.dtype != _sweep_format(sent).numpy_type:
            found = f"{shown(p.taxels.shape[1:])} {p.taxels.dtype}"
            raise Fails(f"it sends {found}, FORMAT announces another format; correct one of them")
    sizes = [len(p.taxels) for _, p in heard.packets]
    if (most := max(sizes)) > sent.packet_frames:
        raise Fails(f"{most} frames in a packet, FORMAT says {sent.packet_frames}; correct it")
    return f"{len(sizes)} packets of {median(sizes):g} frames"


def _sequence(heard: Reception, stale: int, restarts: int) -> str:
    runs = [p for _, p in heard.packets]
    steps = {(b.seq - a.seq) % (1 << 32) for a, b in pairwise(runs)}
    if steps == {1} and max(len(p.taxels) for p in runs) > 1:
        raise Fails("it counts packets; bytes 12 to 15 are the number of the first frame")
    if steps == {0}:
        raise Fails("the number never changes; count every frame that is taken")
    if restarts or stale:
        text = f"{restarts} restarts of the count, {stale} frames repeated or out of order"
        raise Fails(f"{text}; count on, whatever is sent, and wrap at 2^32")
    return f"from {runs[0].seq} to {runs[-1].seq + len(runs[-1].taxels) - 1}, always forwards"


def _compared(points: Sequence[tuple[int, int]], tolerance: float, what: str, hint: str) -> str:
    """Compare the board's times with the host's: (board ns, arrival ns). tolerance: relative."""
    third = len(points) // 3
    if third < 3:
        raise Undecided(f"only {len(points)} packets; listen longer with --seconds")
    # a packet may be late, never early: compare the most prompt packets of first and last third
    late = [arrival - at for at, arrival in points]
    first = min(range(third), key=late.__getitem__)
    last = min(range(2 * third, len(points)), key=late.__getitem__)
    span = points[last][1] - points[first][1]
    off = (points[last][0] - points[first][0]) / span - 1
    # the delay of the other packets of a third bounds the error of its most prompt packet
    flat = [(arrival - points[0][1]) * (1 + off) - (at - points[0][0]) for at, arrival in points]
    spread = max(median(some) - min(some) for some in (flat[:third], flat[-third:])) / span
    scale, unit, digits = (100, "%", 2) if tolerance >= RATE_TOLERANCE else (1e6, "ppm", 0)
    text = (
        f"{what}: {off * scale:+.{digits}f} {unit} by the host's clock, give or take"
        f" {spread * scale:.{digits}f} {unit}, allowed are {tolerance * scale:g} {unit}"
    )
    if abs(off) - spread > tolerance:
        raise Fails(f"{text}; {hint}")
    if abs(off) + spread > tolerance:
        raise Undecided(f"{text}; listen longer with --seconds")
    return text


def _refused(heard: Reception, sent: SkinFormat) -> str:
    """Why the box would restart this board, whose clock and count disagree; "" otherwise."""
    stream = Stream(_sweep_format(sent), SensorCounters())
    stream.restart()
    try:
        for t_ns, data in heard.transfers:
            stream.feed(data, t_ns)
    except SensorMismatch as e:
        return str(e)
    return ""


def _requests(listener: Listener) -> str:
    """Requests while frames are sent, and a request that does not exist."""
    # a vendor-class board refuses it (a stall); a board on a serial port ignores the byte
    with contextlib.suppress(SensorError):
        listener.link.request(UNKNOWN_REQUEST, 0)  # type: ignore[arg-type]
    try:
        for request in (Request.IDENTITY, Request.FORMAT):
            listener.link.request(request, 64)
    except SensorMismatch as e:
        raise Fails(f"while frames are sent: {e}; put the reply between two packets") from e
    if not listener.listen(QUIET_S).packets:
        raise Fails("no frames after requests; go on sending, and leave unknown requests alone")
    return "answered while frames are sent; an unknown request changes nothing"


def _overflow(listener: Listener, sent: SkinFormat, before: Reception, *, port: bool) -> str:
    """Let the FIFO run over, then look for the gap and its flag."""
    if any(map(_flagged, before.packets)) and not before.followed()[1]:
        raise Fails("bit 1 of byte 6 is set while no frame is missing; clear it after one packet")
    fifo_s = sent.fifo_frames / sent.rate_hz
    rate = before.size / max(1e-9, (before.transfers[-1][0] - before.transfers[0][0]) / 1e9)
    pause_s = 1.5 * fifo_s + (PORT_BYTES / rate if port else 0.1)
    if pause_s > LONGEST_PAUSE_S:
        raise Undecided(f"the port keeps {PORT_BYTES / rate:.0f} s of this stream; not waited for")
    start = listener.listen(QUIET_S)
    listener.clock.sleep_until(listener.clock.now_ns() + round(pause_s * 1e9))
    resumed_ns = listener.clock.now_ns()
    after = listener.listen(pause_s + ANSWER_S)
    lost = Reception(start.packets + after.packets).followed()[1]
    flagged = [packet for _, packet in filter(_flagged, after.packets)]
    if not lost and not flagged:
        raise Undecided(f"nothing was lost in a pause of {pause_s:.1f} s; see to the FIFO's flag")
    if not lost:
        raise Fails(f"bit 1 of byte 6 is set and no frame is missing after {pause_s:.1f} s")
    if not flagged:
        raise Fails(f"{lost} frames were dropped; set bit 1 of byte 6 in the next packet")
    kept_s = _age_s(before, flagged[0], resumed_ns)
    if kept_s < 0.8 * fifo_s:
        text = f"{kept_s:.2f} s were kept, FORMAT says {fifo_s:.2f} s"
        raise Fails(f"{text}; drop the oldest frames, not the newest")
    return f"{lost} frames dropped in a pause of {pause_s:.1f} s, flagged, {kept_s:.2f} s kept"


def _flagged(arrived: tuple[int, Packet]) -> bool:
    return bool(arrived[1].flags & packets.Flag.OVERFLOW)


def _age_s(before: Reception, packet: Packet, now_ns: int) -> float:
    """Age of a packet's first frame in seconds, measured by the prompt packets before it. Behind a
    gap it is the time that the FIFO had kept."""
    device = DeviceClock()
    offset_ns = min(t_ns - device.unwrap(p.t_us) * 1000 for t_ns, p in before.packets)
    return (now_ns - device.unwrap(packet.t_us) * 1000 - offset_ns) / 1e9


def _stop(listener: Listener) -> str:
    listener.link.request(Request.STOP, 0)
    if not listener.quiet():
        raise Fails("frames come after STOP; end with request 4, after the packet under way")
    listener.link.request(Request.START, 0)
    again = listener.listen(ANSWER_S)
    listener.link.request(Request.STOP, 0)
    if not again.packets:
        raise Fails("no frames after STOP and another START; it must begin again")
    return "silent after it, frames after another START"
