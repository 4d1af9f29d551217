"""The sensor over the real usb.core: each failure of a bus has its state and message, and the
sensor recovers by itself."""

import errno
from dataclasses import replace

import numpy as np
import pytest
import usb.core

from palpate.core.config import SkinConfig
from palpate.core.types import EPOCH_BITS, EPOCHS, Frames, SweepFormat
from palpate.io import packets
from palpate.io.usb_sensor import UsbSensor
from palpate.sim import rig, skin
from palpate.sim.devices import SimDevices
from tests.factories.simulated_box import SECOND, idle_devices, numbered

FMT = skin.FORMAT


def sensor_on(simulated: SimDevices, format: SweepFormat = FMT, **settings) -> UsbSensor:
    """The real driver on the simulated bus."""
    link = "acm" if simulated.backend.acm else "vendor"
    return UsbSensor(SkinConfig(link=link, **settings), format, simulated.clock, simulated.backend)


def read_for(sensor: UsbSensor, simulated: SimDevices, seconds: float) -> Frames:
    """All frames of some seconds."""
    end_ns = simulated.clock.now_ns() + round(seconds * SECOND)
    parts = []
    while simulated.clock.now_ns() < end_ns:
        parts.append(sensor.read())
    return Frames.joined(parts)


def check_content(frames: Frames) -> None:
    """Each frame has the content that belongs to its number."""
    for seq, taxels in zip(frames.seq[::37], frames.taxels[::37], strict=True):
        frame = int(seq) & ((1 << EPOCH_BITS) - 1)
        assert (taxels == numbered(1, first=frame % 97)[0]).all()


def test_a_board_that_does_not_know_dtr_is_read(monkeypatch: pytest.MonkeyPatch):
    """It stalls SET_CONTROL_LINE_STATE, and streams nevertheless."""
    simulated = idle_devices(acm=True)
    right = simulated.backend.ctrl_transfer

    def stalling(handle, kind, request, *rest):
        if (kind, request) == (0x21, 0x22):
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        return right(handle, kind, request, *rest)

    monkeypatch.setattr(simulated.backend, "ctrl_transfer", stalling)
    assert len(read_for(sensor_on(simulated), simulated, 1)) > 700
    assert not simulated.backend.dtr


@pytest.mark.parametrize("acm", [False, True])
def test_streams_without_loss(acm: bool):
    """A healthy board, vendor class or CDC-ACM: every frame, its time correct to 1 ms."""
    simulated = idle_devices(acm=acm)
    sensor = sensor_on(simulated)
    assert simulated.backend.kernel_driver is acm, "cdc_acm has the device at first"
    frames = read_for(sensor, simulated, 5)
    assert not simulated.backend.kernel_driver
    assert sensor.state == "streaming"
    assert sensor.trouble is None
    assert (np.diff(frames.seq) == 1).all()
    assert len(frames) > 3700
    check_content(frames)
    truth = np.array([simulated.backend.board.frame_ns(int(s)) for s in frames.seq])
    assert np.abs(frames.t_ns - truth).max() < 1_000_000
    assert sensor.identity.serial == "SIM0001"
    assert simulated.backend.dtr is acm, "a board on a serial port is told that somebody reads"
    sensor.close()
    assert not simulated.backend.board.running


def test_no_libusb(monkeypatch: pytest.MonkeyPatch):
    """Without libusb the message names the package to install."""

    def no_backend(*args, **kwargs):
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", no_backend)
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 0.3)
    assert "apt install libusb-1.0-0" in str(sensor.trouble)


