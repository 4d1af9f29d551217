"""The sensor over the real usb.core, in virtual time: each failure of a bus has its state and
message, no frame gets a wrong host time, and the sensor recovers by itself."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import usb.core

from palpate.core.config import SkinConfig, SweepConfig
from palpate.core.types import EPOCH_BITS, EPOCHS, Edge, EdgeKind, Frames, Status, SweepFormat
from palpate.io import packets as wire
from palpate.io.usb_sensor import UsbSensor
from palpate.sim import rig, skin
from palpate.sweeps.sweep_window import SweepCutter
from tests.factories.simulated_box import SECOND, idle_devices, numbered

FMT = skin.FORMAT
COUNTS = 1 << 32
NUMBERS = (1 << EPOCH_BITS) - 1
"""Masks the number of the enumeration."""
Alter = Callable[[wire.Packet, wire.Packet], tuple[int, int]]


class SensorReading:
    """The real driver on a simulated bus. states: since the first frame or trouble."""

    def __init__(
        self, format: SweepFormat = FMT, *, acm: bool = False, seconds: float = 3600, **of
    ):
        settings = {"link": "acm" if acm else "vendor"} | of.pop("settings", {})
        self.simulated = idle_devices(seconds, format, acm=acm, **of)
        self.bus, self.clock = self.simulated.backend, self.simulated.clock
        self.sensor = UsbSensor(SkinConfig(**settings), format, self.clock, self.bus)
        self.states: set[str] = set()

    def seconds(self, seconds: float) -> Frames:
        """All frames of some seconds; each has the content that belongs to its number."""
        end_ns, parts = self.clock.now_ns() + round(seconds * SECOND), []
        while self.clock.now_ns() < end_ns:
            parts.append(self.sensor.read())
            if self.sensor.counters.frames or self.sensor.trouble:
                self.states.add(self.sensor.state)
        return Frames.joined(parts)

    def pause(self, seconds: float) -> None:
        """The host does something else."""
        self.clock.sleep_until(self.clock.now_ns() + round(seconds * SECOND))

    def late_ms(self, frames: Frames) -> np.ndarray:
        """Delay [n] of each frame's time stamp after the time at which the frame was taken."""
        taken = [self.bus.board.frame_ns(int(seq) & NUMBERS) for seq in frames.seq]
        return (frames.t_ns - np.array(taken)) / 1e6

    def alter(self, change: Alter, packets: int = 10**9) -> None:
        """The next packets get another number and time, by `change` of (a packet, the first)."""
        first: list[wire.Packet] = []

        def mangle(data: bytes) -> bytes:
            packet = wire.unpack(data).packets[0]
            first.append(packet)
            if len(first) > packets:
                return data
            seq, t_us = change(packet, first[0])
            return wire.pack(seq % COUNTS, t_us % COUNTS, packet.taxels, packet.flags)

        self.bus.mangle = mangle


def check_content(frames: Frames, format: SweepFormat = FMT) -> None:
    """Each frame has the content that belongs to its number."""
    np.testing.assert_array_equal(frames.taxels, numbered(97, format)[(frames.seq & NUMBERS) % 97])


@pytest.mark.parametrize("acm", [False, True])
def test_streams_without_loss(acm):
    """Every frame, to 1 ms; cdc_acm has the device at first; serial boards get DTR."""
    reading = SensorReading(acm=acm)
    assert reading.bus.kernel_driver is acm
    frames = reading.seconds(5)
    assert not reading.bus.kernel_driver
    assert (reading.sensor.state, reading.sensor.trouble) == ("streaming", None)
    assert (np.diff(frames.seq) == 1).all()
    assert len(frames) > 3700
    check_content(frames)
    assert np.abs(reading.late_ms(frames)).max() < 1
    assert reading.sensor.identity.serial == "SIM0001"
    assert reading.bus.dtr is acm
    reading.sensor.close()
    assert not reading.bus.board.running


