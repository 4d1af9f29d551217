"""The drivers fulfil one contract on many backends: the simulator, umockdev, the virtual box and a
real readout board.

PALPATE_BACKEND chooses one backend per process, the simulator by default (`backends`). Details of
bus, chip and port, to the microsecond, are tested in virtual time by test_usb_sensor.py,
test_gpio.py and test_robot_link.py.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.core.errors import LineError
from palpate.core.sentences import checksum, sentence
from palpate.core.types import EPOCH_BITS, EdgeKind, Frames
from palpate.io.gpio_lines import Lines
from palpate.io.robot_link import Command, SerialSink
from palpate.io.sensor import REPLY_MS
from palpate.io.trigger import GpioTrigger
from palpate.io.usb_sensor import UsbSensor
from tests.rig import backends
from tests.rig.backends import Backend, Skin, mocks, skins

SECOND = 1_000_000_000
LIMIT_S = 10
Need = Callable[..., Backend]


@pytest.fixture(scope="module")
def chosen() -> Iterator[Backend]:
    """The backend of this process."""
    try:
        with backends.opened(backends.chosen()) as made:
            yield made
    except backends.BackendMissing as e:
        pytest.exit(str(e), returncode=1)


@pytest.fixture
def need(chosen: Backend) -> Need:
    """Returns the reset backend; skips a test whose needs it cannot meet."""

    def able(*wanted: str) -> Backend:
        if lacking := [what for what in wanted if what not in chosen.can]:
            pytest.skip(f"{chosen.name}: no {', no '.join(lacking)} here")
        chosen.reset()
        return chosen

    return able


def now(u: Backend) -> int:
    """The backend's time in nanoseconds."""
    return u.clock.now_ns()


def limit(u: Backend) -> int:
    """The time limit of a test."""
    return now(u) + round((LIMIT_S + u.slack_s) * SECOND)


def until(u: Backend, done: Callable[[], Any], step_s: float = 0.002) -> None:
    """Poll a condition until it is true; fails after LIMIT_S of the backend's time."""
    end_ns = limit(u)
    while not done():
        assert now(u) < end_ns, "it did not happen"
        u.wait(step_s)


# ---------------------------------------------------------------- Sensor


class SensorReader:
    """Reads a sensor continuously. No read may last longer than all its timeouts together."""

    def __init__(self, u: Backend, **settings: Any) -> None:
        self.settings = replace(u.sensor, **{"timeout_ms": 50, "retry_ms": 100} | settings)
        self.sensor = UsbSensor(self.settings, u.format, u.clock, u.backend)
        self.states: list[str] = []
        self._u = u

    def once(self) -> Frames:
        """One read, timed."""
        began_ns, was = now(self._u), self.sensor.state
        frames = self.sensor.read()
        took_ms = (now(self._u) - began_ns) / 1e6
        opening = was != "streaming" or self.sensor.state != "streaming"
        most_ms = self.settings.timeout_ms + opening * 4 * REPLY_MS + self._u.slack_s * 1000
        assert took_ms <= most_ms, f"a read of {took_ms:.0f} ms"
        if self.sensor.state not in self.states[-1:]:
            self.states.append(self.sensor.state)
        return frames

    def seconds(self, seconds: float) -> Frames:
        """All frames of this time."""
        end_ns, parts = now(self._u) + round(seconds * SECOND), []
        while now(self._u) < end_ns:
            parts.append(self.once())
        return Frames.joined(parts)

    def frames(self, n: int) -> Frames:
        """At least `n` frames."""
        end_ns, parts = limit(self._u), [self.once()]
        while sum(map(len, parts)) < n:
            assert now(self._u) < end_ns, f"{self.sensor.state}: {self.sensor.trouble}"
            parts.append(self.once())
        return Frames.joined(parts)

    def state(self, wanted: str) -> None:
        """Read until the sensor is in this state."""
        end_ns = limit(self._u)
        while self.sensor.state != wanted:
            assert now(self._u) < end_ns, (
                f"{self.sensor.state}, not {wanted}: {self.sensor.trouble}"
            )
            self.once()

    def __enter__(self) -> SensorReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.sensor.close()


def check_content(u: Backend, frames: Frames) -> None:
    """Each frame has the content that belongs to its number."""
    if "numbered" in u.can:
        assert (frames.taxels == skins.counts(frames.seq, u.format)).all()


