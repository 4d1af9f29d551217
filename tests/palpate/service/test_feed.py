"""The feed: the content of each line; and no reader, however slow or hostile, nor many readers,
cost the loop more than a small share of its time."""

from __future__ import annotations

import gc
import json
import os
import socket
import stat
import tracemalloc
from base64 import b64decode
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.core.types import Frames, Status, SweepFormat
from palpate.service import feed as module
from palpate.service import feed_reader
from palpate.service.feed import (
    HEARD,
    MOST_PERIOD_NS,
    MOST_READERS,
    PERIOD_NS,
    SERVED,
    SHARE,
    FeedServer,
)
from palpate.service.feed_reader import HEARD_BYTES, QUEUE_BYTES, FeedRequest, requests
from palpate.sim import devices, rig, script, skin
from tests.factories.feeds import HEALTH, OK, FeedPeer, Offered, cut, frames
from tests.factories.simulated_box import SECOND, Rigged

Offering = Callable[..., Offered]


@pytest.fixture
def offers(tmp_path: Path) -> Iterator[Offering]:
    """Makes feeds at the same path, after their first turn."""
    made: list[Offered] = []

    def offer(*format: SweepFormat, path: Path = tmp_path / "feed.sock", **more: str) -> Offered:
        made.append(Offered(path, *format, **more))
        made[-1].turns()
        return made[-1]

    yield offer
    for one in made:
        one.feed.stopping()


@pytest.fixture
def offered(offers: Offering) -> Offered:
    """A feed after its first turn."""
    return offers(trial="7 of 20 sweeps")


@pytest.fixture
def large(offers: Offering) -> Offered:
    """The feed of a large skin after its first turn."""
    return offers(LARGE)


LARGE = SweepFormat(16, 32, 100.0, 200, "uint8")
"""A large skin: 102,400 counts in a window, 137 kB as text."""


def kinds(lines: list[dict[str, Any]]) -> list[str]:
    """The types of lines."""
    return [line["type"] for line in lines]


def test_a_reader_first_hears_what_the_box_is_and_how_it_is(offered: Offered) -> None:
    """hello with the format and the labels, then health as in the status file, with further facts;
    it is made once a second, however many readers there are."""
    hello, health = offered.peer().lines()
    about = {"type": "hello", "schema": 1, "pid": os.getpid(), "source": "usb", "skin": "palpate"}
    about |= {"labels": ["plastic rough", "wood"], "format": skin.FORMAT.json()}
    assert (about | {"window_s": 2.0, "frames_hz": 20.0}).items() <= hello.items()
    how = {"trial": "7 of 20 sweeps", "skin": "streaming", "answered": 7, "ready": True}
    assert (how | {"pid": os.getpid()}).items() <= health.items()
    assert health["time_ns"] >= health["since_ns"] > 0
    assert offered.peer().lines()[1] == health
    offered.turns(150, step_s=0.008)
    assert offered.peer().lines()[1]["time_ns"] > health["time_ns"]


def test_health_comes_once_a_second_and_a_state_with_each_change(offered: Offered) -> None:
    """Three seconds of turns; then a sweep begins, and the skin goes."""
    peer = offered.peer()
    peer.lines()
    offered.turns(375, step_s=0.008)
    assert kinds(peer.lines()) == ["health"] * 3
    offered.turns(2, HEALTH._replace(sweeping=True, ready=False))
    assert peer.lines() == [
        {"type": "state", "skin": "streaming", "trouble": "", "sweeping": True, "ready": False}
    ]
    offered.turns(2, HEALTH._replace(skin="absent", trouble="no skin on USB", ready=False))
    assert [(line["skin"], line["trouble"]) for line in peer.lines()] == [
        ("absent", "no skin on USB")
    ]


