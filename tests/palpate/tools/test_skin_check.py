"""Conformance of readout boards: a sound board passes, each fault is found and named."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from palpate.cli.main import main
from palpate.core.config import SkinConfig
from palpate.core.errors import SensorLost, SensorMismatch
from palpate.io import packets
from palpate.io.usb_sensor import open_link
from palpate.sim import rig, skin
from palpate.sim.devices import SimDevices
from palpate.tools import skin_check
from palpate.tools.skin_check import PartResult
from tests.factories import pico
from tests.factories.simulated_box import idle_devices

PARTS = (
    *("identity", "format", "start", "crc", "packets", "sequence"),
    *("loss", "rate", "clock", "requests", "overflow", "stop"),
)
Fault = Callable[[SimDevices], object]


def findings(simulated: SimDevices, seconds: float = 5) -> dict[str, PartResult]:
    """The findings of a board on the simulated bus, in their order."""
    config = SkinConfig(link="acm" if simulated.backend.acm else "vendor")
    link = open_link(config, simulated.backend, simulated.clock)
    found = list(skin_check.check(link, simulated.clock, seconds, port=False))
    link.close()
    assert len({f.part for f in found}) == len(found)
    return {f.part: f for f in found}


def of_packets(change: Callable[[packets.Packet], packets.Packet]) -> Fault:
    """Each packet changed, with a right CRC."""

    def mangled(data: bytes) -> bytes:
        (p,) = packets.unpack(data).packets
        p = change(p)
        return packets.pack(p.seq, p.t_us, p.taxels, p.flags)

    return of_bytes(mangled)


def of_crc(crc: Callable[[bytes], bytes]) -> Fault:
    """Each packet with another CRC."""
    return of_bytes(lambda data: data[:-4] + crc(data[:-4]))


def of_bytes(change: Callable[[bytes], bytes]) -> Fault:
    """Each transfer changed."""
    return lambda simulated: setattr(simulated.backend, "mangle", change)


def of_replies(number: int, change: Callable[[bytes], bytes]) -> Fault:
    """One reply changed."""
    return lambda simulated: _intercepted(
        simulated, lambda right, n: change(right(n)) if n == number else right(n)
    )


def _intercepted(simulated: SimDevices, answer: Callable[[Any, int], bytes]) -> None:
    """The board answers requests by `answer`, which gets its own method."""
    board = simulated.backend.board
    board.request = partial(answer, board.request)  # type: ignore[method-assign]


def of_requests(change: Callable[[rig.ReadoutBoard, int], bool]) -> Fault:
    """Requests that `change` deals with itself are not seen by the board."""
    return lambda simulated: _intercepted(
        simulated, lambda right, n: b"" if change(simulated.backend.board, n) else right(n)
    )


def of_format(**changes: object) -> Fault:
    """FORMAT disagrees with the packets."""
    return lambda simulated: of_replies(
        packets.Request.FORMAT,
        lambda _: packets.pack_format(replace(simulated.backend.board.skin, **changes)),
    )(simulated)


def every(n: int, change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Only each nth transfer changed."""
    count = iter(range(10**9))
    return lambda data: change(data) if next(count) % n == n - 1 else data


