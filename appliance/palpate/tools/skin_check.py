"""`palpate skin check`: compares a readout board with PROTOCOL.md, part 1.

Each part has one result, with advice if it fails. A part that cannot be decided over this link, or
in this time, is unknown.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import Literal

from palpate.core.clock import Clock, DeviceClock
from palpate.core.errors import FormatError, SensorError, SensorMismatch, SensorOverflow
from palpate.core.types import SweepFormat, shown
from palpate.io import packets
from palpate.io.link import SkinLink
from palpate.io.packets import Packet, Request, SkinFormat
from palpate.io.sensor import SensorCounters
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
"""Bytes that the kernel may keep for a serial port without a reader: twice its buffers of 64 kB,
and some more."""
SAMPLE_BYTES = 1 << 16
UNKNOWN_REQUEST = 0x51


@dataclass(frozen=True, slots=True)
class PartResult:
    """The result for one part of the protocol. detail: the observation, and the remedy unless it is
    `ok`."""

    part: str
    verdict: Literal["ok", "FAIL", "unknown"]
    detail: str


@dataclass(slots=True)
class Reception:
    """Bytes and packets of one stretch of listening. packets: with the host time of their
    arrival."""

    packets: list[tuple[int, Packet]] = field(default_factory=list)
    transfers: list[tuple[int, bytes]] = field(default_factory=list)
    garbage: int = 0
    size: int = 0
    sample: bytes = b""

    @property
    def frames(self) -> int:
        return sum(len(p.taxels) for _, p in self.packets)

    def followed(self) -> tuple[list[tuple[int, int, Packet]], int, int, int]:
        """(arrival, unwrapped number, packet) of fresh packets; lost frames; stale frames; restarts
        of the count."""
        fresh, position, lost, stale = packets.follow(
            [p for _, p in self.packets], packets.StreamPosition(0)
        )
        arrivals = {id(p): t_ns for t_ns, p in self.packets}
        return [(arrivals[id(p)], number, p) for number, p in fresh], lost, stale, position.epoch


def _ok(part: str, detail: str) -> PartResult:
    return PartResult(part, "ok", detail)


def _fail(part: str, detail: str) -> PartResult:
    return PartResult(part, "FAIL", detail)


def _unknown(part: str, detail: str) -> PartResult:
    return PartResult(part, "unknown", detail)


class Listener:
    """Reads a link for a while. The leftover of a stretch belongs to the next stretch."""

    def __init__(self, link: SkinLink, clock: Clock) -> None:
        self.link, self.clock = link, clock
        self._leftover = b""

    def listen(self, seconds: float) -> Reception:
        """Everything that arrives in this time."""
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
    link is a serial port, whose buffers are large.

    Raises SensorError if the link itself fails.
    """
    listener = Listener(link, clock)
    link.request(Request.STOP, 0)  # the board may still send for an earlier program
    yield _identity(link)
    sent, finding = _format(link)
    yield finding
    silent = listener.quiet()
    link.request(Request.START, 0)
    first = listener.listen(ANSWER_S)
    yield _start(silent, first, listener)
    if not first.size:
        return
    heard = listener.listen(seconds)
    yield _crc(heard)
    if sent is None or not heard.packets:
        yield _unknown(
            "packets",
            "nothing more can be judged without FORMAT and whole packets; mend these first",
        )
        return
    yield from _stream(heard, sent)
    yield _requests(listener)
    yield _overflow(listener, sent, heard, port=port)
    yield _stop(listener)


def _identity(link: SkinLink) -> PartResult:
    try:
        who = packets.unpack_identity(link.request(Request.IDENTITY, 64))
    except (SensorMismatch, FormatError) as e:
        return _fail("identity", f"{e}; PROTOCOL.md, IDENTITY, has its 36 bytes")
    if who.protocol != packets.VERSION:
        return _fail(
            "identity", f"protocol version {who.protocol}; byte 0 must be {packets.VERSION}"
        )
    if not who.board:
        return _fail("identity", "the board's name is empty; write it to bytes 4 to 19")
    number = who.serial or "no serial number: two such boards look the same"
    return _ok("identity", f"{who.board}, firmware {'.'.join(map(str, who.firmware))}, {number}")