def test_a_verdict_has_the_probabilities_of_all_labels(offered: Offered) -> None:
    """All fields of the verdict, with the shift of the contact."""
    peer = offered.peer()
    peer.lines()
    offered.feed.answered(OK)
    offered.turns()
    (line,) = peer.lines()
    assert line == {"type": "verdict", **json.loads(json.dumps(OK.as_dict()))}
    assert (line["scores"], line["moved"], line["status"]) == ([0.987, 0.013], "moved 2 mm", "ok")
    assert not line.keys() & {"speed_mm_s", "force_n"}
    offered.feed.answered(replace(OK, force_n=1.5))
    offered.turns()
    (line,) = peer.lines()
    assert (line["force_n"], "speed_mm_s" in line) == (1.5, False)


@pytest.mark.parametrize("hz", [0.5, 1, 5, 8, 20])
def test_frames_come_at_the_rate_that_was_asked_for(offered: Offered, hz: float) -> None:
    """In ten seconds at 125 turns a second: the newest frame so often, and none once 0 was asked
    for."""
    peer, other = offered.peer(), offered.peer()
    peer.ask(json.dumps({"frames": hz}))
    found = []
    for i in range(1250):
        offered.feed.frames(frames(first=6 * i))
        offered.turns(step_s=0.008)
        found += [line for line in peer.lines() if line["type"] == "frame"]
    assert len(found) == pytest.approx(10 * hz, abs=1)
    last = frames(first=6 * round(found[-1]["time_ns"] / 6000 - 5 / 6))
    assert (found[-1]["time_ns"], found[-1]["taxels"]) == (
        int(last.t_ns[-1]),
        last.taxels[-1].tolist(),
    )
    peer.ask('{"frames": 0}')
    offered.turns(20)
    peer.lines()
    offered.feed.frames(frames())
    offered.turns(20)
    assert "frame" not in kinds(peer.lines() + other.lines())


def test_a_verdict_is_not_kept_for_the_next_look(offered: Offered) -> None:
    """It is there with the turn that has it, 8 ms after the last look; a storm of them is sent each
    5 ms at most."""
    peer = offered.peer()
    peer.lines()
    for turn in range(1, 4):
        offered.turns(step_s=0)
        offered.clock.sleep_until(offered.clock.now_ns() + 8_000_000 - turn)
        offered.feed.answered(OK)
        offered.turns(step_s=0)
        assert kinds(peer.lines()).count("verdict") == 1
    offered.clock.sleep_until(offered.clock.now_ns() + 1_000_000)
    offered.feed.answered(OK)
    offered.turns(step_s=0)
    assert peer.lines() == []
    offered.turns(2, step_s=0.005)
    assert kinds(peer.lines()) == ["verdict"]


def test_without_a_new_frame_none_is_repeated(offered: Offered) -> None:
    """The last frame of a skin that is gone comes once."""
    peer = offered.peer()
    peer.ask('{"frames": 20}')
    offered.turns(20)
    offered.feed.frames(frames())
    offered.turns(50)
    assert kinds(peer.lines()).count("frame") == 1


def test_of_a_large_skin_fewer_frames_are_offered(offers: Offering) -> None:
    """Text of 10,000 counts a second at most: 32x32 taxels at 9.8 frames a second, whatever was
    asked for."""
    format = SweepFormat(32, 32, 100.0, 200, "uint16")
    offered = offers(format)
    peer = offered.peer()
    assert peer.lines()[0]["frames_hz"] == pytest.approx(9.765625)
    peer.ask('{"frames": 20}')
    found = 0
    for _ in range(1000):
        offered.feed.frames(frames(1, format))
        offered.turns(step_s=0.01)
        found += kinds(peer.lines()).count("frame")
    assert found == pytest.approx(97.65625, abs=1)


def asking(offered: Offered) -> FeedPeer:
    """A reader that was heard asking for sweeps."""
    peer = offered.peer()
    peer.ask('{"sweeps": true}')
    offered.turns(2)
    peer.lines()
    return peer


