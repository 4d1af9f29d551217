"""One contract for all skins on a serial port: whatever happens to the wire, frames have the sent
content and the time at which they were taken, or the state gives a reason. In virtual time."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from palpate.core.config import SkinConfig
from palpate.core.types import EPOCH_BITS
from palpate.io.serial_sensor import SerialSensor, requests
from tests.factories.costly import quick_first
from tests.factories.skin_wires import NAMES, PATH, SECOND, WiredSkin, profile, taxels, wire

pytestmark = pytest.mark.slow
each = pytest.mark.parametrize("name", quick_first(NAMES))


def consecutive(skin: WiredSkin, frames) -> bool:
    """No frame of the wire is missing between the first and the last."""
    return bool((np.diff(skin.which(frames)) == 1).all())


@each
def test_streaming(name):
    """Every frame once and in order, without a gap, its time correct, never ahead."""
    skin = WiredSkin(name)
    skin.seconds(3)
    frames = skin.seconds(5)
    assert skin.states == ["streaming"]
    assert len(frames) > 4.8 * skin.format.rate_hz
    assert consecutive(skin, frames)
    assert (np.diff(frames.seq) == 1).all()
    assert frames.taxels.dtype == skin.format.numpy_type
    assert frames.taxels.shape[1:] == skin.format.shape
    assert np.abs(skin.late_ms(frames)).max() < 1
    assert (frames.t_ns <= skin.clock.now_ns()).all()
    counters = skin.sensor.counters
    assert (counters.garbage_bytes, counters.lost_frames, counters.enumerations) == (0, 0, 1)
    assert skin.sensor.loss_known == ("sequence" not in skin.profile.lacks)


@each
def test_jitter(name):
    """Reads up to 20 ms late and a clock 2 % off: times correct to a few milliseconds."""
    skin = WiredSkin(name, rate=1.0 if name == "papillarray" else 1.02)
    rng = np.random.default_rng(1)
    late = 0.0

    def latency() -> int:
        nonlocal late
        late = max(
            200_000,
            rng.exponential(3e6) if rng.random() < 0.9 else 20e6,
            late - skin.port.period_ns,
        )
        return round(late)

    skin.port.latency = latency
    skin.seconds(5)
    frames = skin.seconds(5)
    assert consecutive(skin, frames)
    assert np.abs(skin.late_ms(frames)).max() < 6
    assert skin.states == ["streaming"]
    assert skin.sensor.counters.lost_frames == 0


@each
@pytest.mark.parametrize(
    ("fault", "before_s", "states", "why"),
    [
        ("gone", 2.0, ["streaming", "lost"], "errno 19"),
        ("silent", 1.0, ["streaming", "silent"], ""),
        ("silent", 0.0, ["silent"], ""),
        ("busy", 0.0, ["busy"], "held by another program"),
    ],
)
def test_a_fault_has_its_state_and_ends(name, fault, before_s, states, why):
    """Pulled, silent, held, also at first: no frame; then a new epoch."""
    skin = WiredSkin(name)
    first = skin.seconds(before_s) if before_s else None
    setattr(skin.port, fault, True)
    skin.seconds(0.1)  # the last frame is on its way
    assert len(skin.seconds(4)) == 0
    assert skin.states == states
    assert why in skin.troubles[-1]
    setattr(skin.port, fault, False)
    second = skin.seconds(3)
    assert skin.states == [*states, "streaming"]
    assert len(second) > 2 * skin.format.rate_hz
    assert consecutive(skin, second)
    if first is not None:
        assert second.seq[0] >> EPOCH_BITS > first.seq[-1] >> EPOCH_BITS
        assert second.t_ns[0] > first.t_ns[-1]


@each
def test_absent_is_found_by_its_ids(name):
    """No port set: the profile's ids choose; without a port the message lists what there is."""
    skin = WiredSkin(name)
    config = replace(skin.sensor._config, port="")
    skin.sensor._config = config
    frames = skin.seconds(1)
    if (0x1A86, 0x7523) in skin.profile.ids:
        assert len(frames)
    else:
        assert skin.sensor.state == "absent"
        assert "1a86:7523" in str(skin.sensor.trouble)
        assert "skin.port" in str(skin.sensor.trouble)