def _format(link: SkinLink) -> tuple[SkinFormat | None, PartResult]:
    """The format and its result; None for a format that cannot be used."""
    try:
        sent = packets.unpack_format(link.request(Request.FORMAT, 64))
        format = _sweep_format(sent)
    except (SensorMismatch, FormatError) as e:
        return None, _fail("format", f"{e}; PROTOCOL.md, FORMAT, has its 16 bytes")
    size = sent.packet_frames * sent.rows * sent.cols * sent.axes * format.numpy_type.itemsize
    fifo_s, packet_s = (sent.fifo_frames / sent.rate_hz, sent.packet_frames / sent.rate_hz)
    text = (
        f"{sent.rows}x{sent.cols} {sent.dtype} at {sent.rate_hz:g} Hz,"
        f" FIFO {fifo_s:.2f} s, {sent.packet_frames} a packet"
    )
    if not (1 <= sent.packet_frames <= packets.MAX_FRAMES and size <= packets.MAX_PAYLOAD):
        return sent, _fail(
            "format", f"{text}: {size} bytes a packet; use 1 to {packets.MAX_PAYLOAD}"
        )
    if fifo_s < LEAST_FIFO_S:
        return sent, _fail("format", f"{text}; the FIFO must hold {LEAST_FIFO_S} s")
    if packet_s > LONGEST_PACKET_S and sent.packet_frames > 1:
        text += f"; {packet_s * 1000:.0f} ms a packet delay the answer, 2 to 8 ms are better"
    return sent, _ok("format", text)


def _sweep_format(sent: SkinFormat) -> SweepFormat:
    return SweepFormat(sent.rows, sent.cols, sent.rate_hz, 1, sent.dtype, sent.axes)


def _start(silent: bool, first: Reception, listener: Listener) -> PartResult:
    if not silent:
        return _fail("start", "it sends before START; begin with request 3, end with request 4")
    if not first.size:
        return _fail(
            "start", f"no byte within {ANSWER_S:g} s of START; send frames after request 3"
        )
    listener.link.request(Request.START, 0)
    again = listener.listen(QUIET_S)
    _, _, stale, restarts = Reception(first.packets + again.packets).followed()
    if not first.packets:
        return _unknown(
            "start", f"{first.size} bytes came after it, and no whole packet; mend that first"
        )
    if stale or restarts or not again.packets:
        return _fail(
            "start",
            "a second START disturbs the stream; it must have no effect while frames are sent",
        )
    return _ok("start", "silent before it, frames after it, a second START changes nothing")


def _crc(heard: Reception) -> PartResult:
    if not heard.garbage and heard.packets:
        return _ok("crc", f"{len(heard.packets)} packets, no byte between them")
    share = f"{heard.garbage} of {heard.size} bytes are in no packet"
    if fault := _crc_fault(heard.sample):
        return _fail("crc", f"{share}: {fault}")
    if not heard.size:
        return _unknown("crc", "no byte came: nothing to judge")
    if not heard.packets:
        hint = "each packet begins with 50 C1 01 00, its length in bytes 4 and 5"
    else:
        hint = (
            "bytes were lost or added on the way: check cable and baud rate, and that nothing"
            " else prints to this port"
        )
    return _fail("crc", f"{share}; {hint}")


def _crc_fault(sample: bytes) -> str:
    """The usual mistake that explains a wrong CRC; "" if none does."""
    at = sample.find(packets.MAGIC)
    while 0 <= at <= len(sample) - packets.HEADER.size:
        length = int.from_bytes(sample[at + 4 : at + 6], "little")
        end = at + packets.HEADER.size + length
        if length <= packets.MAX_PAYLOAD and end + 4 <= len(sample):
            right, got = zlib.crc32(sample[at:end]), sample[end : end + 4]
            mistakes = {
                "the CRC is big-endian; send its lowest byte first": right.to_bytes(4, "big"),
                "the CRC lacks the inversion at its end; xor it with 0xFFFFFFFF": (
                    right ^ 0xFFFFFFFF
                ).to_bytes(4, "little"),
                "the CRC is that of the payload; begin with byte 0 of the header": zlib.crc32(
                    sample[at + packets.HEADER.size : end]
                ).to_bytes(4, "little"),
                "the CRC is 0; compute CRC-32 as in zlib over bytes 0 to 19+n": bytes(4),
            }
            for text, seen in mistakes.items():
                if got == seen:
                    return text
        at = sample.find(packets.MAGIC, at + 1)
    return ""