@pytest.mark.parametrize(
    ("call", "code", "state", "hint"),
    [
        ("control", errno.EIO, "lost", "errno 5"),
        ("read", errno.EIO, "lost", "errno 5"),
        ("read", errno.EPIPE, "lost", "errno 32"),
        ("read", errno.ENODEV, "lost", "unplugged"),
    ],
)
def test_failures_have_their_state_and_end(call: str, code: int, state: str, hint: str):
    """An errno at request or read: its state and message; afterwards frames again."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    simulated.backend.errors[call] = code
    read_for(sensor, simulated, 1)
    assert sensor.state == state
    assert hint in str(sensor.trouble)
    simulated.backend.errors.clear()
    assert len(read_for(sensor, simulated, 1)) > 100
    assert sensor.state == "streaming"


@pytest.mark.parametrize("code", [errno.EACCES, errno.EIO])
def test_serial_number_that_cannot_be_read(code: int):
    """A skin whose descriptors may not be read is denied or failing, not absent."""
    simulated = idle_devices()
    simulated.backend.errors["control"] = code
    sensor = sensor_on(simulated, usb="1209:7ac7:SIM0001")
    read_for(sensor, simulated, 0.3)
    assert sensor.state in ("denied", "lost")
    assert "absent" not in str(sensor.trouble)


def test_timeouts_with_partial_data():
    """Transfers cut anywhere by a timeout: the parts are joined, no frame is lost or counted."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    rng = np.random.default_rng(0)
    rest = b""

    def torn(data: bytes) -> bytes:
        nonlocal rest
        data = rest + data
        cut = int(rng.integers(1, len(data)))
        rest = data[cut:]
        return data[:cut]

    simulated.backend.mangle = torn
    frames = read_for(sensor, simulated, 3)
    assert (np.diff(frames.seq) == 1).all()
    assert len(frames) > 2200
    check_content(frames)
    assert sensor.counters.garbage_bytes == 0


def test_zero_length_packets():
    """Zero-length packets in between change nothing."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    board, every = simulated.backend.board, iter(range(10**6))
    take = board.take
    board.take = lambda: b"" if next(every) % 3 == 0 else take()
    frames = read_for(sensor, simulated, 2)
    assert len(frames) > 1000
    assert (np.diff(frames.seq) == 1).all()


@pytest.mark.parametrize("acm", [False, True])
def test_a_board_that_answers_and_sends_no_frame(acm: bool):
    """Only empty packets: silent, never streaming, until the first frame."""
    simulated = idle_devices(acm=acm)
    sensor = sensor_on(simulated)
    board = simulated.backend.board
    take, board.take = board.take, lambda: (take(), b"")[1]
    end_ns = simulated.clock.now_ns() + 5 * SECOND
    states = set()
    while simulated.clock.now_ns() < end_ns:
        states.add((sensor.read(), sensor.state)[1])
    assert states == {"absent", "silent"}
    assert sensor.identity
    assert sensor.counters.enumerations > 3
    board.take = take
    assert len(read_for(sensor, simulated, 1))
    assert sensor.state == "streaming"


def test_overflow_loses_one_transfer():
    """A transfer larger than requested is lost and counted; streaming goes on."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 1)
    once = iter([bytes(100_000)])
    simulated.backend.mangle = lambda data: next(once, data)
    frames = read_for(sensor, simulated, 1)
    assert sensor.state == "streaming"
    assert sensor.counters.overflows == 1
    assert sensor.counters.lost_frames == 4
    check_content(frames)


def test_a_host_that_pauses_too_long():
    """The FIFO overflows: the newest frames come, and gap and flag are counted."""
    simulated = idle_devices(fifo_frames=188)
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 1)
    simulated.clock.sleep_until(simulated.clock.now_ns() + 2 * SECOND)
    frames = read_for(sensor, simulated, 1)
    assert sensor.counters.fifo_overflows == 1
    assert sensor.counters.lost_frames == pytest.approx(1500 - 188, abs=8)
    check_content(frames)