@pytest.mark.parametrize("format", [skin.FORMAT, LARGE])
def test_the_window_of_a_sweep_comes_bit_for_bit(offers: Offering, format: SweepFormat) -> None:
    """After the verdict, for those who asked; over 64 kB in pieces as the readers accept them, with
    other lines in their order. A sweep without a window gives no line."""
    offered = offers(format)
    peers, other = [asking(offered), asking(offered)], offered.peer()
    sweep = cut(format)
    offered.feed.answered(OK)
    offered.feed.sweep(sweep, OK, {})
    offered.feed.answered(replace(OK, sweep=8))
    offered.feed.sweep(replace(sweep, frames=Frames.empty(format)), OK, {})
    got: list[list[dict[str, Any]]] = [[], []]
    for _ in range(20):
        offered.turns()
        for lines, peer in zip(got, peers, strict=True):
            lines += peer.lines()
    for lines in got:
        assert [k for k in kinds(lines) if k != "health"] == ["verdict", "sweep", "verdict"]
        (line,) = (line for line in lines if line["type"] == "sweep")
        shape = [format.window, format.rows, format.cols]
        assert (line["sweep"], line["start_ns"], line["shape"]) == (7, 5, shape)
        assert line["dtype"] == format.dtype
        assert b64decode(line["data"]) == sweep.frames.taxels.tobytes()
    assert "sweep" not in kinds(other.lines())


def test_one_large_window_is_on_its_way_at_a_time(large: Offered) -> None:
    """While a reader does not take a window, all readers lose the next. After five seconds this
    reader is closed, with the reason as its last line, and the other reader gets the third window.
    """
    slow, quick = asking(large), asking(large)
    got: list[dict[str, Any]] = []

    def turns(n: int) -> None:
        for _ in range(n):
            large.turns()
            got.extend(quick.lines())

    for wait in (20, 200, 20):
        large.feed.sweep(cut(LARGE), OK, {})
        turns(wait)
    assert [kind for kind in kinds(got) if kind != "health"] == ["sweep", "lost", "sweep"]
    assert len(large.feed._readers) == 1
    assert "sweep" not in kinds(slow.lines())
    assert slow.ended


def test_readers_that_never_read_hold_one_large_window(large: Offered) -> None:
    """Sixty-four such readers, and a sweep a second: the box needs less than 2 MiB more, and goes
    on serving others."""
    peers = [asking(large) for _ in range(MOST_READERS - 1)]
    quick = asking(large)
    quick.lines()
    got: list[str] = []
    gc.collect()
    tracemalloc.start()
    for _ in range(12):
        large.feed.sweep(cut(LARGE), OK, {})
        for _ in range(34):
            large.turns()
            got += kinds(quick.lines())
    held, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2 << 20
    assert held < 1 << 20
    assert got.count("sweep") > 3
    assert len(large.feed._readers) < len(peers)


def test_a_window_that_is_too_large_is_counted(offers: Offering) -> None:
    """Over 640 kB: the reader gets a `lost` line for one line."""
    format = SweepFormat(32, 32, 100.0, 250, "uint16")
    offered = offers(format)
    peer = asking(offered)
    offered.feed.sweep(cut(format), OK, {})
    offered.turns(2)
    assert peer.lines() == [{"type": "lost", "lines": 1}]


def test_counts_that_are_no_numbers_become_null(offers: Offering) -> None:
    """A float skin with a broken taxel: the line is valid JSON."""
    format = SweepFormat(1, 3, 100.0, 200, "float32", 3)
    offered = offers(format)
    peer = offered.peer()
    peer.ask('{"frames": 20}')
    offered.turns(5)
    one = frames(1, format)
    one.taxels[0, 0, 1] = (np.nan, np.inf, 0.5)
    offered.feed.frames(one)
    offered.turns(10)
    found = [line for line in peer.lines() if line["type"] == "frame"]
    assert found[0]["taxels"][0][1] == [None, None, 0.5]


