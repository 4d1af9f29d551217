"""The terminal of an emulated skin: its times, its plug, commands, readers that are slow or not
there, and bad cables."""

from __future__ import annotations

import os
import select
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from palpate.sim.rig import VirtualClock
from palpate.sim.skins.player import DRIVER_BYTES, MOST_AT_ONCE, Player, PlayerClock
from palpate.sim.skins.wires import wire
from tests.factories.played_skins import Numbered

SECOND = 1_000_000_000


class PlayedSkin:
    """A skin on a terminal in simulated time, and a program that has it open."""

    def __init__(self, name: str, folder: Path, **how) -> None:
        self.source = Numbered(name)
        self.virtual = VirtualClock()
        self.clock = PlayerClock(self.virtual)
        self.player = Player(
            wire(name, self.source.rate_hz), self.source, self.clock, folder / "ttySkin", **how
        )
        self.clock.player = self.player
        self.fd = -1

    def open(self) -> None:
        """Open the terminal, as a program that reads the skin does."""
        self.fd = os.open(self.player.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def close(self) -> None:
        """Close it."""
        if self.fd >= 0:
            os.close(self.fd)
        self.fd = -1

    def read(self, seconds: float) -> bytes:
        """The bytes that come in this time."""
        data, until = b"", self.clock.now_ns() + round(seconds * SECOND)
        while (left := until - self.clock.now_ns()) > 0:
            if self.clock.wait_readable(self.fd, left / 1e9):
                data += os.read(self.fd, 65536)
        return data

    def expected(self, first: int, n: int) -> bytes:
        """Frames `first` to `first + n` of a skin without counters."""
        return b"".join(
            wire("flexitac", 100).frame(self.source.frame(i), 0) for i in range(first, first + n)
        )


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[PlayedSkin]:
    """A FlexiTac, not yet opened."""
    bench = PlayedSkin("flexitac", tmp_path)
    yield bench
    bench.close()
    bench.player.close()


def test_frames_come_at_the_skins_rate(bench: PlayedSkin) -> None:
    """100 frames a second, all of them, in order, and nothing thrown away."""
    bench.open()
    assert bench.read(3.005) == bench.expected(0, 300)
    assert (bench.player.frames, bench.player.thrown) == (300, 0)


def test_sends_only_while_a_program_has_it_open(bench: PlayedSkin) -> None:
    """Bytes that nobody reads are lost: a program that opens the port gets present frames."""
    bench.clock.sleep_until(bench.clock.now_ns() + 2 * SECOND)
    bench.open()
    assert bench.read(0.105) == bench.expected(200, 10)
    bench.close()
    bench.clock.sleep_until(bench.clock.now_ns() + SECOND)
    bench.open()
    assert bench.read(0.1) == bench.expected(310, 10)


def test_unplugged_and_plugged_in_again(bench: PlayedSkin) -> None:
    """The reader gets an end of file or EIO, the link is gone; then there is another terminal under
    it."""
    bench.open()
    bench.read(0.1)
    bench.player.unplug()
    assert not bench.player.path.exists()
    with suppress(OSError):  # EIO
        assert os.read(bench.fd, 1) == b""
    bench.close()
    bench.clock.sleep_until(bench.clock.now_ns() + SECOND)
    bench.player.plug()
    bench.player.plug()
    bench.open()
    assert bench.read(0.2) == bench.expected(110, 20)


def test_slow_reader_gets_what_the_driver_held(bench: PlayedSkin) -> None:
    """A backlog: the bytes that the driver could keep come first, unchanged; the others were
    discarded and are counted."""
    bench.open()
    bench.clock.sleep_until(bench.clock.now_ns() + 5 * SECOND)
    data = bench.read(0.505)
    assert data.startswith(bench.expected(0, 500)[:DRIVER_BYTES])
    assert bench.player.thrown > 50_000
    assert len(data) + bench.player.thrown == len(bench.expected(0, 550))
    assert data.endswith(bench.expected(540, 10))


def test_a_computer_that_is_too_slow_for_the_skin_skips_frames(tmp_path: Path) -> None:
    """A step makes a bounded number of frames, however long ago the last one was; a skin's counter
    shows the gap."""
    bench = PlayedSkin("papillarray", tmp_path)
    bench.open()
    bench.virtual.sleep_until(bench.clock.now_ns() + 3600 * SECOND)
    bench.player.step()
    assert bench.player.frames == MOST_AT_ONCE
    assert bench.player.wire.counter == 3600 * bench.source.rate_hz
    bench.close()


def test_pause_and_bad_cable(bench: PlayedSkin) -> None:
    """A paused skin sends nothing; bytes altered by a cable arrive altered."""
    bench.open()
    bench.read(0.105)
    bench.player.paused = True
    assert bench.read(1) == b""
    bench.player.paused, bench.player.mangle = False, lambda data: data[3:]
    frame = bench.expected(110, 1)
    assert bench.read(0.01) == frame[3:]


def test_as_fast_as_it_is_read(tmp_path: Path) -> None:
    """Without pace the next frame is sent when the frame before is read: all come, independent of
    time."""
    bench = PlayedSkin("flexitac", tmp_path, paced=False)
    bench.open()
    data = b""
    while len(data) < len(bench.expected(0, 300)):
        bench.player.step()
        assert select.select([bench.fd], [], [], 5)[0]
        data += os.read(bench.fd, 65536)
    assert data.startswith(bench.expected(0, 300))
    assert bench.player.thrown == 0
    bench.close()
    bench.player.close()


def test_adapter_that_collects(tmp_path: Path) -> None:
    """The adapter passes bytes on every 16 ms; no frame is lost by that."""
    bench = PlayedSkin("papillarray", tmp_path, collect_ns=16_000_000)
    bench.open()
    came = []
    until = bench.clock.now_ns() + SECOND
    while bench.clock.now_ns() < until:
        if bench.clock.wait_readable(bench.fd, 0.1):
            came.append(bench.clock.now_ns())
            os.read(bench.fd, 1 << 20)
    assert {t % 16_000_000 for t in came} <= {0}
    assert 980 <= bench.player.frames <= 1000
    bench.close()
    bench.player.close()


def test_commands_reach_the_skin(tmp_path: Path) -> None:
    """A command changes the rate from then on; an adapter answers at once and sends after its start
    command."""
    bench = PlayedSkin("papillarray", tmp_path)
    bench.open()
    bench.read(0.1)
    os.write(bench.fd, b"f100\n")
    bench.read(0.05)
    before = bench.player.frames
    bench.read(1)
    assert 99 <= bench.player.frames - before <= 101
    bench.close()
    bench.player.close()
    bench = PlayedSkin("xela-can", tmp_path)
    bench.open()
    assert bench.read(0.5) == b""
    os.write(bench.fd, b"S8\rO\rt20120700\r")
    data = bench.read(0.255)
    assert data.startswith(b"\r\rz\rt7108")
    assert data.count(b"t71F8") == 25
    bench.close()
    bench.player.close()