def _stream(heard: Reception, sent: SkinFormat) -> Iterator[PartResult]:
    """Results for packets, sequence, loss, rate and clock."""
    yield _packets(heard, sent)
    fresh, lost, stale, restarts = heard.followed()
    yield _sequence(heard, stale, restarts)
    if lost:
        flags = sum(bool(p.flags & packets.Flag.OVERFLOW) for _, p in heard.packets)
        why = (
            f"{flags} packets report an overflow"
            if flags
            else "no packet reports an overflow: the frames were never taken"
        )
        detail = f"{lost} of {heard.frames + lost} frames are missing, {why}; lower the rate"
        yield _fail("loss", detail)
    else:
        yield _ok("loss", f"none of {heard.frames} frames is missing")
    period_ns, device = 1e9 / sent.rate_hz, DeviceClock()
    by_count = [(round(number * period_ns), arrival) for arrival, number, _ in fresh]
    by_clock = [(device.unwrap(p.t_us) * 1000, arrival) for arrival, _, p in fresh]
    rate = _compared(
        "rate",
        by_count,
        RATE_TOLERANCE,
        f"FORMAT says {sent.rate_hz:g} Hz",
        "announce the real rate",
    )
    yield rate
    clock = _compared("clock", by_clock, CLOCK_TOLERANCE, "bytes 16 to 19", "count microseconds")
    trouble = _refused(heard, sent) if rate.verdict == "ok" and clock.verdict != "FAIL" else ""
    yield _fail("clock", trouble) if trouble else clock


def _packets(heard: Reception, sent: SkinFormat) -> PartResult:
    """Whether the packets agree with FORMAT."""
    for _, p in heard.packets:
        if p.taxels.shape[1:] != sent.shape or p.taxels.dtype != _sweep_format(sent).numpy_type:
            found = f"{shown(p.taxels.shape[1:])} {p.taxels.dtype}"
            return _fail(
                "packets", f"it sends {found}, FORMAT announces another format; correct one of them"
            )
    sizes = [len(p.taxels) for _, p in heard.packets]
    if max(sizes) > sent.packet_frames:
        return _fail(
            "packets",
            f"{max(sizes)} frames in a packet, FORMAT says {sent.packet_frames}; correct it",
        )
    return _ok("packets", f"{len(sizes)} packets of {median(sizes):g} frames")


def _sequence(heard: Reception, stale: int, restarts: int) -> PartResult:
    runs = [p for _, p in heard.packets]
    steps = {(b.seq - a.seq) % (1 << 32) for a, b in pairwise(runs)}
    if steps == {1} and max(len(p.taxels) for p in runs) > 1:
        return _fail(
            "sequence",
            "it counts packets; bytes 12 to 15 are the number of the first frame, count frames",
        )
    if steps == {0}:
        return _fail("sequence", "the number never changes; count every frame that is taken")
    if restarts or stale:
        text = f"{restarts} restarts of the count, {stale} frames repeated or out of order"
        return _fail("sequence", f"{text}; count on, whatever is sent, and wrap at 2^32")
    return _ok(
        "sequence",
        f"from {runs[0].seq} to {runs[-1].seq + len(runs[-1].taxels) - 1}, always forwards",
    )


def _compared(
    part: str, points: Sequence[tuple[int, int]], tolerance: float, what: str, hint: str
) -> PartResult:
    """Compare the board's times with the host's. points: (board ns, arrival ns). tolerance:
    relative."""
    third = len(points) // 3
    if third < 3:
        return _unknown(part, f"only {len(points)} packets; listen longer with --seconds")
    # a packet may be late, never early: compare the most prompt packets of first and last third
    late = [arrival - at for at, arrival in points]
    first, last = (
        min(range(third), key=late.__getitem__),
        min(range(2 * third, len(points)), key=late.__getitem__),
    )
    span = points[last][1] - points[first][1]
    off = (points[last][0] - points[first][0]) / span - 1
    # the delay of the other packets of a third bounds the error of its most prompt packet
    flat = [(arrival - points[0][1]) * (1 + off) - (at - points[0][0]) for at, arrival in points]
    spread = max(median(some) - min(some) for some in (flat[:third], flat[-third:])) / span
    scale, unit, digits = (100, "%", 2) if tolerance >= RATE_TOLERANCE else (1e6, "ppm", 0)
    text = (
        f"{what}: {off * scale:+.{digits}f} {unit} by the host's clock, give or take"
        f" {spread * scale:.{digits}f} {unit}, "
        f"allowed are {tolerance * scale:g} {unit}"
    )
    if abs(off) - spread > tolerance:
        return _fail(part, f"{text}; {hint}")
    if abs(off) + spread > tolerance:
        return _unknown(part, f"{text}; listen longer with --seconds")
    return _ok(part, text)


def _refused(heard: Reception, sent: SkinFormat) -> str:
    """Why the box would restart this board, whose clock disagrees with its frame count; ""
    otherwise."""
    stream = Stream(_sweep_format(sent), SensorCounters())
    stream.restart()
    try:
        for t_ns, data in heard.transfers:
            stream.feed(data, t_ns)
    except SensorMismatch as e:
        return str(e)
    return ""