@pytest.mark.parametrize("acm", [False, True])
@pytest.mark.parametrize(
    "format",
    [SweepFormat(3, 3, 1000.0, 2000, "float32", 3), SweepFormat(16, 1, 35.61, 128, "int16")],
    ids=["three axes", "a slow strip"],
)
def test_other_formats(format: SweepFormat, acm: bool):
    """All values arrive at their indices; a box for another format names both sides."""
    simulated = idle_devices(600, format=format, acm=acm)
    sensor = sensor_on(simulated, format)
    frames = read_for(sensor, simulated, 1000 / format.rate_hz)
    assert (len(frames) > 900, sensor.counters.lost_frames) == (True, 0)
    wanted = numbered(97, format)[(frames.seq & ((1 << EPOCH_BITS) - 1)) % 97]
    np.testing.assert_array_equal(frames.taxels, wanted)
    sensor.close()
    other = sensor_on(simulated, replace(format, axes=2))
    read_for(other, simulated, 1)
    assert other.state == "mismatch"
    assert "x".join(map(str, format.shape)) in str(other.trouble)


def test_a_board_that_answers_nonsense(monkeypatch: pytest.MonkeyPatch):
    """Too short an identity is a mismatch that points to the firmware."""
    simulated = idle_devices()
    monkeypatch.setattr(packets, "pack_identity", lambda who: b"\x01")
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 0.3)
    assert sensor.state == "mismatch"
    assert "check the firmware" in str(sensor.trouble)


def test_frames_of_another_form_than_announced():
    """A skin that announces 4x4 and sends 2x2 is a mismatch, and its frames are not used."""
    simulated = idle_devices()
    simulated.backend.mangle = lambda data: packets.pack(0, 0, np.zeros((1, 2, 2), np.uint8))
    sensor = sensor_on(simulated)
    states = []
    for _ in range(10):
        assert len(sensor.read()) == 0
        states.append(sensor.state)
    assert "mismatch" in states


def test_no_fitting_interface():
    """A CDC-ACM device where a vendor device is configured: the message names the setting."""
    simulated = idle_devices(acm=True)
    sensor = UsbSensor(SkinConfig(link="vendor"), FMT, simulated.clock, simulated.backend)
    read_for(sensor, simulated, 0.3)
    assert sensor.state == "mismatch"
    assert "skin.link" in str(sensor.trouble)


@pytest.mark.parametrize("reply", [0, 1])
def test_acm_board_whose_reply_never_ends(reply: int):
    """A reply that does not come, or comes a byte at a time, is given up after half a second."""
    simulated = idle_devices(acm=True)
    sensor = sensor_on(simulated)
    backend = simulated.backend
    backend.bulk_write = lambda *args: 1

    def some_bytes(handle, ep, intf, buff, ms) -> int:
        simulated.clock.sleep_until(simulated.clock.now_ns() + 400_000_000)
        return reply

    backend.bulk_read = some_bytes
    begun = simulated.clock.now_ns()
    sensor.read()
    assert sensor.state == "mismatch"
    assert simulated.clock.now_ns() - begun < 3 * SECOND


@pytest.mark.parametrize("replugged", [True, False])
def test_a_board_whose_clock_starts_anew(replugged: bool):
    """After a replug or a crash of the firmware a new epoch begins, with right times."""
    simulated = idle_devices(first_seq=1_000_000)
    sensor = sensor_on(simulated)
    now = simulated.clock.now_ns()

    def swap() -> None:
        simulated.backend.board = rig.ReadoutBoard(FMT, simulated.robot, simulated.clock)
        simulated.backend.board.running = not replugged

    if replugged:
        simulated.backend.at(now + 2 * SECOND, simulated.backend.unplug)
    simulated.backend.at(now + 3 * SECOND, swap)
    read_for(sensor, simulated, 3.2)
    frames = read_for(sensor, simulated, 2)
    assert sensor.counters.enumerations == 1 + replugged
    assert set(frames.seq >> EPOCH_BITS) == {1}
    truth = np.array(
        [simulated.backend.board.frame_ns(int(s) & ((1 << EPOCH_BITS) - 1)) for s in frames.seq]
    )
    assert np.abs(frames.t_ns - truth).max() < 1_000_000