def test_a_board_that_does_not_know_dtr_is_read(monkeypatch):
    """It stalls SET_CONTROL_LINE_STATE, and streams nevertheless."""
    reading = SensorReading(acm=True)
    right = reading.bus.ctrl_transfer

    def stalling(handle, kind, request, *rest):
        if (kind, request) == (0x21, 0x22):
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        return right(handle, kind, request, *rest)

    monkeypatch.setattr(reading.bus, "ctrl_transfer", stalling)
    assert len(reading.seconds(1)) > 700
    assert not reading.bus.dtr


def torn(rest: bytearray, rng: np.random.Generator) -> Callable[[bytes], bytes]:
    """Transfers cut anywhere by a timeout."""

    def cut(data: bytes) -> bytes:
        rest.extend(data)
        at = int(rng.integers(1, len(rest)))
        data, rest[:] = bytes(rest[:at]), rest[at:]
        return data

    return cut


@pytest.mark.parametrize("how", ["torn", "empty"])
def test_transfers_that_come_in_parts(how):
    """Parts are joined, zero-length packets change nothing: no frame is lost or counted."""
    reading = SensorReading()
    if how == "torn":
        reading.bus.mangle = torn(bytearray(), np.random.default_rng(0))
    else:
        take, every = reading.bus.board.take, iter(range(10**6))
        reading.bus.board.take = lambda: b"" if next(every) % 3 == 0 else take()
    frames = reading.seconds(3)
    assert (np.diff(frames.seq) == 1).all()
    assert len(frames) > (2200 if how == "torn" else 1400)
    check_content(frames)
    assert reading.sensor.counters.garbage_bytes == 0


@pytest.mark.parametrize("acm", [False, True])
@pytest.mark.parametrize(
    "format",
    [SweepFormat(3, 3, 1000.0, 2000, "float32", 3), SweepFormat(16, 1, 35.61, 128, "int16")],
    ids=["three axes", "a slow strip"],
)
def test_other_formats(format, acm):
    """All values arrive at their indices; a box for another format names both sides."""
    reading = SensorReading(format, acm=acm, seconds=600)
    frames = reading.seconds(1000 / format.rate_hz)
    assert (len(frames) > 900, reading.sensor.counters.lost_frames) == (True, 0)
    check_content(frames, format)
    reading.sensor.close()
    config = SkinConfig(link="acm" if acm else "vendor")
    other = UsbSensor(config, replace(format, axes=2), reading.clock, reading.bus)
    for _ in range(20):
        other.read()
    assert other.state == "mismatch"
    assert "x".join(map(str, format.shape)) in str(other.trouble)


@pytest.mark.parametrize(
    ("call", "code", "hint"),
    [
        ("control", errno.EIO, "errno 5"),
        ("read", errno.EIO, "errno 5"),
        ("read", errno.EPIPE, "errno 32"),
        ("read", errno.ENODEV, "unplugged"),
    ],
)
def test_failures_have_their_state_and_end(call, code, hint):
    """An errno at request or read: lost, with the reason; afterwards frames again."""
    reading = SensorReading()
    reading.bus.errors[call] = code
    reading.seconds(1)
    assert reading.sensor.state == "lost"
    assert hint in str(reading.sensor.trouble)
    reading.bus.errors.clear()
    assert len(reading.seconds(1)) > 100
    assert reading.sensor.state == "streaming"


CALLS = (
    *("enumerate_devices", "get_device_descriptor", "open_device", "get_configuration"),
    *("get_configuration_descriptor", "claim_interface", "is_kernel_driver_active"),
    *("ctrl_transfer", "bulk_read"),
)
ERRORS = (
    usb.core.USBError("Input/Output Error", -1, errno.EIO),
    usb.core.USBError("Insufficient memory", -11, errno.ENOMEM),
    usb.core.USBError("Other error", -99, None),
    OSError(errno.EMFILE, "Too many open files"),
    ValueError("Unknown langid"),
    NotImplementedError("detach_kernel_driver"),
    IndexError("list index out of range"),
)


