"""PROTOCOL.md over a real pseudo-terminal and pyserial: each failure has its state."""

from __future__ import annotations

import errno
import fcntl
import os
import termios
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace

import numpy as np
import pytest
import serial

from palpate.core.clock import SystemClock
from palpate.core.config import SkinConfig
from palpate.core.errors import SensorAbsent, SensorBusy, SensorDenied, SensorLost, SensorMismatch
from palpate.core.types import EPOCH_BITS, Frames, SweepFormat
from palpate.io import packets, serial_link
from palpate.io.serial_link import ReadoutLink, SerialLink
from palpate.io.serial_port import PortInfo
from palpate.io.usb_sensor import UsbSensor
from palpate.sim import skin
from palpate.sim.rig import VirtualClock
from palpate.tools import pseudo_terminal
from tests.factories.serial_board import SerialBoard
from tests.rig.backends import Skin, skins

FMT = skin.FORMAT
CLOCK = SystemClock()
LIMIT_NS = 20_000_000_000
FAST = {"link": "serial", "retry_ms": 20, "timeout_ms": 50}


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """Two ends of a serial line: the skin's end, and the path of the box's end."""
    with pseudo_terminal.pair() as pair:
        yield pair


@pytest.fixture
def board() -> Iterator[SerialBoard]:
    """A readout board that numbers its frames, not yet plugged in."""
    with ExitStack() as stack:
        yield SerialBoard(skins.board(Skin(), CLOCK), stack)


def sensor_on(board: SerialBoard, format: SweepFormat = FMT, **settings) -> UsbSensor:
    """The driver on the readout board's port."""
    return UsbSensor(SkinConfig(port=str(board.path), **FAST | settings), format, CLOCK)


def read_until(sensor: UsbSensor, done: Callable[[int], bool]) -> Frames:
    """Read until `done(frames so far)`; fails after LIMIT_NS."""
    end_ns, parts = CLOCK.now_ns() + LIMIT_NS, [Frames.empty(FMT)]
    while not done(sum(map(len, parts))):
        assert CLOCK.now_ns() < end_ns, f"{sensor.state}: {sensor.trouble}"
        parts.append(sensor.read())
    return Frames.joined(parts)


def test_streams_and_stops(board):
    """Identity, format, start, frames with the content of their numbers, stop at the end."""
    board.plug()
    with closing(sensor_on(board)) as sensor:
        frames = read_until(sensor, lambda n: n > 1000)
        assert (frames.taxels == skins.counts(frames.seq, FMT)).all()
        assert sensor.counters.garbage_bytes == 0
        assert sensor.identity
        assert sensor.identity.board == "palpate-sim"
        assert sensor.clock
        assert board.board.running
    end_ns = CLOCK.now_ns() + LIMIT_NS
    while board.board.running:
        assert CLOCK.now_ns() < end_ns, "it was not stopped"


def test_unplugged_and_replugged(board):
    """Pulled while frames come: lost, then absent; back, a new epoch with right frames."""
    board.plug()
    with closing(sensor_on(board)) as sensor:
        first = read_until(sensor, lambda n: n > 100)
        board.unplug()
        first = Frames.joined([first, read_until(sensor, lambda n: sensor.state == "lost")])
        assert "unplugged" in str(sensor.trouble)
        read_until(sensor, lambda n: sensor.state == "absent")
        assert str(board.path) in str(sensor.trouble)
        board.plug()
        second = read_until(sensor, lambda n: n > 100)
        assert set(first.seq >> EPOCH_BITS) == {0}
        assert set(second.seq >> EPOCH_BITS) == {1}
        assert sensor.counters.enumerations == 2
        for frames in (first, second):
            assert (frames.taxels == skins.counts(frames.seq, FMT)).all()


def test_a_reply_in_the_middle_of_an_old_stream(line):
    """Frames that an earlier program left running come before the reply and are left out."""
    far, path = line
    who = packets.Identity(1, (1, 2, 3), "board", "7")
    stream = packets.pack(0, 0, np.zeros((6, 4, 4), np.uint8))
    with closing(ReadoutLink(path, 115200, CLOCK)) as link:
        os.write(
            far,
            stream[50:]
            + stream
            + packets.pack_reply(packets.Request.IDENTITY, packets.pack_identity(who)),
        )
        assert packets.unpack_identity(link.request(packets.Request.IDENTITY, 64)) == who
        assert os.read(far, 10) == bytes([packets.Request.IDENTITY])
    assert os.read(far, 10) == bytes([packets.Request.STOP])


@pytest.mark.parametrize(
    ("sent", "hint"),
    [(b"", "sends nothing"), (b"hello", "sends 5 other bytes"), (bytes(20_000), "other bytes but")],
)
def test_no_reply(line, sent, hint):
    """Another device or none: the attempt ends after half a second or too many bytes."""
    far, path = line
    with closing(SerialLink(path, 115200, CLOCK)) as link:
        rest = sent

        def read(size: int, timeout_ms: int) -> bytes:
            nonlocal rest
            rest = rest[os.write(far, rest[:512]) :]
            return SerialLink.read(link, size, timeout_ms)

        link.read = read
        with pytest.raises(SensorMismatch, match=f"{hint}.*request FORMAT"):
            link.request(packets.Request.FORMAT, 64)