@each
def test_garbage(name):
    """One frame in twenty is damaged: all others are right, and the damage is counted."""
    skin = WiredSkin(name)
    rng = np.random.default_rng(3)

    def damage(data: bytes) -> bytes:
        if rng.random() > 0.05:
            return data
        at = int(rng.integers(1, len(data) - 1))
        return [data[:at], data[:at] + bytes(7) + data[at:], bytes(len(data))][int(rng.integers(3))]

    skin.seconds(3)
    skin.port.mangle = damage
    frames = skin.seconds(10)
    counters = skin.sensor.counters
    assert counters.garbage_bytes > 0
    assert counters.lost_frames > 0
    assert skin.sensor.state == "streaming"
    late = skin.late_ms(frames)  # fails for a frame that was never sent
    assert len(frames) > 0.6 * 10 * skin.format.rate_hz
    # one damaged frame more or less shows in the times only once it is certain
    assert np.mean(np.abs(late) < max(5, 1.6e3 / skin.format.rate_hz)) > 0.9


@each
def test_wrong_skin(name):
    """Bytes of another skin: no frame, never streaming, a mismatch that names the profile."""
    other = "3d-vitac" if name != "3d-vitac" else "flexitac"
    skin = WiredSkin(name)
    skin.port.frames = lambda i: wire(other, i)
    assert len(skin.seconds(4)) == 0
    assert skin.states == ["mismatch"]
    assert skin.sensor.counters.enumerations > 1
    assert f"profile {name}" in skin.troubles[0]


@each
def test_wrong_format_of_the_bundle(name):
    """Another grid or rate is refused with both named, before a byte is sent to the skin."""
    has = profile(name).format
    for wanted in (replace(has, rows=has.rows + 1), replace(has, rate_hz=1.7 * has.rate_hz)):
        skin = WiredSkin(name, wanted)
        skin.seconds(0.3)
        assert skin.sensor.state == "mismatch"
        assert "wanted" in str(skin.sensor.trouble)
        assert skin.port.sent == []


@each
@pytest.mark.parametrize("rate", [0.5, 0.9, 1.1, 2.0])
def test_wrong_rate(name, rate):
    """Too slow or too fast: a mismatch with the figure, until the rate is right for a while."""
    skin = WiredSkin(name, rate=rate)
    skin.seconds(12)
    assert skin.states == ["streaming", "mismatch"]
    if not skin.sensor.loss_known:
        figure = float(skin.troubles[1].split("sends ")[1].split(" frames")[0])
        assert figure == pytest.approx(rate * skin.format.rate_hz, rel=0.05)
        assert "skin.rate_hz" in skin.troubles[1]
    skin.port.period_ns = skin.format.period_ns  # the rate is corrected
    skin.port.begun_ns = skin.clock.now_ns() - round(skin.port._next * skin.port.period_ns)
    skin.port.frames = lambda i: wire(name, i, skin.port.period_ns)
    skin.seconds(14)
    assert skin.states == ["streaming", "mismatch", "streaming"]
    assert len(skin.seconds(1))


@pytest.mark.parametrize("name", [name for name in NAMES if name != "papillarray"])
def test_a_rate_that_wanders(name):
    """2 % are followed, a tenth is a mismatch. Skins with their own clock: test_usb_sensor.py."""

    def change_rate(skin: WiredSkin, rate: float) -> None:
        """From the next frame on, frames come at `rate` times the nominal pace."""
        port = skin.port
        now = port.taken_ns(port._next - 1)
        port.period_ns = skin.format.period_ns / rate
        port.begun_ns = now - round(port._next * port.period_ns)
        port._plan()

    skin = WiredSkin(name)
    skin.seconds(4)
    for rate in (1.02, 0.98, 1.0):
        change_rate(skin, rate)
        frames = skin.seconds(6)
        assert skin.sensor.state == "streaming"
        assert len(frames) > 5 * skin.format.rate_hz
    assert skin.states == ["streaming"]
    change_rate(skin, 0.9)
    skin.seconds(12)
    assert "mismatch" in skin.states


@each
@pytest.mark.parametrize("pause_s", [0.2, 1.0, 3.0])
def test_a_backlog_after_a_pause(name, pause_s):
    """The driver keeps all: each frame comes with the time at which it was taken."""
    skin = WiredSkin(name)
    skin.seconds(5)
    skin.clock.sleep_until(skin.clock.now_ns() + round(pause_s * 1e9))
    frames = skin.seconds(3)
    assert len(frames) >= (pause_s + 2.9) * skin.format.rate_hz - 1
    assert consecutive(skin, frames)
    assert (np.diff(frames.seq) == 1).all()
    assert np.abs(skin.late_ms(frames)).max() < 2
    assert skin.sensor.counters.lost_frames == 0
    assert skin.states == ["streaming"]