@pytest.mark.parametrize(
    "number",
    [pytest.param(n, marks=[pytest.mark.slow] * (n >= len(CALLS))) for n in range(2 * len(CALLS))],
)
def test_no_error_of_a_usb_call_leaves_read(monkeypatch, number):
    """Whatever libusb raises is a state with its reason, until the error is over."""
    reading = SensorReading()
    sensor = reading.sensor
    assert len(reading.seconds(0.5))
    call, error = CALLS[number % len(CALLS)], ERRORS[number % len(ERRORS)]
    right = getattr(reading.bus, call)

    def failing(*given: object) -> None:
        raise error

    reading.bus.unplug()
    reading.seconds(0.5)
    monkeypatch.setattr(reading.bus, call, failing)
    reading.bus.plug()
    reading.seconds(1)
    assert sensor.state != "streaming"
    assert sensor.trouble
    assert sensor.trouble.state == sensor.state
    monkeypatch.setattr(reading.bus, call, right)
    assert len(reading.seconds(2))
    assert sensor.state == "streaming"


@pytest.mark.parametrize(
    ("string", "states"),
    [
        (b"", {"lost"}),
        (b"\x05\x03a\0b", {"absent"}),
        (b"\x06\x03\x00\xd8\x00\xd8", {"mismatch"}),
        (errno.EACCES, {"denied", "lost"}),
        (errno.EIO, {"denied", "lost"}),
    ],
)
def test_a_serial_number_that_cannot_be_read(string, states):
    """Where it chooses the skin: a state with the reason, not absent, and the program goes on."""
    reading = SensorReading(settings={"usb": "1209:7ac7:SIM0001"})
    control = reading.bus.ctrl_transfer

    def spoken(handle, kind, request, value, index, data, ms):
        if kind == 0x80 and value == 0x303:
            data[: len(string)] = type(data)("B", string)
            return len(string)
        return control(handle, kind, request, value, index, data, ms)

    if isinstance(string, int):
        reading.bus.errors["control"] = string
    else:
        reading.bus.ctrl_transfer = spoken
    reading.seconds(1)
    assert reading.sensor.state in states
    assert "udev" not in str(reading.sensor.trouble) or reading.sensor.state != "mismatch"


def no_backend(*args: object, **kwargs: object) -> None:
    raise usb.core.NoBackendError("No backend available")


@pytest.mark.parametrize(
    ("of", "name", "value", "state", "hint"),
    [
        (usb.core, "find", no_backend, "", "libusb-1.0-0"),
        (wire, "pack_identity", lambda who: b"\x01", "mismatch", "firmware"),
        (None, "link", "vendor", "mismatch", "skin.link"),
    ],
    ids=["no libusb", "nonsense for an identity", "no fitting interface"],
)
def test_what_a_person_has_to_mend(monkeypatch, of, name, value, state, hint):
    """No library, a wrong firmware, a wrong setting: it is named."""
    if of:
        monkeypatch.setattr(of, name, value)
    reading = SensorReading(acm=of is None, settings={} if of else {name: value})
    reading.seconds(0.3)
    assert state in ("", reading.sensor.state)
    assert hint in str(reading.sensor.trouble)


@pytest.mark.parametrize("acm", [False, True])
def test_a_board_that_answers_and_sends_no_frame(acm):
    """Only empty packets: silent, never streaming, until the first frame."""
    reading = SensorReading(acm=acm)
    board = reading.bus.board
    take, board.take = board.take, lambda: (take(), b"")[1]
    reading.seconds(5)
    assert reading.states == {"silent"}
    assert reading.sensor.identity
    assert reading.sensor.counters.enumerations > 3
    board.take = take
    assert len(reading.seconds(1))
    assert reading.sensor.state == "streaming"