def test_who_does_not_keep_up_loses_old_lines_and_hears_how_many(offered: Offered) -> None:
    """Two thousand verdicts, and a reader that does not read: its lines in the end and its lost
    lines add up to all of them. Another reader has them all, and the queue stayed within its limit.
    """
    slow, quick = offered.peer(), offered.peer()
    all_lines: list[dict[str, Any]] = []
    for i in range(2000):
        offered.feed.answered(replace(OK, sweep=i))
        offered.turns(step_s=0.001)
        all_lines += quick.lines()
    offered.turns(2)
    all_lines += quick.lines()
    assert [line["sweep"] for line in all_lines if line["type"] == "verdict"] == list(range(2000))
    waiting = next(r for r in offered.feed._readers.values() if r.waits)
    assert waiting._size <= QUEUE_BYTES
    got: list[dict[str, Any]] = []
    for _ in range(20):
        offered.turns()
        got += slow.lines()
    lost = [line["lines"] for line in got if line["type"] == "lost"]
    assert len(lost) == 1
    # where the gap is; before stand hello and health, which each reader has of its own
    at = kinds(got).index("lost")
    assert got[2:at] == all_lines[2:at]
    rest = got[at + 1 :]
    first = all_lines.index(rest[0])
    assert first - at == lost[0]
    assert rest[: len(all_lines) - first] == all_lines[first:]


def test_a_window_takes_no_room_from_what_waits_already(offered: Offered) -> None:
    """A reader that reads nothing: of four windows two fit, and of eight lines in all each is there
    or counted."""
    peer = offered.peer()
    peer.ask('{"sweeps": true}')
    offered.turns(2)
    (reader,) = offered.feed._readers.values()
    for i in range(4):
        before = [line for line in reader._queue if b"verdict" in line]
        offered.feed.sweep(cut(), OK, {})
        assert [line for line in reader._queue if b"verdict" in line] == before
        offered.feed.answered(replace(OK, sweep=i))
    assert reader._size <= QUEUE_BYTES
    got = []
    for _ in range(20):
        got += peer.lines()
        offered.turns(5)
    assert kinds(got).count("sweep") in (1, 2)
    there = kinds(got).count("sweep") + kinds(got).count("verdict")
    assert there + sum(line["lines"] for line in got if line["type"] == "lost") == 8
    assert [line["sweep"] for line in got if line["type"] == "verdict"][-1] == 3


@pytest.mark.slow
@pytest.mark.thorough  # sends for seconds until a limit is reached
def test_one_that_never_reads_costs_no_memory_without_bound(offered: Offered) -> None:
    """Sixty-four readers that requested everything and never read: after thousands of lines and
    windows the box needs less than 2 MiB more."""
    peers = [offered.peer() for _ in range(MOST_READERS)]
    for peer in peers:
        peer.ask('{"frames": 20, "sweeps": true}')
    offered.turns(100)
    gc.collect()
    tracemalloc.start()
    for i in range(3000):
        offered.feed.frames(frames(first=6 * i))
        if not i % 100:
            offered.feed.answered(OK)
            offered.feed.sweep(cut(), OK, {})
        offered.turns()
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 2 << 20
    assert all(reader._size <= QUEUE_BYTES for reader in offered.feed._readers.values())


def test_the_65th_reader_is_told_why_it_is_not_served(offered: Offered) -> None:
    """It gets one line and its end; when another leaves there is room again."""
    peers = [offered.peer() for _ in range(MOST_READERS)]
    assert all(kinds(peer.lines())[0] == "hello" for peer in peers)
    late = offered.peer()
    assert late.lines() == [
        {"type": "closed", "why": "64 readers are connected already; close one"}
    ]
    assert late.ended
    peers[5].socket.close()
    offered.turns(2)
    assert kinds(offered.peer().lines())[0] == "hello"


