"""Comparison of the device clock with the frame count, and faults that end by themselves. In
virtual time.

Packets are altered on the cable; no frame may get a wrong host time.
"""

from __future__ import annotations

import errno
from collections.abc import Callable

import numpy as np
import pytest
import usb.core

from palpate.core.config import SkinConfig, SweepConfig
from palpate.core.types import EPOCH_BITS, Edge, EdgeKind, Frames, Status, SweepFormat
from palpate.io import packets as wire
from palpate.io.usb_sensor import UsbSensor
from palpate.sim import skin
from palpate.sim.devices import SimDevices
from palpate.sweeps.sweep_window import SweepCutter
from tests.factories.simulated_box import SECOND, idle_devices

FMT = skin.FORMAT
COUNTS = 1 << 32
Alter = Callable[[wire.Packet, wire.Packet], tuple[int, int]]


def sensor_on(simulated: SimDevices, **settings) -> UsbSensor:
    """The real driver on the simulated bus."""
    return UsbSensor(SkinConfig(**settings), FMT, simulated.clock, simulated.backend)


def read_for(sensor: UsbSensor, simulated: SimDevices, seconds: float) -> tuple[Frames, set[str]]:
    """All frames of some seconds, and the states from the first frame or trouble on."""
    end_ns = simulated.clock.now_ns() + round(seconds * SECOND)
    parts, states = [], set()
    while simulated.clock.now_ns() < end_ns:
        parts.append(sensor.read())
        if sensor.counters.frames or sensor.trouble:
            states.add(sensor.state)
    return Frames.joined(parts), states


def late_ms(frames: Frames, simulated: SimDevices) -> np.ndarray:
    """Delay in ms [n] of each frame's time stamp after the time at which the frame was taken."""
    taken_ns = [
        simulated.backend.board.frame_ns(int(seq) & ((1 << EPOCH_BITS) - 1)) for seq in frames.seq
    ]
    return (frames.t_ns - np.array(taken_ns)) / 1e6


def alter(simulated: SimDevices, change: Alter, packets: int) -> None:
    """The next packets get another number and time, by `change` of (a packet, the first)."""
    first: list[wire.Packet] = []

    def mangle(data: bytes) -> bytes:
        packet = wire.unpack(data).packets[0]
        first.append(packet)
        if len(first) > packets:
            return data
        seq, t_us = change(packet, first[0])
        return wire.pack(seq % COUNTS, t_us % COUNTS, packet.taxels, packet.flags)

    simulated.backend.mangle = mangle


@pytest.mark.slow
@pytest.mark.parametrize("packet_frames", [1, 6])
@pytest.mark.parametrize(
    ("change", "packets"),
    [
        pytest.param(lambda p, first: (p.seq, p.t_us + 3_000_000), 1, id="one packet 3 s ahead"),
        pytest.param(
            lambda p, first: (p.seq, p.t_us + 1_000_000), 10**9, id="1 s ahead from then on"
        ),
        pytest.param(
            lambda p, first: (p.seq, p.t_us - 1_000_000), 10**9, id="1 s back from then on"
        ),
        pytest.param(lambda p, first: (p.seq, 2 * first.t_us - p.t_us), 400, id="backwards"),
        pytest.param(lambda p, first: (p.seq, first.t_us), 400, id="stands still"),
        pytest.param(lambda p, first: (p.seq, 2 * p.t_us - first.t_us), 400, id="twice its pace"),
        pytest.param(
            lambda p, first: (p.seq, p.t_us + (p.t_us - first.t_us) // 20), 2000, id="5 % fast"
        ),
    ],
)
def test_a_clock_that_cannot_be_right(change: Alter, packets: int, packet_frames: int):
    """Clock and count disagree: mismatch, no wrong time, and streaming again afterwards."""
    simulated = idle_devices(packet_frames=packet_frames)
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 3)
    alter(simulated, change, packets)
    frames, states = read_for(sensor, simulated, 4)
    assert states == {"streaming", "mismatch"}
    assert np.abs(late_ms(frames, simulated)).max(initial=0) < 50
    simulated.backend.mangle = bytes
    read_for(sensor, simulated, 1)
    frames, states = read_for(sensor, simulated, 2)
    assert states == {"streaming"}
    assert np.abs(late_ms(frames, simulated)).max() < 1