def test_streams_without_a_gap(need):
    """Every frame once, in order, later than the last, never ahead; then the skin is released."""
    # Until the skin's clock is well known (DeviceClock), time stamps may shift by the delays of a
    # busy machine
    settle_s = 2.2
    u = need("skin")
    with SensorReader(u) as reader:
        reader.seconds(settle_s)
        frames = reader.frames(800)
        assert (frames.t_ns <= now(u)).all()
        assert (np.diff(frames.seq) == 1).all()
        assert (np.diff(frames.t_ns) > 0).all()
        assert frames.taxels.shape[1:] == u.format.shape
        assert frames.taxels.dtype == u.format.numpy_type
        check_content(u, frames)
        assert reader.sensor.counters.lost_frames == reader.sensor.counters.garbage_bytes == 0
        assert reader.sensor.identity
        # an emulator may be too late with its first reply, so only unbroken streaming after that is
        # required
        assert reader.states[-1] == "streaming"
        assert reader.sensor.counters.enumerations == 1
    with SensorReader(u) as reader:  # closing has released everything
        check_content(u, reader.frames(100))


def test_absent_then_plugged(need):
    """No skin: absent, a message with the ids, no frames; it is used when it is plugged in."""
    u = need("plug")
    u.unplug()
    with SensorReader(u) as reader:
        reader.state("absent")
        assert len(reader.seconds(0.5)) == 0
        assert f"{u.sensor.vendor_id:04x}:{u.sensor.product_id:04x}" in str(reader.sensor.trouble)
        u.plug(Skin())
        check_content(u, reader.frames(100))


def test_unplugged_in_mid_read(need):
    """Pulled while frames come: lost, then absent; plugged in again, a new epoch."""
    u = need("plug")
    with SensorReader(u) as reader:
        first = reader.frames(100)
        u.after(0.2, u.unplug)
        first = Frames.joined([first, reader.seconds(0.1)])
        reader.state("lost")
        assert "errno" in str(reader.sensor.trouble)
        reader.state("absent")
        u.plug(Skin())
        second = reader.frames(300)
        assert reader.states[:2] == ["streaming", "lost"]
        assert set(first.seq >> EPOCH_BITS) == {0}
        assert set(second.seq >> EPOCH_BITS) == {1}
        assert (np.diff(second.seq) == 1).all()
        assert second.t_ns[0] > first.t_ns[-1]
        check_content(u, first)
        check_content(u, second)
        assert reader.sensor.counters.enumerations == 2


def test_driver_taken_and_given_back(need):
    """Without its driver it is lost; with it, it streams again, and nothing is left open."""

    def timers() -> int:
        """Kernel timers of this process; a context of libusb has one."""
        return sum(
            os.path.realpath(f"/proc/self/fd/{fd}").endswith("[timerfd]")
            for fd in os.listdir("/proc/self/fd")
        )

    # A lost skin is searched for within this time
    retried_s = 0.6
    u = need("unbind")
    with SensorReader(u) as reader:
        reader.frames(100)
        held = []
        for _ in range(3):
            u.unbind(True)
            reader.state("lost")
            assert len(reader.seconds(retried_s)) == 0
            u.unbind(False)
            check_content(u, reader.frames(100))
            held.append(timers())
        assert reader.sensor.counters.enumerations == 4
        assert held[-1] == held[0]


def test_serial_number_chooses(need):
    """Only the skin with the serial number is used; the message counts the others."""
    u = need("plug")
    u.plug(Skin(serial="0042"))
    with SensorReader(u, usb=f"{u.sensor.usb[:9]}:0043") as reader:
        reader.state("absent")
        assert len(reader.seconds(0.3)) == 0
        assert "0043" in str(reader.sensor.trouble)
        assert "numbers" in str(reader.sensor.trouble)
        u.plug(Skin(serial="0043"))
        reader.frames(100)
        assert reader.sensor.identity.serial == "0043"


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        ({"protocol": 2}, "protocol 2"),
        ({"rows": 3}, "3x4"),
        ({"axes": 3}, "4x4x3"),
        ({"dtype": "int16"}, "int16"),
        ({"rate_hz": 765.0}, "765 Hz"),
    ],
)
def test_another_protocol_or_format(need, change, hint):
    """Another protocol or format is refused with both named; a matching skin is then used."""
    u = need("plug")
    u.plug(Skin(**change))
    with SensorReader(u) as reader:
        reader.state("mismatch")
        assert len(reader.seconds(0.3)) == 0
        assert hint in str(reader.sensor.trouble)
        u.plug(Skin())
        check_content(u, reader.frames(100))