def test_a_thousand_connections_leave_no_file_open(offered: Offered) -> None:
    """Some read nothing, some go at once, some send half a request: no descriptor and no reader is
    left of them."""
    before = len(os.listdir("/proc/self/fd"))
    for i in range(1000):
        peer = FeedPeer(offered.path)
        if i % 3:
            peer.ask(b'{"fra')
        if i % 2:
            offered.turns()
        peer.socket.close()
        offered.turns()
    offered.turns(1000)
    assert offered.feed._readers == {}
    assert len(os.listdir("/proc/self/fd")) == before


WRONG = {
    "garbage": (b"\x00\xff\x80 garbage\n", "is not json"),
    "another form": (b"[1]\n", "is not a request"),
    "an empty line": (b"\n", "is not json"),
    "nothing asked": (b"{}\n", "is not a request"),
    "an unknown name": (b'{"frames": 1, "write": true}\n', "is not a request"),
    "too many frames": (b'{"frames": 21}\n', "a number from 0 to 20"),
    "fewer than none": (b'{"frames": -1}\n', "a number from 0 to 20"),
    "no number": (b'{"frames": NaN}\n', "a number from 0 to 20"),
    "a truth for a number": (b'{"frames": true}\n', "a number from 0 to 20"),
    "nothing for a number": (b'{"frames": null}\n', "a number from 0 to 20"),
    "a number for a truth": (b'{"sweeps": 1}\n', "true or false"),
    "brackets in brackets": (b"[" * 1000 + b"\n", "is not json"),
    "a number without end": (b'{"frames": 1' + b"0" * 900 + b"}\n", "a number from 0 to 20"),
    "no end": (b"x" * 1100, "over 1024 bytes"),
    "a very long line": (b"x" * 5000 + b"\n", "over 1024 bytes"),
}


@pytest.mark.parametrize("data", WRONG)
def test_what_is_no_request_closes_its_reader_alone(offered: Offered, data: str) -> None:
    """It hears why; another reader goes on."""
    sent, why = WRONG[data]
    peer, other = offered.peer(), offered.peer()
    peer.ask(sent)
    offered.turns(20)
    lines = peer.lines()
    assert kinds(lines) == ["hello", "health", "closed"]
    assert why in lines[-1]["why"]
    assert lines[-1]["why"].isprintable()
    assert peer.ended
    assert len(offered.feed._readers) == 1
    offered.feed.answered(OK)
    offered.turns(2)
    assert "verdict" in kinds(other.lines())