@pytest.mark.parametrize(
    "error",
    [
        usb.core.USBError("Input/Output Error", -1, errno.EIO),
        usb.core.USBError("Insufficient memory", -11, errno.ENOMEM),
        usb.core.USBError("Other error", -99, None),
        OSError(errno.EMFILE, "Too many open files"),
        ValueError("Unknown langid"),
        NotImplementedError("detach_kernel_driver"),
        IndexError("list index out of range"),
    ],
)
@pytest.mark.parametrize(
    "call",
    [
        *("enumerate_devices", "get_device_descriptor", "open_device", "get_configuration"),
        *("get_configuration_descriptor", "claim_interface", "is_kernel_driver_active"),
        *("ctrl_transfer", "bulk_read"),
    ],
)
def test_no_error_of_a_usb_call_leaves_read(
    monkeypatch: pytest.MonkeyPatch, call: str, error: Exception
):
    """Whatever libusb raises is a state with its reason, until the error is over."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    assert len(read_for(sensor, simulated, 0.5))
    right = getattr(simulated.backend, call)

    def failing(*given: object) -> None:
        raise error

    simulated.backend.unplug()
    read_for(sensor, simulated, 0.5)
    monkeypatch.setattr(simulated.backend, call, failing)
    simulated.backend.plug()
    read_for(sensor, simulated, 1)
    assert sensor.state != "streaming"
    assert sensor.trouble
    assert sensor.trouble.state == sensor.state
    monkeypatch.setattr(simulated.backend, call, right)
    assert len(read_for(sensor, simulated, 2))
    assert sensor.state == "streaming"


def test_a_count_that_begins_anew_for_ever_is_a_mismatch():
    """Packets that restart the count again and again stop the stream. The number of an enumeration
    never overflows, however often it is reached."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 0.5)
    hostile = b"".join(
        packets.pack(seq, 0, numbered(1), 0) for seq in (1 << 31, 1 << 30, 0, 3 << 30) * 10
    )
    simulated.backend.mangle = lambda data: hostile
    read_for(sensor, simulated, 0.5)
    assert (sensor.state, "anew" in str(sensor.trouble)) == ("mismatch", True)
    simulated.backend.mangle = lambda data: data
    read_for(sensor, simulated, 1)
    assert sensor.state == "streaming"


def test_more_enumerations_than_a_number_holds():
    """The count of enumerations wraps, frames keep their order, and nothing overflows."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    sensor._stream._position = packets.StreamPosition(EPOCHS - 2)
    before = read_for(sensor, simulated, 0.2)
    simulated.backend.unplug()
    read_for(sensor, simulated, 0.5)
    simulated.backend.plug()
    after = read_for(sensor, simulated, 1)
    assert set(before.seq >> EPOCH_BITS) == {EPOCHS - 1}
    assert set(after.seq >> EPOCH_BITS) == {0}
    assert (np.diff(after.seq) > 0).all()


def test_garbage_that_costs_time_is_silence():
    """`silent` after silence_ms, also if examining the bytes takes all the time."""
    simulated = idle_devices()
    sensor = sensor_on(simulated)
    read_for(sensor, simulated, 0.5)
    assert sensor.state == "streaming"
    clock, link = simulated.clock, sensor._link
    begun = clock.now_ns()

    class Flood:
        """A link whose garbage is there at once, and takes 2 ms to examine."""

        close = link.close

        def read(self, size: int, timeout_ms: int) -> bytes:
            return b"PP" * (size // 2)

    sensor._link = Flood()
    while sensor.state == "streaming" and clock.now_ns() < begun + 20 * SECOND:
        sensor.read()
        clock.sleep_until(clock.now_ns() + 2_000_000)
    assert clock.now_ns() - begun < SECOND
