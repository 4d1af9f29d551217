"""Modules of the virtual box, without a guest: names of images, held levels, crossing replies, the
table."""

from __future__ import annotations

import base64
import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from palpate.core.clock import SystemClock
from palpate.io import packets
from palpate.sim import rig, skin
from tests.factories import emulated_machines
from tests.rig import image, notes
from tests.rig import shell as shell_lines
from tests.rig.guest_clock import HZ, STILL_S, WRAP, GuestClock
from tests.rig.lines import HOLD_NS, GuestLines
from tests.rig.qtest import Qtest
from tests.rig.usbredir import BULK, CANCEL, HELLO, UsbRedirPeer


def test_an_image_is_named_by_what_goes_in(monkeypatch: pytest.MonkeyPatch):
    """Another package gives another base image; another base image gives another box."""
    ground, box = image._ground_name(), image._box_name()
    assert (image._ground_name(), image._box_name()) == (ground, box)
    monkeypatch.setattr(image, "PACKAGES", (*image.PACKAGES, "nano"))
    assert image._ground_name() != ground
    assert image._box_name() != box


def test_the_guest_s_wheels_are_those_of_its_python(monkeypatch: pytest.MonkeyPatch):
    """Of packages that differ between 3.11 and 3.12, the guest gets those for 3.11, whatever Python
    builds it."""
    lock = image.guest_lock()
    assert "numpy==2.3.5" in lock
    assert ";" not in lock
    monkeypatch.setattr(image, "GUEST_PYTHON", "3.13")
    assert "numpy==2.3.5" in image.guest_lock()


def test_what_cannot_be_made_leaves_nothing(tmp_path: Path):
    """A step that fails reports its command and output, and leaves no folder that looks like an
    image."""

    def fail(part: Path) -> None:
        (part / "half").touch()
        image.run("ls", part / "nothing here")

    with pytest.raises(image.Missing, match="nothing here"):
        emulated_machines.whole(tmp_path / "made", fail)
    assert list(tmp_path.iterdir()) == []


def test_the_table_keeps_the_longest_run(tmp_path: Path):
    """Of several runs of a fault the run with most repetitions counts, and of equal runs the
    last."""
    file = tmp_path / "faults.jsonl"
    for outcome, times in (("early", 100), ("late", 100), ("short", 6)):
        notes.write("tests/rig/test_a.py::test", "pulled", outcome, times, file)
    notes.write("tests/rig/test_a.py::other", "cut", "back", 1, file)
    assert notes.table(file)[2:] == ["| cut | back | 1 |", "| pulled | late | 100 |"]