@each
def test_a_driver_that_throws_away(name):
    """The driver keeps 0.4 s of two: losses are counted, and no frame has a wrong time."""
    skin = WiredSkin(name)
    before = skin.seconds(5)
    skin.port.capacity = round(0.4 * skin.format.rate_hz) * len(wire(name, 0)) + 11
    skin.clock.sleep_until(skin.clock.now_ns() + 2_000_000_000)
    frames = type(before).joined([before, skin.seconds(3)])
    assert skin.port.thrown_away
    lost = skin.sensor.counters.lost_frames
    missing = np.diff(skin.which(frames)).sum() - (len(frames) - 1)
    assert missing >= 1.5 * skin.format.rate_hz
    assert lost == pytest.approx(missing, abs=max(3, 0.02 * missing))
    assert np.abs(skin.late_ms(frames)[-2 * len(frames) // 3 :]).max() < 2
    jumps = np.diff(frames.seq)
    assert (jumps > 1).sum() >= 1
    if not skin.sensor.loss_known:
        assert frames.seq[-1] >> EPOCH_BITS > frames.seq[0] >> EPOCH_BITS
    assert "mismatch" not in skin.states


@each
def test_back_pressure(name):
    """A host slower than the skin gets later frames with true times; then it catches up."""
    skin = WiredSkin(name)
    skin.seconds(5)
    parts = []
    for _ in range(30):
        skin.clock.sleep_until(skin.clock.now_ns() + 100_000_000)
        parts.append(skin.sensor.read())
    frames = type(parts[0]).joined([*parts, skin.seconds(2)])
    assert consecutive(skin, frames)
    assert np.abs(skin.late_ms(frames)).max() < 2 + 1500 / skin.format.rate_hz
    assert skin.sensor.counters.lost_frames == 0


@each
def test_commands(name):
    """Only the profile's, at start and end and as requests; a tare only if it is set."""
    skin = WiredSkin(name)
    skin.seconds(1)
    skin.sensor.close()
    p, rate = skin.profile, skin.format.rate_hz
    asked = [data for data in skin.port.sent if data in requests(p)]
    others = [data for data in skin.port.sent if data not in requests(p)]
    assert others == p.commands(p.start, rate) + p.commands(p.stop, rate)
    assert len(asked) == pytest.approx(rate if requests(p) else 0, abs=2)
    assert not skin.port.is_open


def test_tare():
    """The command follows those of the start; meanwhile no frame, and not streaming."""
    skin = WiredSkin("papillarray", tare=True)
    assert len(skin.seconds(1.9)) == 0
    assert skin.states == []
    assert skin.port.sent == [b"f1000\n", b"z\n"]
    assert len(skin.seconds(1)) > 800
    assert skin.states == ["streaming"]


@pytest.mark.parametrize("name", ["flexitac", "matrix", "anyskin"])
def test_a_mark_in_the_payload(name):
    """In every frame at rest: none is cut wrongly, and once it changes frames come."""
    skin = WiredSkin(name)
    mark = skin.profile.trailer + skin.profile.marker
    resting = bytearray(wire(name, 0))
    at = 40
    resting[at : at + len(mark)] = mark
    skin.port.frames = lambda i: bytes(resting)
    for _ in range(30):
        frames = skin.seconds(0.01)
        assert len(frames) == 0
    moving = lambda i: bytes(resting[: at + 1]) + bytes([i % 200]) + bytes(resting[at + 2 :])  # noqa: E731
    skin.port.frames = moving
    frames = skin.seconds(3)
    assert len(frames) > 2 * skin.format.rate_hz
    own = len(skin.profile.marker)
    for one in frames.taxels[1:-1:17]:
        sent = [moving(i)[own : len(resting) - len(skin.profile.trailer)] for i in range(200)]
        grids = [
            np.frombuffer(s, skin.profile.number).reshape(skin.profile.rows, skin.profile.cols, -1)
            for s in sent
        ]
        assert any(
            (one.reshape(-1) == g[..., list(skin.profile.take)].reshape(-1)).all() for g in grids
        )


@pytest.mark.parametrize("name", ["flexitac", "anyskin"])
def test_once_in_step_a_mark_in_the_payload_does_no_harm(name):
    """In step it stays so while numbers hold marks; a lost byte invents no frame."""
    skin = WiredSkin(name)
    skin.seconds(2)
    mark = skin.profile.trailer + skin.profile.marker
    hidden = bytearray(wire(name, 7))
    hidden[30 : 30 + len(mark)] = mark
    skin.port.frames = lambda i: bytes(hidden) if i % 3 == 0 else wire(name, i)
    frames = skin.seconds(3)
    assert skin.sensor.counters.garbage_bytes == 0
    assert len(frames) >= 3 * skin.format.rate_hz - 2
    once = iter([1])
    skin.port.mangle = lambda data: data[1:] if next(once, 0) else data
    own = len(skin.profile.marker)
    grid = np.frombuffer(
        bytes(hidden)[own : len(hidden) - len(skin.profile.trailer)], skin.profile.number
    )
    grid = grid.reshape(skin.profile.rows, skin.profile.cols, -1)[
        ..., list(skin.profile.take)
    ].reshape(-1)
    known = {taxels(skin.profile, i).tobytes() for i in range(199)} | {grid.tobytes()}
    assert all(one.tobytes() in known for one in skin.seconds(3).taxels)


def test_a_port_by_id_has_a_serial_number_and_a_misfit_its_value(tmp_path):
    """Whatever the port's name; values that turn negative are named with their type."""
    link = tmp_path / "usb-skin-S1"
    link.symlink_to(PATH)
    for port in (PATH, str(link)):
        skin = WiredSkin("matrix", port=port)
        skin.seconds(0.1)
        assert skin.sensor.identity
        assert skin.sensor.identity.serial == "S1"
    skin = WiredSkin("3d-vitac")
    skin.seconds(3)
    assert skin.sensor.state == "streaming"
    skin.port.mangle = lambda data: data.replace(b" ", b" -", 1)
    skin.seconds(3)
    assert skin.sensor.state == "mismatch"
    assert re.search(r"-\d+, which uint16 ", str(skin.sensor.trouble))


@pytest.mark.parametrize("port", ["ttyUSB0", "ttyACM0"])
def test_the_speed_is_blamed_only_where_it_matters(port, tmp_path):
    """A board on USB itself has no speed; behind an adapter it may be wrong."""
    skin = WiredSkin("matrix", port=str(tmp_path / port))
    skin.port.mangle = lambda data: b"\x55" * len(data)
    skin.seconds(6)
    assert skin.sensor.state == "mismatch"
    assert ("baud" in str(skin.sensor.trouble)) == (port == "ttyUSB0")


@pytest.mark.parametrize("name", ["flexitac", "reskin"])
def test_a_board_that_boots_whenever_it_is_opened(name):
    """The box waits longer each time; the message names the setting."""
    skin = WiredSkin(name)
    opened_ns, open_port, read = 0, skin.port.open, skin.port.read

    def opening(path: str, baud: int):
        nonlocal opened_ns
        opened_ns = skin.clock.now_ns()
        return open_port(path, baud)

    def reading(size: int, timeout_ms: int) -> bytes:
        data = read(size, timeout_ms)
        booting = skin.clock.now_ns() - opened_ns < 2 * SECOND
        return (b"booting\n" if name == "reskin" and data else b"") if booting else data

    skin.sensor._open_port, skin.port.read = opening, reading
    skin.seconds(12)
    assert skin.sensor.state == "streaming"
    assert skin.sensor.counters.enumerations <= 4
    assert any("skin.silence_ms" in trouble for trouble in skin.troubles), skin.troubles


def test_a_sequence_number_shows_each_loss():
    """A matrix with a frame count: each missing frame is a gap in the numbers."""
    skin = WiredSkin("matrix")
    p = replace(skin.profile, sequence="uint8")
    skin.port.frames = lambda i: (
        b"" if i % 50 == 49 else b"\xaa\x55" + bytes([i % 256]) + wire("matrix", i)[2:]
    )
    config = SkinConfig(profile="matrix", port=PATH)
    skin.sensor = SerialSensor(config, p, skin.format, skin.clock, open_port=skin.port.open)
    frames = skin.seconds(10)
    assert skin.sensor.loss_known
    assert skin.sensor.counters.lost_frames == pytest.approx(20, abs=1)
    assert (np.diff(frames.seq) == np.diff(skin.which(frames))).all()
    assert np.abs(skin.late_ms(frames)).max() < 2