def test_endless_requests_are_read_a_little_each_turn(
    offered: Offered, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only a few bytes of a reader that sends without a pause are read in a turn, and others are
    served."""
    taken: list[int] = []
    plain = feed_reader.requests

    def counted(data: bytes, rest: bytes) -> tuple[list[FeedRequest], bytes]:
        taken.append(len(data))
        return plain(data, rest)

    monkeypatch.setattr(feed_reader, "requests", counted)
    floods, other = [offered.peer() for _ in range(10)], offered.peer()
    for peer in floods:
        peer.socket.setblocking(False)
        peer.socket.send(b'{"frames": 3}\n' * 5000)
    other.ask('{"sweeps": true}')
    offered.turns(10)
    assert len(taken) == HEARD * 10
    assert max(taken) <= HEARD_BYTES
    # heard between the floods
    assert sum(reader.sweeps for reader in offered.feed._readers.values()) == 1
    offered.feed.answered(OK)
    offered.turns(4)
    assert "verdict" in kinds(other.lines())


def test_a_turn_serves_a_few_and_all_in_the_end(offered: Offered) -> None:
    """A verdict for 64 readers: SERVED of them get it in the first round, the last after 64 /
    SERVED rounds."""
    peers = [offered.peer() for _ in range(MOST_READERS)]
    offered.turns(MOST_READERS)
    for peer in peers:
        peer.lines()
    offered.feed.answered(OK)
    for turn in range(1, MOST_READERS // SERVED + 1):
        offered.turns()  # one round
        got = [peer for peer in peers if "verdict" in kinds(peer.lines())]
        assert len(got) == SERVED, f"turn {turn}"


@pytest.mark.parametrize(
    ("cost_ns", "period_ns"),
    [
        (round(PERIOD_NS * SHARE / 2), PERIOD_NS),
        (round(PERIOD_NS * SHARE * 3), PERIOD_NS * 3),
        (PERIOD_NS, MOST_PERIOD_NS),
    ],
)
def test_a_costly_look_at_the_sockets_puts_off_the_next(
    offered: Offered, monkeypatch: pytest.MonkeyPatch, cost_ns: int, period_ns: int
) -> None:
    """Rounds use no more than SHARE of a core: a round of three times that length is followed by a
    pause three times as long."""
    offered.cost_ns = cost_ns
    looks: list[int] = []
    monkeypatch.setattr(offered.feed, "_work", lambda *_: looks.append(offered.clock.now_ns()))
    offered.turns(1000, step_s=0.001)
    assert len(looks) >= 3
    assert {b - a for a, b in pairwise(looks)} == {period_ns}


def test_one_that_only_listens_may_close_its_own_side(offered: Offered) -> None:
    """As `socat` does when its input ends: its last request stays valid, and lines go on; when it
    leaves, it is closed."""
    peer = offered.peer()
    peer.ask('{"sweeps": true}')
    peer.socket.shutdown(socket.SHUT_WR)
    offered.turns(5)
    (reader,) = offered.feed._readers.values()
    assert reader.sweeps
    offered.feed.answered(OK)
    offered.turns()
    assert "verdict" in kinds(peer.lines())
    peer.socket.close()
    offered.turns(2)
    assert offered.feed._readers == {}


def test_a_clock_that_jumps_ahead_gives_one_line(offered: Offered) -> None:
    """After a suspend of a day: one health and one frame, not those of a day."""
    peer = offered.peer()
    peer.ask('{"frames": 20}')
    offered.turns(3)
    peer.lines()
    offered.feed.frames(frames())
    offered.clock.sleep_until(offered.clock.now_ns() + 86_400 * SECOND)
    offered.turns(10)
    assert sorted(kinds(peer.lines())) == ["frame", "health"]


@pytest.mark.parametrize("mask", [0o000, 0o077])
def test_members_of_the_group_may_read_and_nobody_else(offers: Offering, mask: int) -> None:
    """Mode 660, whatever the umask, and the umask is as before."""
    before = os.umask(mask)
    try:
        offered = offers()
    finally:
        assert os.umask(before) == mask
    assert stat.S_IMODE(offered.path.stat().st_mode) == 0o660
    offered.feed.stopping()
    assert not offered.path.exists()


def test_the_socket_of_a_process_that_died_is_replaced(
    tmp_path: Path, offers: Offering, logged: list[str]
) -> None:
    """The socket of a killed box refuses connections; the next box replaces it silently."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(tmp_path / "feed.sock"))
    assert kinds(offers().peer().lines()) == ["hello", "health"]
    assert logged == []


def test_a_path_that_cannot_be_bound_is_told_once(
    tmp_path: Path, offers: Offering, logged: list[str]
) -> None:
    """A missing folder, a file at the path, a path that is too long: one log line each, and turns
    go on. Once the reason is gone the feed is there."""
    offered = offers(path=tmp_path / "run" / "feed.sock")
    offered.turns(2000)
    assert len(logged) == 1
    assert "No such file" in logged[0]
    offered.path.parent.mkdir()
    offered.path.write_text("mine")
    offered.turns(2000)
    assert len(logged) == 2
    assert "not a socket" in logged[1]
    assert offered.path.read_text() == "mine"
    offered.path.unlink()
    offered.turns(700)
    assert kinds(offered.peer().lines()) == ["hello", "health"]
    offers(path=tmp_path / ("x" * 120)).turns(1000)
    assert len(logged) == 4
    assert "too long" in logged[3]


def test_two_boxes_do_not_take_the_socket_from_each_other(
    offered: Offered, offers: Offering, logged: list[str]
) -> None:
    """The second logs it, and offers its feed when the first has ended."""
    second = offers()
    second.turns(1000)
    assert len(logged) == 1
    assert "another program" in logged[0]
    offered.turns(10)  # the second has knocked
    assert kinds(offered.peer().lines()) == ["hello", "health"]
    offered.feed.stopping()
    second.turns(700)
    assert kinds(second.peer().lines()) == ["hello", "health"]


def test_a_box_that_ends_says_so_and_nothing_is_sent_after_it(offered: Offered) -> None:
    """Readers get the waiting lines, the reason, and an end. The later verdict of an open sweep is
    not an error."""
    peer = offered.peer()
    offered.feed.answered(OK)
    offered.feed.stopping()
    offered.feed.answered(replace(OK, status=Status.ABORTED))
    offered.feed.sweep(cut(), OK, {})
    lines = peer.lines()
    assert kinds(lines) == ["hello", "health", "verdict", "closed"]
    assert lines[-1]["why"] == "the box is stopping"
    assert peer.ended


def test_requests_in_parts_are_requests(offered: Offered) -> None:
    """Byte by byte, and several in one."""
    peer = offered.peer()
    for byte in b'{"frames": 2.5}\n{"sweeps": true}\n{"sweeps": false, "frames": 4}\n':
        peer.ask(bytes([byte]))
        offered.turns()
    (reader,) = offered.feed._readers.values()
    assert (reader.frames_hz, reader.sweeps) == (4.0, False)
    assert requests(b'{"frames": 1}\n{"sweeps": true}\n{"fr') == (
        [FeedRequest(1.0), FeedRequest(None, True)],
        b'{"fr',
    )
    with pytest.raises(FormatError, match="over 1024 bytes"):
        requests(b"y" * 25, b"x" * 1000)


def test_without_readers_nothing_is_written_as_text(
    offered: Offered, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No verdict, no frame, no health is encoded; only changes of the state are."""
    made: list[str] = []
    plain: Callable[..., bytes] = module.encode
    monkeypatch.setattr(
        module, "encode", lambda kind, content: made.append(kind) or plain(kind, content)
    )
    for _ in range(500):
        offered.feed.frames(frames())
        offered.feed.answered(OK)
        offered.feed.sweep(cut(), OK, {})
        offered.turns()
    assert set(made) <= {"state"}


def test_a_running_box_offers_its_verdicts_frames_and_sweeps(
    rigged: Callable[..., Rigged], tmp_path: Path
) -> None:
    """On simulated devices: the verdicts that the robot gets, frames, and the windows that the box
    has cut."""
    simulated = devices.build(skin.FORMAT, script.tubes(1), rig.VirtualClock(), "sim")
    feed = FeedServer(
        tmp_path / "feed.sock", skin.FORMAT, {"source": "sim"}, simulated.clock, spent_ns=lambda: 0
    )
    box = rigged(simulated, observers=[feed])
    box.box.step()
    peer = FeedPeer(tmp_path / "feed.sock")
    peer.ask('{"frames": 20, "sweeps": true}')
    lines: list[dict[str, Any]] = []
    verdicts = []
    while box.box.answered < 3:
        verdicts += box.box.step()
        lines += peer.lines()
    for _ in range(20):
        box.box.step()
        lines += peer.lines()
    told = [
        (line["sweep"], line["label"], line["probability"])
        for line in lines
        if line["type"] == "verdict"
    ]
    assert told == [(v.sweep, v.label, v.probability) for v in verdicts]
    cuts = {line["sweep"]: line for line in lines if line["type"] == "sweep"}
    for sweep in box.kept[:3]:
        assert b64decode(cuts[sweep.id]["data"]) == sweep.frames.taxels.tobytes()
    states = [(line["sweeping"], line["ready"]) for line in lines if line["type"] == "state"]
    assert {(True, False), (False, True)} <= set(states)
    assert feed._newest is not None
    feed.stopping()