@pytest.fixture
def qtest() -> Iterator[tuple[GuestLines, list[tuple[float, str]], GuestClock]]:
    """Lines on a socket that answers OK to everything, and the requests that it got, with times of
    this machine."""
    ours, theirs = socket.socketpair()
    asked: list[tuple[float, str]] = []
    clock = GuestClock(lambda: time.monotonic_ns() * HZ // 1_000_000_000 % WRAP)

    def answer() -> None:
        for line in theirs.makefile():
            asked.append((time.monotonic(), line.strip()))
            theirs.sendall(b"OK\n")

    threading.Thread(target=answer, daemon=True).start()
    lines = GuestLines(Qtest(ours), clock, "/chip", ["START", "READY"])
    yield lines, asked, clock
    lines.close()
    theirs.close()


def test_a_level_is_held_however_late_it_came(
    qtest: tuple[GuestLines, list[tuple[float, str]], GuestClock],
):
    """A pulse without length becomes a pulse of HOLD_NS, with its edges in order."""
    lines, asked, clock = qtest
    now_ns = clock.now_ns()
    lines.drive("START", False, now_ns + 1)
    lines.drive("START", True, now_ns)
    end = time.monotonic() + 10
    while len(asked) < 3:
        assert time.monotonic() < end, asked
        time.sleep(0.01)
    assert [line[-1] for _, line in asked[1:]] == ["1", "0"]
    assert asked[2][0] - asked[1][0] > HOLD_NS / 1e9 - 0.01


def test_a_line_that_the_box_drives_is_seen():
    """Messages of the test socket become levels and a log."""
    ours, theirs = socket.socketpair()
    threading.Thread(
        target=lambda: (theirs.recv(99), theirs.sendall(b"OK\nIRQ raise 1\n")), daemon=True
    ).start()
    clock = GuestClock(lambda: time.monotonic_ns() * HZ // 1_000_000_000 % WRAP)
    lines = GuestLines(Qtest(ours), clock, "/chip", ["START", "READY"])
    assert lines.wait("READY", True, 10)
    assert [entry[1:] for entry in lines.log] == [("READY", True)]
    assert not lines.wait("START", True, 0.01)
    lines.close()


class BusyHost:
    """A host's clock that only advances in waits, and the counter of a guest that gets a part of
    its time.

    share: part of the host's time that becomes the guest's. ticks: the counter as the guest's
    hardware shows it.
    """

    def __init__(self, share: float, at: int = 0) -> None:
        self.share, self.ns, self._at = share, 0, at

    def now_ns(self) -> int:
        """The host's time."""
        return self.ns

    def sleep_until(self, t_ns: int) -> None:
        """Jump there."""
        self.ns = max(self.ns + 1000, t_ns)

    def ticks(self) -> int:
        """The counter, 32 bits wide."""
        return (self._at + round(self.ns * self.share * HZ / 1e9)) % WRAP


@pytest.mark.parametrize("share", [1.0, 0.1, 1.7])
def test_a_wait_is_as_long_as_the_guest_s_time(share: float):
    """A guest that gets a tenth of the host's time is waited for ten times as long; the counter's
    wrap is not a jump."""
    host = BusyHost(share, at=WRAP - HZ)
    clock = GuestClock(host.ticks, host)
    begun_ns = clock.now_ns()
    clock.sleep(5)
    assert host.ns == pytest.approx(5e9 / share, rel=0.75 if share > 1 else 1e-3)
    assert 5e9 <= clock.now_ns() - begun_ns <= 5e9 * max(1, share) + 1e5
    host_ns = host.ns
    assert not clock.until(lambda: False, 2)
    assert host.ns - host_ns == pytest.approx(2e9 / share, rel=0.02)
    assert clock.until(lambda: host.ns > host_ns, 0)


def test_a_board_keeps_pace_with_a_guest_that_is_starved():
    """A robot and a board on the guest's clock: a busy host makes them slow, but no frame is late
    or lost."""
    host = BusyHost(0.05)
    clock = GuestClock(host.ticks, host)
    hand = type("Hand", (), {"skipped": None, "next_act": lambda self, first, frame_ns: None})()
    board = rig.ReadoutBoard(skin.FORMAT, hand, clock, fifo_frames=12)
    board.request(packets.Request.START)
    seqs = []
    for _ in range(50):
        clock.sleep_until(board.due_ns())
        packet = packets.unpack(board.take()).packets[0]
        assert clock.now_ns() - board.frame_ns(packet.seq + 5) < 2 * skin.FORMAT.period_ns
        seqs.append(packet.seq)
    assert seqs == list(range(seqs[0], seqs[0] + 300, 6))
    assert host.ns > 20 * 300 * skin.FORMAT.period_ns * 0.9


def test_a_guest_whose_clock_stands_still_is_said_to_have_crashed():
    """A wait for a dead guest ends with the reason; so does a wait for a QEMU that has ended."""
    host = BusyHost(0.0)
    with pytest.raises(TimeoutError, match=f"stood still for {STILL_S} s"):
        GuestClock(host.ticks, host).sleep(1)
    assert host.ns / 1e9 == pytest.approx(STILL_S, abs=1.1)
    ours, theirs = socket.socketpair()
    qtest = Qtest(ours)
    theirs.close()
    with pytest.raises(OSError, match=r"qemu has gone|Broken pipe"):
        qtest.ask("readl 0x0")


class QemuEnd:
    """QEMU's end of the cable."""

    def __init__(self) -> None:
        self._socket, far = socket.socketpair()
        self._socket.settimeout(10)
        self.peer = UsbRedirPeer(far, SystemClock())
        assert self.hear(12)[0] == HELLO
        self._socket.sendall(
            struct.pack("<III", HELLO, 68, 0) + bytes(64) + struct.pack("<I", 1 << 5 | 1 << 6)
        )

    def hear(self, head: int = 16) -> tuple[int, int, bytes]:
        """The next message: kind, id, body."""
        kind, length, ident = struct.unpack("<IIQ" if head == 16 else "<III", self._read(head))
        return kind, ident, self._read(length)

    def say(self, kind: int, ident: int, body: bytes = b"") -> None:
        """Send a message."""
        self._socket.sendall(struct.pack("<IIQ", kind, len(body), ident) + body)

    def bulk(self, ident: int) -> None:
        """Request a transfer."""
        self.say(BULK, ident, struct.pack("<BBHIH", 0x81, 0, 4096, 0, 0))

    def frames(self) -> int:
        """First number of the next packet."""
        kind, _, body = self.hear()
        assert kind == BULK
        return packets.unpack(body[10:]).packets[0].seq

    def _read(self, n: int) -> bytes:
        data = b""
        while len(data) < n:
            data += self._socket.recv(n - len(data))
        return data


def test_a_reply_that_crosses_a_cancellation_comes_again():
    """A reply that QEMU discards is not lost: the next transfer has the same frames, and the
    transfer after it the next frames."""
    guest = QemuEnd()
    clock = SystemClock()
    hand = type("Hand", (), {"skipped": None, "next_act": lambda self, first, frame_ns: None})()
    board = rig.ReadoutBoard(skin.FORMAT, hand, clock)
    guest.peer.plug(board)
    for _ in range(3):
        guest.hear()
    guest.peer.do(lambda: board.request(packets.Request.START))
    guest.bulk(1)
    first = guest.frames()
    guest.say(CANCEL, 1)
    guest.bulk(2)
    assert guest.frames() == first
    guest.bulk(3)
    assert guest.frames() == first + board.skin.packet_frames
    guest.peer.close()


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[shell_lines.Shell, socket.socket]]:
    """A shell whose agent is the test, at the other end of a socket; it waits 0.2 s beyond a
    command's own time."""
    monkeypatch.setattr(shell_lines, "REPLY_S", 0.2)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield (
            shell_lines.Shell(
                ours, GuestClock(lambda: time.monotonic_ns() * HZ // 1_000_000_000 % WRAP)
            ),
            theirs,
        )


def agent_says(port: socket.socket, *lines: tuple[int, str]) -> None:
    """Answers as the guest's agent gives them, in the order of the lines."""
    for rc, out in lines:
        port.sendall(
            json.dumps({"rc": rc, "out": base64.b64encode(out.encode()).decode()}).encode() + b"\n"
        )


def test_a_late_answer_is_not_the_next_line_s(shell: tuple[shell_lines.Shell, socket.socket]):
    """A line that the guest answers too late fails; the next line gets its own answer."""
    lines, port = shell
    with pytest.raises(shell_lines.GuestFailed, match="sent nothing for 0 s to: slow"):
        lines.run("slow", timeout_s=0)
    agent_says(port, (0, "late"), (3, "in time"))
    assert lines.run("quick", timeout_s=5) == shell_lines.Done(3, "in time")
    agent_says(port, (0, "next"))
    assert lines.run("third", timeout_s=5).out == "next"


def test_a_line_that_fails_is_told(shell: tuple[shell_lines.Shell, socket.socket]):
    """With check, an exit code other than 0 and the output of the line are in the error; a guest
    that has left is reported."""
    lines, port = shell
    agent_says(port, (2, "no such file"))
    with pytest.raises(shell_lines.GuestFailed, match="rc 2 of: ls\nno such file"):
        lines.run("ls", timeout_s=5, check=True)
    port.close()
    with pytest.raises(shell_lines.GuestFailed, match="has left before: ls"):
        lines.run("ls", timeout_s=5)