def _requests(listener: Listener) -> PartResult:
    """Requests while frames are sent, and a request that does not exist."""
    # a vendor-class board refuses it (a stall); a board on a serial port ignores the byte
    with contextlib.suppress(SensorError):
        listener.link.request(UNKNOWN_REQUEST, 0)  # type: ignore[arg-type]
    try:
        for request in (Request.IDENTITY, Request.FORMAT):
            listener.link.request(request, 64)
    except SensorMismatch as e:
        return _fail("requests", f"while frames are sent: {e}; put the reply between two packets")
    heard = listener.listen(QUIET_S)
    if not heard.packets:
        return _fail(
            "requests", "no frames after requests; go on sending, and leave unknown requests alone"
        )
    return _ok("requests", "answered while frames are sent; an unknown request changes nothing")


def _overflow(listener: Listener, sent: SkinFormat, before: Reception, *, port: bool) -> PartResult:
    """Let the FIFO run over, then look for the gap and its flag."""
    if any(map(_flagged, before.packets)) and not before.followed()[1]:
        return _fail(
            "overflow",
            "bit 1 of byte 6 is set while no frame is missing; clear it after one packet",
        )
    fifo_s = sent.fifo_frames / sent.rate_hz
    rate = before.size / max(1e-9, (before.transfers[-1][0] - before.transfers[0][0]) / 1e9)
    pause_s = 1.5 * fifo_s + (PORT_BYTES / rate if port else 0.1)
    if pause_s > LONGEST_PAUSE_S:
        return _unknown(
            "overflow", f"the port keeps {PORT_BYTES / rate:.0f} s of this stream; not waited for"
        )
    start = listener.listen(QUIET_S)
    listener.clock.sleep_until(listener.clock.now_ns() + round(pause_s * 1e9))
    resumed_ns = listener.clock.now_ns()
    after = listener.listen(pause_s + ANSWER_S)
    lost = Reception(start.packets + after.packets).followed()[1]
    flagged = [packet for _, packet in filter(_flagged, after.packets)]
    kept_s = _age_s(before, flagged[0], resumed_ns) if lost and flagged else 0.0
    return _gap(lost, bool(flagged), pause_s, kept_s, fifo_s)


def _flagged(arrived: tuple[int, Packet]) -> bool:
    """Whether a packet reports an overflow."""
    return bool(arrived[1].flags & packets.Flag.OVERFLOW)


def _gap(lost: int, flagged: bool, pause_s: float, kept_s: float, fifo_s: float) -> PartResult:
    """The result for the gap after a pause. lost: missing frames. kept_s: age of the oldest kept
    frame."""
    if not lost:
        why = "bit 1 of byte 6 is set and no frame is missing" if flagged else "nothing was lost"
        return PartResult(
            "overflow",
            "FAIL" if flagged else "unknown",
            f"{why} in a pause of {pause_s:.1f} s; drop the oldest frames of a full FIFO, then set"
            " bit 1",
        )
    if not flagged:
        text = f"{lost} frames were dropped; set bit 1 of byte 6 in the next packet"
        return _fail("overflow", text)
    if kept_s < 0.8 * fifo_s:
        text = f"{kept_s:.2f} s were kept, FORMAT says {fifo_s:.2f} s"
        return _fail("overflow", f"{text}; drop the oldest frames, not the newest")
    text = f"{lost} frames dropped in a pause of {pause_s:.1f} s, flagged, {kept_s:.2f} s kept"
    return _ok("overflow", text)


def _age_s(before: Reception, packet: Packet, now_ns: int) -> float:
    """Age of a packet's first frame in seconds, measured by the prompt packets before it. Behind a
    gap it is the time that the FIFO had kept."""
    device = DeviceClock()
    offset_ns = min(t_ns - device.unwrap(p.t_us) * 1000 for t_ns, p in before.packets)
    return (now_ns - device.unwrap(packet.t_us) * 1000 - offset_ns) / 1e9


def _stop(listener: Listener) -> PartResult:
    listener.link.request(Request.STOP, 0)
    if not listener.quiet():
        return _fail(
            "stop",
            "frames come after STOP; end with request 4, once the packet under way is complete",
        )
    listener.link.request(Request.START, 0)
    again = listener.listen(ANSWER_S)
    listener.link.request(Request.STOP, 0)
    if not again.packets:
        return _fail("stop", "no frames after STOP and another START; it must begin again")
    return _ok("stop", "silent after it, frames after another START")