def test_transfers_too_large_or_too_late_are_counted():
    """One is lost with its frames; after a pause the newest come, with gap and flag."""
    reading = SensorReading()
    reading.seconds(1)
    once = iter([bytes(100_000)])
    reading.bus.mangle = lambda data: next(once, data)
    check_content(reading.seconds(1))
    assert reading.sensor.state == "streaming"
    assert (reading.sensor.counters.overflows, reading.sensor.counters.lost_frames) == (1, 4)
    reading = SensorReading(fifo_frames=188)
    reading.seconds(1)
    reading.pause(2)
    check_content(reading.seconds(1))
    assert reading.sensor.counters.fifo_overflows == 1
    assert reading.sensor.counters.lost_frames == pytest.approx(1500 - 188, abs=8)


def test_a_box_that_had_no_processor_does_not_call_the_skin_silent():
    """Pauses of the box are not silence; half a second without bytes is."""
    reading = SensorReading(fifo_frames=6000)
    reading.seconds(1)
    bulk_read = reading.bus.bulk_read

    def late(*args) -> int:
        reading.pause(0.7)
        raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)

    for _ in range(3):
        reading.pause(0.7)
        reading.bus.bulk_read = late
        reading.sensor.read()
        reading.bus.bulk_read = bulk_read
        assert len(reading.sensor.read())
    assert (reading.sensor.counters.enumerations, reading.sensor.counters.lost_frames) == (1, 0)
    reading.bus.board.running = False
    reading.seconds(1)
    assert "silent" in reading.states