@pytest.mark.parametrize(
    ("control", "state", "code", "hint"),
    [("hold", "busy", 16, "another program"), ("deny", "denied", 13, "udev rule")],
)
def test_a_skin_that_cannot_be_opened(need, control, state, code, hint):
    """Held or not allowed: a state of its own, advice, and frames once that is over."""
    u = need("skin", control)
    refuse = getattr(u, control)
    refuse(True)
    try:
        with SensorReader(u) as reader:
            reader.state(state)
            assert len(reader.seconds(0.3)) == 0
            assert f"errno {code}" in str(reader.sensor.trouble)
            assert hint in str(reader.sensor.trouble)
            refuse(False)
            check_content(u, reader.frames(100))
    finally:
        refuse(False)


def test_a_silent_skin_is_started_again(need):
    """A skin that sends nothing is silent after `silence_ms` and is started again."""
    u = need("silence")
    with SensorReader(u, silence_ms=300) as reader:
        reader.frames(100)
        u.silence()
        reader.state("silent")
        check_content(u, reader.frames(100))
        assert reader.states == ["streaming", "silent", "streaming"]
        assert reader.sensor.counters.enumerations == 2


def test_garbage_on_the_cable(need):
    """Corrupted transfers are counted in bytes and in missing frames; intact frames are correct."""
    u = need("garble")
    with SensorReader(u) as reader:
        reader.frames(100)
        u.garble(True)
        frames = reader.frames(500)
        u.garble(False)
        frames = Frames.joined([frames, reader.frames(100)])
        counters = reader.sensor.counters
        assert counters.garbage_bytes > 0
        assert 0 < (np.diff(frames.seq) - 1).sum() <= counters.lost_frames
        check_content(u, frames)
        assert reader.states == ["streaming"]


# ---------------------------------------------------------------- Trigger


class Watcher:
    """Polls a trigger every two milliseconds."""

    def __init__(self, u: Backend, **settings: Any) -> None:
        self.config = replace(u.trigger, **settings)
        self.trigger = GpioTrigger(self.config, u.gpio)
        self.reported: list[tuple[EdgeKind, int]] = []
        self._u = u

    def look(self) -> None:
        """One call: a reported edge has held its level, and has the edge's own time."""
        now_ns = now(self._u)
        for edge in self.trigger.edges(now_ns):
            if edge.kind is not EdgeKind.LOST:
                assert now_ns - edge.t_ns >= self.config.glitch_us * 1000
            self.reported.append((edge.kind, edge.t_ns))

    def edges(self, n: int) -> list[tuple[EdgeKind, int]]:
        """The reported edges, once there are `n`."""

        def enough() -> bool:
            self.look()
            return len(self.reported) >= n

        until(self._u, enough)
        reported, self.reported = self.reported, []
        return reported

    def seconds(self, seconds: float) -> list[tuple[EdgeKind, int]]:
        """The edges that are reported in this time."""
        end_ns = now(self._u) + round(seconds * SECOND)
        while now(self._u) < end_ns:
            self.look()
            self._u.wait(0.002)
        reported, self.reported = self.reported, []
        return reported

    def __enter__(self) -> Watcher:
        return self

    def __exit__(self, *_: object) -> None:
        self.trigger.close()


def pulse(u: Backend, line: str) -> tuple[int, int]:
    """Drive a line high and low again; returns the times before and after."""
    before = now(u)
    u.drive(line, True)
    u.wait(u.pulse_s)
    u.drive(line, False)
    u.wait(u.pulse_s)
    return before, now(u)


def test_start_and_stop(need):
    """The edges as they were driven, in order, each with its time; falls have no meaning."""
    u = need("lines")
    t = u.trigger
    roles = [
        (t.new_object, EdgeKind.NEW_OBJECT),
        (t.start, EdgeKind.START),
        (t.stop, EdgeKind.STOP),
    ]
    wired = [(line, kind) for line, kind in roles if line]
    with Watcher(u) as watcher:
        spans = [pulse(u, line) for line, _ in wired]
        reported = watcher.edges(len(wired)) + watcher.seconds(0.1)
    assert [kind for kind, _ in reported] == [kind for _, kind in wired]
    for (before, after), (_, t_ns) in zip(spans, reported, strict=True):
        assert before <= t_ns < after


def test_one_line(need):
    """A rise is START and a fall STOP, in one call or several; a high line makes no START."""
    u = need("lines")
    u.drive(u.trigger.start, True)
    with Watcher(u, mode="one-line") as watcher:
        assert watcher.seconds(0.1) == []
        for level, kind in ((False, EdgeKind.STOP), (True, EdgeKind.START), (False, EdgeKind.STOP)):
            u.drive(u.trigger.start, level)
            assert [reported for reported, _ in watcher.edges(1)] == [kind]
        before, after = pulse(u, u.trigger.start)
        (start, start_ns), (stop, stop_ns) = watcher.edges(2)
        assert (start, stop) == (EdgeKind.START, EdgeKind.STOP)
        assert before <= start_ns < stop_ns < after