@pytest.mark.parametrize("ahead", [1_000, 10_000, 1 << 30])
def test_a_count_that_jumps(ahead: int):
    """A count ahead of the clock is a mismatch, not a loss, and the board is restarted."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 1)
    alter(simulated, lambda p, first: (p.seq + ahead, p.t_us), 10**9)
    _, states = read_for(sensor, simulated, 2)
    assert states == {"streaming", "mismatch"}
    assert sensor.state == "streaming"
    assert sensor.counters.enumerations == 2


@pytest.mark.slow
@pytest.mark.parametrize("ppm", [-500, 0, 500])
@pytest.mark.parametrize("packet_frames", [1, 6, 255])
def test_a_clock_that_is_only_bad(ppm: float, packet_frames: int):
    """500 ppm, wavering stamps, counters at their wrap, two seconds lost: nothing to refuse."""
    rng = np.random.default_rng(7)
    simulated = idle_devices(
        packet_frames=packet_frames, ppm=ppm, first_seq=COUNTS - 2000, fifo_frames=300
    )
    sensor = sensor_on(simulated, read_bytes=8192)
    alter(
        simulated,
        lambda p, first: (p.seq, p.t_us + COUNTS - 5_000_000 + int(rng.integers(-600, 600))),
        10**9,
    )
    states = read_for(sensor, simulated, 8)[1]
    simulated.clock.sleep_until(simulated.clock.now_ns() + 2 * SECOND)
    states |= read_for(sensor, simulated, 4)[1]
    assert states == {"streaming"}
    assert sensor.counters.lost_frames > 1000
    assert sensor.counters.enumerations == 1


@pytest.mark.slow
@pytest.mark.parametrize(("rate_hz", "packet_frames"), [(2000, 1), (2000, 8), (35.61, 1)])
def test_stamps_in_milliseconds(rate_hz: float, packet_frames: int):
    """Stamps up to 4 ms late, in whole ms, so that time seems to go back, are accepted."""
    rng = np.random.default_rng(8)
    format = SweepFormat(4, 4, rate_hz, 1500, "uint8")
    simulated = idle_devices(60, format, packet_frames=packet_frames)
    sensor = UsbSensor(SkinConfig(silence_ms=2000), format, simulated.clock, simulated.backend)
    alter(
        simulated,
        lambda p, first: (p.seq, (p.t_us + int(rng.integers(0, 4000))) // 1000 * 1000),
        10**9,
    )
    frames, states = read_for(sensor, simulated, 8)
    assert states == {"streaming"}
    assert np.abs(late_ms(frames, simulated)).max() < 6


def test_a_stalled_endpoint_is_cleared():
    """errno 32 is cleared, and the board streams again without being replugged."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 1)
    simulated.backend.halted = True
    states = read_for(sensor, simulated, 1)[1]
    assert states == {"lost", "streaming"}
    assert sensor.state == "streaming"
    assert not simulated.backend.halted


@pytest.mark.parametrize(
    ("string", "state"),
    [(b"", "lost"), (b"\x05\x03a\0b", "absent"), (b"\x06\x03\x00\xd8\x00\xd8", "mismatch")],
)
def test_a_serial_number_that_is_no_text(string: bytes, state: str):
    """Where it chooses the skin: a state with the reason, and the program goes on."""
    simulated = idle_devices()
    backend, control = simulated.backend, simulated.backend.ctrl_transfer

    def spoken(handle, kind, request, value, index, data, ms):
        if kind == 0x80 and value == 0x303:
            data[: len(string)] = type(data)("B", string)
            return len(string)
        return control(handle, kind, request, value, index, data, ms)

    backend.ctrl_transfer = spoken
    sensor = sensor_on(simulated, usb="1209:7ac7:SIM0001")
    read_for(sensor, simulated, 1)
    assert sensor.state == state
    assert "udev" not in str(sensor.trouble) or state == "absent"


@pytest.mark.slow
@pytest.mark.parametrize("ppm", [-80, 80])
def test_windows_over_many_offsets(ppm: float):
    """80 ppm and late packets: 120 windows, each within a frame of the middle."""
    rng = np.random.default_rng(11)
    late = (
        150_000 + int(rng.integers(50, 200)) * 1_000_000 * (rng.random() < 0.01)
        for _ in iter(int, 1)
    )
    simulated = idle_devices(ppm=ppm, latency=lambda: next(late), fifo_frames=3000, packet_frames=6)
    sensor, board = sensor_on(simulated), simulated.backend.board
    recorders = [SweepCutter(FMT, SweepConfig()) for _ in range(10)]
    begun = simulated.clock.now_ns()
    edges = [
        [round(begun + (5 + 2.4 * k + rng.uniform(0, 0.3)) * SECOND) for k in range(13)]
        for _ in recorders
    ]  # a stop is the next one's start
    apart = []
    while simulated.clock.now_ns() < begun + 35 * SECOND:
        frames, now = sensor.read(), simulated.clock.now_ns()
        for recorder, own in zip(recorders, edges, strict=True):
            recorder.put(frames, now)
            while own and own[0] <= now:
                t_ns = own.pop(0)
                recorder.trigger([Edge(EdgeKind.STOP, t_ns), Edge(EdgeKind.START, t_ns)], True, now)
            for sweep in recorder.finished(now):
                if len(sweep.frames):
                    middle = int(sweep.frames.seq[len(sweep.frames) // 2]) & ((1 << EPOCH_BITS) - 1)
                    apart.append(
                        (board.frame_ns(middle) - (sweep.start_ns + sweep.stop_ns) / 2)
                        / FMT.period_ns
                    )
                else:
                    assert sweep.status is Status.NO_START
    assert len(apart) == 120
    assert np.abs(apart).max() <= 1


def test_a_box_that_had_no_processor_does_not_call_the_skin_silent():
    """Pauses of the box are not silence; half a second without bytes is."""
    simulated = idle_devices(fifo_frames=6000)
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 1)
    bulk_read = simulated.backend.bulk_read

    def late(*args) -> int:
        simulated.clock.sleep_until(simulated.clock.now_ns() + 700_000_000)
        raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)

    for _ in range(3):
        simulated.clock.sleep_until(simulated.clock.now_ns() + 700_000_000)
        simulated.backend.bulk_read = late
        sensor.read()
        simulated.backend.bulk_read = bulk_read
        assert len(sensor.read())
    assert sensor.counters.enumerations == 1
    assert sensor.counters.lost_frames == 0
    simulated.backend.board.running = False
    assert "silent" in read_for(sensor, simulated, 1)[1]