def test_garbage_that_costs_time_is_silence():
    """`silent` after silence_ms, also if examining the bytes takes all the time."""
    reading = SensorReading()
    reading.seconds(0.5)
    begun, sensor = reading.clock.now_ns(), reading.sensor

    class Flood:
        """A link whose garbage is there at once, and takes 2 ms to examine."""

        close = sensor._link.close

        def read(self, size: int, timeout_ms: int) -> bytes:
            return b"PP" * (size // 2)

    assert sensor.state == "streaming"
    sensor._link = Flood()
    while sensor.state == "streaming" and reading.clock.now_ns() < begun + 20 * SECOND:
        sensor.read()
        reading.pause(0.002)
    assert reading.clock.now_ns() - begun < SECOND


@pytest.mark.parametrize("reply", [0, 1])
def test_acm_board_whose_reply_never_ends(reply):
    """A reply that does not come, or comes a byte at a time, is given up after half a second."""
    reading = SensorReading(acm=True)
    reading.bus.bulk_write = lambda *args: 1
    reading.bus.bulk_read = lambda *args: (reading.pause(0.4), reply)[1]
    begun = reading.clock.now_ns()
    reading.sensor.read()
    assert reading.sensor.state == "mismatch"
    assert reading.clock.now_ns() - begun < 3 * SECOND


def test_a_stalled_endpoint_is_cleared():
    """errno 32 is cleared, and the board streams again without being replugged."""
    reading = SensorReading()
    reading.seconds(1)
    reading.bus.halted = True
    reading.seconds(1)
    assert reading.states == {"lost", "streaming"}
    assert reading.sensor.state == "streaming"
    assert not reading.bus.halted


def test_frames_of_another_form_than_announced():
    """A skin that announces 4x4 and sends 2x2 is a mismatch, and its frames are not used."""
    reading = SensorReading()
    reading.bus.mangle = lambda data: wire.pack(0, 0, np.zeros((1, 2, 2), np.uint8))
    assert len(reading.seconds(0.5)) == 0
    assert "mismatch" in reading.states


@pytest.mark.parametrize("replugged", [True, False])
def test_a_board_whose_clock_starts_anew(replugged):
    """After a replug or a crash of the firmware a new epoch begins, with right times."""
    reading = SensorReading(first_seq=1_000_000)
    now, simulated = reading.clock.now_ns(), reading.simulated

    def swap() -> None:
        reading.bus.board = rig.ReadoutBoard(FMT, simulated.robot, simulated.clock)
        reading.bus.board.running = not replugged

    if replugged:
        reading.bus.at(now + 2 * SECOND, reading.bus.unplug)
    reading.bus.at(now + 3 * SECOND, swap)
    reading.seconds(3.2)
    frames = reading.seconds(2)
    assert reading.sensor.counters.enumerations == 1 + replugged
    assert set(frames.seq >> EPOCH_BITS) == {1}
    assert np.abs(reading.late_ms(frames)).max() < 1


def test_more_enumerations_than_a_number_holds():
    """The count of enumerations wraps, frames keep their order, and nothing overflows."""
    reading = SensorReading()
    reading.sensor._stream._position = wire.StreamPosition(EPOCHS - 2)
    before = reading.seconds(0.2)
    reading.bus.unplug()
    reading.seconds(0.5)
    reading.bus.plug()
    after = reading.seconds(1)
    assert set(before.seq >> EPOCH_BITS) == {EPOCHS - 1}
    assert set(after.seq >> EPOCH_BITS) == {0}
    assert (np.diff(after.seq) > 0).all()


def test_a_count_that_begins_anew_for_ever_is_a_mismatch():
    """And the number of an enumeration never overflows."""
    reading = SensorReading()
    reading.seconds(0.5)
    starts = (1 << 31, 1 << 30, 0, 3 << 30) * 10
    hostile = b"".join(wire.pack(seq, 0, numbered(1), 0) for seq in starts)
    reading.bus.mangle = lambda data: hostile
    reading.seconds(0.5)
    assert (reading.sensor.state, "anew" in str(reading.sensor.trouble)) == ("mismatch", True)
    reading.bus.mangle = bytes
    reading.seconds(1)
    assert reading.sensor.state == "streaming"


@pytest.mark.parametrize("ahead", [1_000, 10_000, 1 << 30])
def test_a_count_that_jumps(ahead):
    """A count ahead of the clock is a mismatch, not a loss, and the board is restarted."""
    reading = SensorReading()
    reading.seconds(1)
    reading.alter(lambda p, first: (p.seq + ahead, p.t_us))
    reading.seconds(2)
    assert reading.states == {"streaming", "mismatch"}
    assert reading.sensor.state == "streaming"
    assert reading.sensor.counters.enumerations == 2


ALWAYS = 10**9
WRONG_CLOCKS: dict[str, tuple[Alter, int]] = {
    "one packet 3 s ahead": (lambda p, first: (p.seq, p.t_us + 3_000_000), 1),
    "1 s ahead from then on": (lambda p, first: (p.seq, p.t_us + 1_000_000), ALWAYS),
    "1 s back from then on": (lambda p, first: (p.seq, p.t_us - 1_000_000), ALWAYS),
    "backwards": (lambda p, first: (p.seq, 2 * first.t_us - p.t_us), 400),
    "stands still": (lambda p, first: (p.seq, first.t_us), 400),
    "twice its pace": (lambda p, first: (p.seq, 2 * p.t_us - first.t_us), 400),
    "5 % fast": (lambda p, first: (p.seq, p.t_us + (p.t_us - first.t_us) // 20), 2000),
}


@pytest.mark.parametrize(
    ("name", "packet_frames"),
    [
        ("5 % fast", 6),
        *(
            pytest.param(name, packet_frames, marks=pytest.mark.slow)
            for name in WRONG_CLOCKS
            for packet_frames in (1, 6)
        ),
    ],
)
def test_a_clock_that_cannot_be_right(name, packet_frames):
    """Clock and count disagree: mismatch, no wrong time, and streaming again afterwards."""
    reading = SensorReading(packet_frames=packet_frames)
    reading.seconds(3)
    reading.alter(*WRONG_CLOCKS[name])
    frames = reading.seconds(4)
    assert reading.states == {"streaming", "mismatch"}
    assert np.abs(reading.late_ms(frames)).max(initial=0) < 50
    reading.bus.mangle = bytes
    reading.seconds(1)
    reading.states.clear()
    frames = reading.seconds(2)
    assert reading.states == {"streaming"}
    assert np.abs(reading.late_ms(frames)).max() < 1


@pytest.mark.slow
@pytest.mark.parametrize("ppm", [-500, 0, 500])
@pytest.mark.parametrize("packet_frames", [1, 6, 255])
def test_a_clock_that_is_only_bad(ppm, packet_frames):
    """500 ppm, wavering stamps, counters at their wrap, two seconds lost: nothing to refuse."""
    rng = np.random.default_rng(7)
    board = {"packet_frames": packet_frames, "ppm": ppm, "first_seq": COUNTS - 2000}
    reading = SensorReading(**board, fifo_frames=300, settings={"read_bytes": 8192})
    shift = lambda: COUNTS - 5_000_000 + int(rng.integers(-600, 600))  # noqa: E731
    reading.alter(lambda p, first: (p.seq, p.t_us + shift()))
    reading.seconds(8)
    reading.pause(2)
    reading.seconds(4)
    assert reading.states == {"streaming"}
    assert reading.sensor.counters.lost_frames > 1000
    assert reading.sensor.counters.enumerations == 1


@pytest.mark.slow
@pytest.mark.parametrize(("rate_hz", "packet_frames"), [(2000, 1), (2000, 8), (35.61, 1)])
def test_stamps_in_milliseconds(rate_hz, packet_frames):
    """Stamps up to 4 ms late, in whole ms, so that time seems to go back, are accepted."""
    rng, format = np.random.default_rng(8), SweepFormat(4, 4, rate_hz, 1500, "uint8")
    of = {"seconds": 60, "packet_frames": packet_frames, "settings": {"silence_ms": 2000}}
    reading = SensorReading(format, **of)
    late = lambda t_us: (t_us + int(rng.integers(0, 4000))) // 1000 * 1000  # noqa: E731
    reading.alter(lambda p, first: (p.seq, late(p.t_us)))
    frames = reading.seconds(8)
    assert reading.states == {"streaming"}
    assert np.abs(reading.late_ms(frames)).max() < 6


@pytest.mark.slow
@pytest.mark.parametrize("ppm", [-80, 80])
def test_windows_over_many_offsets(ppm):
    """80 ppm and late packets: 120 windows, each within a frame of the middle."""
    rng = np.random.default_rng(11)
    late_ms = (int(rng.integers(50, 200)) * (rng.random() < 0.01) for _ in iter(int, 1))
    latency = lambda: 150_000 + next(late_ms) * 1_000_000  # noqa: E731
    reading = SensorReading(ppm=ppm, latency=latency, fifo_frames=3000, packet_frames=6)
    recorders = [SweepCutter(FMT, SweepConfig()) for _ in range(10)]
    begun, apart = reading.clock.now_ns(), []
    edges = [
        [round(begun + (5 + 2.4 * k + rng.uniform(0, 0.3)) * SECOND) for k in range(13)]
        for _ in recorders
    ]  # a stop is the next one's start
    while reading.clock.now_ns() < begun + 35 * SECOND:
        frames, now = reading.sensor.read(), reading.clock.now_ns()
        for recorder, own in zip(recorders, edges, strict=True):
            recorder.put(frames, now)
            while own and own[0] <= now:
                t_ns = own.pop(0)
                recorder.trigger([Edge(EdgeKind.STOP, t_ns), Edge(EdgeKind.START, t_ns)], True, now)
            for sweep in recorder.finished(now):
                if len(sweep.frames):
                    middle = int(sweep.frames.seq[len(sweep.frames) // 2]) & NUMBERS
                    off_ns = (
                        reading.bus.board.frame_ns(middle) - (sweep.start_ns + sweep.stop_ns) / 2
                    )
                    apart.append(off_ns / FMT.period_ns)
                else:
                    assert sweep.status is Status.NO_START
    assert len(apart) == 120
    assert np.abs(apart).max() <= 1