def test_glitches(need):
    """A pulse shorter than `glitch_us` is only counted; the edge after it is reported."""
    u = need("lines")
    with Watcher(u, mode="one-line", glitch_us=1_000_000) as watcher:
        pulse(u, u.trigger.start)
        assert watcher.seconds(1.2) == []
        assert watcher.trigger.edge_counters.glitches == 1
        u.drive(u.trigger.start, True)
        assert [kind for kind, _ in watcher.edges(1)] == [EdgeKind.START]


def test_more_edges_than_the_kernel_keeps(need):
    """Dropped edges are one LOST, and counted; when the line is quiet, edges come again."""
    u = need("lines", "overrun")
    with Watcher(u) as watcher:
        u.storm(u.trigger.start, 3000)
        assert [kind for kind, _ in watcher.edges(1)] == [EdgeKind.LOST]
        until(u, lambda: (watcher.look(), not watcher.trigger.blind)[1])
        assert watcher.reported == []
        assert 0 < watcher.trigger.edge_counters.lost_edges < 3000
        pulse(u, u.trigger.start)
        assert [kind for kind, _ in watcher.edges(1)] == [EdgeKind.START]


def test_lines_that_are_held(need):
    """A second program is refused with errno 16; after the first the lines are free again."""
    u = need("lines")
    with Watcher(u), pytest.raises(LineError, match="errno 16"):
        GpioTrigger(u.trigger, u.gpio)
    with Watcher(u) as watcher:
        pulse(u, u.trigger.start)
        assert [kind for kind, _ in watcher.edges(1)] == [EdgeKind.START]


def test_a_line_that_is_not_there(need):
    """A name without a line is refused, and so is a line in two roles."""
    u = need("lines")
    with pytest.raises(LineError, match="NO-SUCH-LINE"):
        GpioTrigger(replace(u.trigger, start="NO-SUCH-LINE"), u.gpio)
    with pytest.raises(LineError, match="roles"):
        GpioTrigger(replace(u.trigger, stop=u.trigger.start), u.gpio)


# ---------------------------------------------------------------- Lines


def seen(u: Backend) -> set[str]:
    """The outputs that are high."""
    o = u.output
    return {
        n
        for n in (o.ready, o.busy, o.result_valid, o.fault, o.decided, *o.class_bits)
        if n and u.level(n)
    }


def check_seen(u: Backend, *wanted: str) -> None:
    """Outside, exactly these outputs are high; unwired ones are ignored."""
    until(u, lambda: seen(u) == set(filter(None, wanted)))


def test_outputs(need):
    """All low at first; then as set by `show` and `result`; low again once closed."""
    u = need("lines")
    o = u.output
    with closing(Lines(o, u.gpio, u.clock)) as lines:
        check_seen(u)
        lines.show(ready=True, busy=False, fault=False)
        check_seen(u, o.ready)
        lines.show(ready=False, busy=True, fault=True, decided=True)
        check_seen(u, o.busy, o.fault, o.decided)
        lines.show(ready=True, busy=False, fault=False)
        for code in range(lines.capacity):
            lines.result(code)
            check_seen(
                u,
                o.ready,
                o.result_valid,
                *(n for i, n in enumerate(o.class_bits) if code >> i & 1),
            )
        lines.result(None)
        until(u, lambda: not u.level(o.result_valid))
        lines.result(lines.capacity - 1)
    check_seen(u)


def test_inputs_and_outputs_together(need):
    """The box has both at once: driving outputs causes no edge, and edges change no output."""
    u = need("lines")
    with Watcher(u) as watcher, closing(Lines(u.output, u.gpio, u.clock)) as lines:
        lines.show(ready=True, busy=False, fault=False)
        lines.result(1)
        assert watcher.seconds(0.05) == []
        pulse(u, u.trigger.start)
        assert [kind for kind, _ in watcher.edges(1)] == [EdgeKind.START]
        check_seen(u, u.output.ready, u.output.result_valid, u.output.class_bits[0])


# ---------------------------------------------------------------- SerialSink


class Peer:
    """The robot controller at the far end of a sink."""

    def __init__(self, u: Backend, sink: SerialSink) -> None:
        self.heard = b""
        self.commands: list[Command] = []
        self._u, self._sink = u, sink

    def turn(self) -> None:
        """The box reads commands, the peer reads sentences."""
        self.commands += self._sink.commands()
        self.heard += self._u.hear()

    def until(self, done: Callable[[], Any]) -> None:
        """Take turns until the condition is true."""
        until(self._u, lambda: (self.turn(), done())[1], 0.02)