def test_bytes_pass_from_the_opening_on(line):
    """All values, b"" in time, cut at `size`; earlier bytes would be taken for frames."""
    far, path = line
    os.write(far, b"old")
    with closing(SerialLink(path, 115200, CLOCK)) as link:
        os.write(far, b"new")
        assert link.read(10, 1000) == b"new"
    far, path = line
    with closing(SerialLink(path, 2_000_000, CLOCK)) as link:
        assert link.read(10, 1) == b""
        every = bytes(range(256))
        os.write(far, every)
        assert link.read(100, 1000) + link.read(1000, 1000) == every
        link.write(every)
        assert os.read(far, 1000) == every


@pytest.mark.parametrize(("held", "pause_ns"), [(100, 8_000_000), (2100, 4_000_000), (4095, 0)])
def test_the_pause_after_a_read(line, held, pause_ns, monkeypatch):
    """The fuller the port was, the sooner it is read again, so that a backlog is caught up with."""
    far, path = line
    clock = VirtualClock()
    with closing(SerialLink(path, 2_000_000, clock)) as link:
        monkeypatch.setattr(os, "read", lambda fd, size: bytes(held))
        os.write(far, b"x")
        assert len(link.read(8192, 1000)) == held
        before = clock.now_ns()
        link.read(8192, 1000)
        assert clock.now_ns() - before == pause_ns


def test_a_port_that_takes_nothing(line, monkeypatch):
    """A skin that does not read its requests is lost; the box does not wait for it without end."""
    monkeypatch.setattr(serial_link, "REPLY_MS", 10)
    with (
        closing(SerialLink(line[1], 115200, CLOCK)) as link,
        pytest.raises(SensorLost, match="unplug"),
    ):
        link.write(bytes(1_000_000))


def test_a_port_has_one_program_and_keeps_dtr(line, monkeypatch):
    """Busy under a lock, errno 11 for others; DTR, which restarts boards, stays."""
    with serial.Serial(line[1], exclusive=True), pytest.raises(SensorBusy, match="another"):
        SerialLink(line[1], 115200, CLOCK)
    SerialLink(line[1], 115200, CLOCK).close()
    link = SerialLink(line[1], 115200, CLOCK)
    with open(line[1], "rb", buffering=0) as other:
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert not termios.tcgetattr(other)[2] & termios.HUPCL
        link.close()
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)


@pytest.mark.parametrize(
    ("code", "kind", "hint"),
    [
        (errno.EBUSY, SensorBusy, "fuser"),
        (errno.EACCES, SensorDenied, "group dialout"),
        (errno.ENOENT, SensorAbsent, "skin.port"),
        (errno.EIO, SensorLost, "baud"),
    ],
)
def test_a_port_that_cannot_be_opened(monkeypatch, code, kind, hint):
    """Each errno of opening has its state and names the port."""

    def refuse(*args, **options) -> None:
        raise serial.SerialException(code, "refused")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(kind, match=hint) as e:
        SerialLink("/dev/ttyX9", 115200, CLOCK)
    assert type(e.value) is kind
    assert "/dev/ttyX9" in str(e.value)


@pytest.mark.parametrize("path", ["/dev/null", "/etc/passwd", "/tmp"])
def test_a_file_that_is_not_a_serial_port(path):
    """The message says so and names the option, with the real pyserial."""
    with pytest.raises(SensorLost, match=f"{path} is not .*--port"):
        SerialLink(path, 115200, CLOCK)


def test_ids_find_the_port(tmp_path):
    """The first with ids and serial number, also those of the settings; else all are named."""
    ports = [
        PortInfo("/dev/ttyS0"),
        PortInfo("/dev/ttyUSB0", 0x1A86, 0x7523, "", "USB Serial"),
        PortInfo("/dev/ttyACM0", 0x2E8A, 0x0005, "a", "Pico"),
        PortInfo("/dev/ttyACM1", 0x2E8A, 0x0005, "b", "Pico"),
    ]
    assert serial_link.find([(0x2E8A, 5)], "", ports) == "/dev/ttyACM0"
    assert serial_link.find([(1, 2), (0x2E8A, 5)], "b", ports) == "/dev/ttyACM1"
    with pytest.raises(SensorAbsent, match="2e8a:0005"):
        serial_link.find([(0x2E8A, 5)], "c", ports)
    with pytest.raises(SensorAbsent, match="none"):
        serial_link.find([(0x2E8A, 5)], "", [])
    config = SkinConfig(link="serial", usb="2e8a:0005")
    with pytest.raises(SensorAbsent, match="2e8a:0005"):
        serial_link.open_readout(config, CLOCK, lambda: [PortInfo("/dev/ttyACM0", 0x1209, 0x7AC7)])
    with pseudo_terminal.pair() as (_, name):
        serial_link.open_readout(config, CLOCK, lambda: [PortInfo(name, 0x2E8A, 5)]).close()
        serial_link.open_readout(replace(config, port=name), CLOCK, list).close()