def restarting(simulated: SimDevices) -> None:
    """The count begins again every 200 packets."""
    of_packets(lambda p: replace(p, seq=p.seq % 1200 + (1 << 20) * (p.seq // 1200 % 2)))(simulated)


class NewestDropped(rig.ReadoutBoard):
    """A board whose full FIFO keeps the oldest frames; it says that it has overflowed."""

    cut = resume = -1

    def take(self) -> bytes:
        """The packet that is due."""
        fifo, self.skin = self.skin.fifo_frames, replace(self.skin, fifo_frames=10**9)
        taken = int((self._clock.now_ns() - self._origin_ns) / self._period_ns)
        if taken - self._next > fifo:
            self.cut, self.resume = self._next + fifo, taken
        jumped = 0 <= self.cut <= self._next
        if jumped:
            self._next, self.cut = self.resume - self.skin.packet_frames, -1
        data = super().take()
        self.skin = replace(self.skin, fifo_frames=fifo)
        (p,) = packets.unpack(data).packets
        return packets.pack(p.seq, p.t_us, p.taxels, packets.Flag.OVERFLOW if jumped else 0)


def newest_dropped(simulated: SimDevices) -> None:
    """Another board on the bus."""
    simulated.backend.board = NewestDropped(skin.FORMAT, simulated.robot, simulated.clock)


FAULTS: dict[str, Fault] = {
    "identity: of 20 bytes": of_replies(1, lambda r: r[:20]),
    "identity: protocol version 2": of_replies(1, lambda r: b"\2" + r[1:]),
    "identity: name is empty": of_replies(1, lambda r: r[:4] + bytes(16) + r[20:]),
    "format: of 8 bytes": of_replies(2, lambda r: r[:8]),
    "format: data type 7": of_replies(2, lambda r: r[:2] + b"\7" + r[3:]),
    "format: 0.0 Hz": of_format(rate_hz=0),
    "format: 0.25 s": of_format(fifo_frames=100),
    "format: 0 bytes a packet": of_format(packet_frames=0),
    "format: 4800 bytes a packet": of_format(packet_frames=300),
    "start: before START": of_requests(lambda b, n: n == 4 and setattr(b, "running", True) is None),
    "start: no byte": of_requests(lambda b, n: n == 3),
    "crc: big-endian": of_crc(lambda d: struct.pack(">I", zlib.crc32(d))),
    "crc: inversion": of_crc(lambda d: struct.pack("<I", zlib.crc32(d) ^ 0xFFFFFFFF)),
    "crc: of the payload": of_crc(lambda d: struct.pack("<I", zlib.crc32(d[20:]))),
    "crc: CRC is 0": of_crc(lambda d: bytes(4)),
    "crc: 50 C1 01 00": of_crc(lambda d: b"\1\2\3\4"),
    "crc: nothing else prints": of_bytes(every(50, lambda d: b"debug: 17\n" + d)),
    "crc: lost or added": of_bytes(every(50, lambda d: d[:30] + d[31:])),
    "packets: 2x8": of_packets(lambda p: replace(p, taxels=p.taxels.reshape(-1, 2, 8))),
    "packets: FORMAT says 2": of_format(packet_frames=2),
    "sequence: counts packets": of_packets(lambda p: replace(p, seq=p.seq // 4)),
    "sequence: never changes": of_packets(lambda p: replace(p, seq=7)),
    "sequence: restarts": restarting,
    "loss: reports an overflow": of_bytes(every(10, lambda d: b"")),
    "rate: -6.25 %": of_format(rate_hz=800.0),
    "rate: +7.1": of_format(rate_hz=700.0),
    "clock: microseconds": of_packets(lambda p: replace(p, t_us=p.t_us // 1000)),
    "clock: +1000 ppm": of_packets(lambda p: replace(p, t_us=round(p.t_us * 1.001))),
    "clock: skin's clock": of_packets(
        lambda p: replace(p, t_us=p.t_us + 30_000 * (p.seq // 100 % 7 == 3))
    ),
    "requests: unknown": of_requests(lambda b, n: n == 0x51 and b.request(4) is None),
    "overflow: no frame is missing": of_packets(lambda p: replace(p, flags=2)),
    "overflow: bit 1 of byte 6": of_packets(lambda p: replace(p, flags=0)),
    "overflow: not the newest": newest_dropped,
    "overflow: FORMAT says 2.00 s": of_format(fifo_frames=1500),
    "stop: after STOP": of_requests(lambda b, n: n == 4 and b.due_ns() is not None),
}
"""The part that must fail with what its line contains, and what is wrong."""


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found(name):
    """The part fails with a remedy, and independent parts are ok."""
    # Parts that may fail with a part
    depends = {
        "format": PARTS,
        "crc": PARTS,
        "packets": ("rate", "clock"),
        "sequence": ("start", *PARTS[4:]),
        "loss": ("overflow",),
        "rate": ("clock", "overflow"),
        "clock": ("overflow",),
        "start": PARTS,
        "requests": PARTS[10:],
    }
    simulated = idle_devices(acm=True)
    FAULTS[name](simulated)
    part, _, words = name.partition(": ")
    found = findings(simulated)
    assert found[part].verdict == "FAIL", found
    assert words in found[part].detail
    failed = {n for n, f in found.items() if f.verdict == "FAIL"}
    assert failed <= {part, *depends.get(part, ())}


@pytest.mark.parametrize("acm", [False, True])
def test_a_sound_board_passes(acm):
    """Every part, over bulk transfers and over a serial port of USB."""
    found = findings(idle_devices(acm=acm))
    assert tuple(found) == PARTS
    assert {f.verdict for f in found.values()} == {"ok"}, found


def test_a_board_is_started_and_stopped():
    """Left sending by a killed program it passes; one that stops for good is found."""
    simulated = idle_devices(acm=True)
    simulated.backend.board.request(packets.Request.START)
    simulated.clock.sleep_until(simulated.clock.now_ns() + 20_000_000_000)
    found = findings(simulated)
    assert {f.verdict for f in found.values()} == {"ok"}, found
    simulated = idle_devices(acm=True)
    stops: list[int] = []
    of_requests(lambda b, n: stops.append(n) or (stops.count(4) > 1 and n == 3))(simulated)
    assert "another" in findings(simulated)["stop"].detail


def test_what_cannot_be_decided_is_unknown():
    """Too short a time, jitter, a FIFO that does not run over."""
    found = findings(idle_devices(), seconds=0.02)
    assert (found["rate"].verdict, found["clock"].verdict) == ("unknown", "unknown")
    assert "--seconds" in found["clock"].detail
    delays = iter(range(10**9))
    found = findings(idle_devices(latency=lambda: 150_000 + next(delays) * 7919 % 4000_000))
    assert found["rate"].verdict == "ok"
    assert found["clock"].verdict == "unknown"
    simulated = idle_devices()
    simulated.backend.board.skin = replace(simulated.backend.board.skin, fifo_frames=10**6)
    of_format(fifo_frames=750)(simulated)
    assert findings(simulated)["overflow"].verdict == "unknown"


def test_a_pulled_cable_ends_the_check_and_no_reply_is_found():
    """With the link's error; over a serial port, where replies come between packets."""
    simulated = idle_devices()
    simulated.backend.at(simulated.clock.now_ns() + 3_000_000_000, simulated.backend.unplug)
    with pytest.raises(SensorLost, match="unplugged"):
        findings(simulated)
    simulated = idle_devices(acm=True)
    of_requests(lambda b, n: b.running and n in (1, 2))(simulated)
    assert "IDENTITY" in findings(simulated)["requests"].detail


def test_another_device_at_the_port_is_told_apart():
    """Another device answers nothing and sends no packets: no part is ok, and the check ends."""

    class EchoLink:
        """A device that sends each byte back, as a terminal does; it never answers."""

        def __init__(self) -> None:
            self.clock, self.sent = rig.VirtualClock(), b""

        def request(self, request: packets.Request, length: int) -> bytes:
            """No reply."""
            self.sent += bytes([request])
            if length:
                raise SensorMismatch(
                    f"the skin sends 1 other bytes but does not answer request {request.name}"
                )
            return b""

        def read(self, size: int, timeout_ms: int) -> bytes:
            """The echo."""
            self.clock.sleep_until(self.clock.now_ns() + timeout_ms * 1_000_000)
            data, self.sent = self.sent, b""
            return data

        def close(self) -> None:
            """Nothing is held."""

    link = EchoLink()
    found = {f.part: f for f in skin_check.check(link, link.clock, 5, port=True)}
    assert [found[part].verdict for part in ("identity", "format", "start")] == [
        "FAIL",
        "FAIL",
        "unknown",
    ]
    assert "FORMAT" in found["format"].detail
    assert found["start"].detail.startswith("1 bytes ")
    assert not [f for f in found.values() if f.verdict == "ok"]


def of_a_port(
    capsys: pytest.CaptureFixture[str], port: str, *options: str
) -> dict[str, tuple[str, str]]:
    """(verdict, detail) by part, as `palpate skin check` prints them for a port."""
    sets = ("--set", "skin.link=serial", "--set", f"skin.port={port}")
    ended = main(["skin", "check", *sets, *options])
    lines = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    assert ended == any(line[0] == "FAIL" for line in lines)
    return {part: (verdict, detail) for verdict, part, detail in lines}


@pytest.mark.slow
def test_the_pico_passes(capsys):
    """The reference firmware under MicroPython: nothing fails but by the busy machine."""
    with pico.plugged_in(ROWS=16, COLS=16, RATE_HZ=200, DTYPE="uint16", FIFO_S=0.5) as port:
        found = of_a_port(capsys, port, "--seconds", "2")
    assert tuple(found) == PARTS
    timed = {"rate", "clock", "loss", "start"}
    assert {verdict for name, (verdict, _) in found.items() if name not in timed} == {"ok"}, found


@pytest.mark.slow
def test_a_pico_that_is_too_slow_is_found(capsys):
    """Late interrupts: frames are missing, while count and clock agree."""
    with pico.plugged_in(RATE_HZ=200, late_ms=20, late_every=10) as port:
        found = of_a_port(capsys, port, "--seconds", "3")
    verdict, detail = found["loss"]
    assert verdict == "FAIL"
    assert detail.endswith("lower the rate")
    assert found["sequence"][0] == "ok"
    # at 3.2 kB/s the kernel's buffer for a port lasts longer than the longest pause
    assert found["overflow"][0] == "unknown"
    assert "waited" in found["overflow"][1]