@pytest.fixture
def sink_on() -> Iterator[Callable[..., SerialSink]]:
    """Makes sinks on the serial line, and closes them after the test."""
    made: list[SerialSink] = []

    def make(u: Backend, **settings: Any) -> SerialSink:
        made.append(SerialSink(replace(u.serial, **settings), u.clock))
        made[-1].commands()
        return made[-1]

    yield make
    for sink in made:
        sink.close()


def test_sentences_arrive_whole(need, sink_on):
    """All sentences that were sent are received, byte by byte, none twice and none missing."""
    u = need("serial")
    sink = sink_on(u)
    peer = Peer(u, sink)
    sent = [sentence("ANS", "ID", "ok", i, "x" * (i % 90)) for i in range(60)]
    for i in range(0, 60, 10):
        for line in sent[i : i + 10]:
            sink.say(line)
        peer.until(lambda i=i: peer.heard.count(b"\n") >= i + 10)
    assert peer.heard == b"".join(sent)
    assert sink.dropped == 0
    assert sink.trouble == ""


def test_commands_come_in(need, sink_on):
    """As a program and as a person sends them, cut anywhere; a wrong one gets its fault."""
    u = need("serial")
    sink = sink_on(u)
    peer = Peer(u, sink)
    u.say(b"$PPLP,ID*" + checksum("PPLP,ID").encode() + b"\r\nPPLP,STA")
    peer.until(lambda: peer.commands)
    assert peer.commands == [Command("ID")]
    u.say(b"TE\n$PPLP,ID*00\r\n")
    peer.until(lambda: len(peer.commands) == 3)
    assert peer.commands[1] == Command("STATE")
    assert "checksum 00" in peer.commands[2].error


def test_a_peer_that_does_not_read(need, sink_on):
    """The oldest sentences are dropped and counted; no call waits, and none is cut."""
    u = need("serial", "stall")
    sink = sink_on(u, queue=8)
    total = 2000

    def numbered(i: int) -> bytes:
        # of many lengths, so that the line fills up within a sentence, after its number
        return sentence("ANS", i, "x" * (i % 59))

    for i in range(total):
        began_ns = now(u)
        sink.say(numbered(i))
        assert now(u) - began_ns <= u.slack_s * SECOND
    assert sink.dropped > 0
    peer = Peer(u, sink)
    peer.until(lambda: peer.heard.endswith(numbered(total - 1)))
    lines = peer.heard.splitlines(keepends=True)
    numbers = [int(line.split(b",")[2]) for line in lines]
    broken = [line for i, line in zip(numbers, lines, strict=True) if line != numbered(i)]
    assert broken == []
    assert numbers == sorted(set(numbers))
    assert len(numbers) + sink.dropped == total


@pytest.mark.slow
def test_a_port_that_goes_and_comes(need, sink_on):
    """Unplugged: `trouble` has the reason; plugged in again, the sentence is sent whole."""
    u = need("serial", "pull")
    sink = sink_on(u)
    peer = Peer(u, sink)
    sink.say(sentence("ANS", 1))
    peer.until(lambda: peer.heard)
    u.pull()
    sink.say(sentence("ANS", 2))  # reading from an unplugged port gives nothing, and no error
    until(u, lambda: (sink.commands(), sink.trouble)[1])
    assert u.serial.port in sink.trouble
    u.put()
    peer.heard = b""
    peer.until(lambda: peer.heard.endswith(b"\n"))
    assert peer.heard == sentence("ANS", 2)
    assert sink.trouble == ""


# ---------------------------------------------------------------- the backends themselves


@pytest.mark.slow
@pytest.mark.thorough  # the whole contract again, in real time
def test_over_umockdev():
    """The same contract over unmodified libusb, pyusb, libgpiod and gpiod, in a process."""
    if os.environ.get(backends.VARIABLE):
        pytest.skip("one backend is chosen")
    if lacking := mocks.lacking():
        pytest.fail(lacking) if os.environ.get("PALPATE_MOCKS") else pytest.skip(lacking)
    done = subprocess.run(
        [
            *("umockdev-wrapper", sys.executable, "-m", "pytest"),
            *("-q", "-rs", "-p", "no:cacheprovider", __file__),
        ],
        # umockdev takes files below /dev for devices, those of TMPDIR=/dev/shm as well
        env=os.environ | {backends.VARIABLE: "mocked", "TMPDIR": "/tmp"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
