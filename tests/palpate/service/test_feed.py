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

from palpate.core.types import Frames, Status, SweepFormat
from palpate.service import feed as module
from palpate.service import feed_reader
from palpate.service.feed import (
    HEARD,
    MOST_PERIOD_NS,
    MOST_READERS,
    PERIOD_NS,
    SHARE,
    FeedServer,
)
from palpate.service.feed_reader import HEARD_BYTES, QUEUE_BYTES, FeedRequest, requests
from palpate.sim import skin
from tests.factories.feeds import HEALTH, OK, FeedPeer, Offered, cut, frames
from tests.factories.simulated_box import SECOND, tubes

Offering = Callable[..., Offered]
Lines = list[dict[str, Any]]
LARGE = SweepFormat(16, 32, 100.0, 200, "uint8")
"""A large skin: 102,400 counts in a window, 137 kB as text."""
BOTH = ["hello", "health"]


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


def kinds(lines: Lines, *without: str) -> list[str]:
    """The types of lines."""
    return [line["type"] for line in lines if line["type"] not in without]


def of(lines: Lines, kind: str) -> Lines:
    """The lines of one type."""
    return [line for line in lines if line["type"] == kind]


def asking(offered: Offered, request: str = '{"sweeps": true}') -> FeedPeer:
    """A reader whose request was heard, and which has read its first lines."""
    peer = offered.peer()
    peer.ask(request)
    offered.turns(2)
    peer.lines()
    return peer


def test_hello_health_and_states(offered):
    """Health as in the status file once a second, a state with each change."""
    peer = offered.peer()
    hello, health = peer.lines()
    about = {"type": "hello", "schema": 1, "pid": os.getpid(), "source": "usb", "skin": "palpate"}
    about |= {"labels": ["plastic rough", "wood"], "format": skin.FORMAT.json()}
    assert (about | {"window_s": 2.0, "frames_hz": 20.0}).items() <= hello.items()
    how = {"trial": "7 of 20 sweeps", "skin": "streaming", "answered": 7, "ready": True}
    assert (how | {"pid": os.getpid()}).items() <= health.items()
    assert health["time_ns"] >= health["since_ns"] > 0
    assert offered.peer().lines()[1] == health
    offered.turns(375, step_s=0.008)
    assert kinds(peer.lines()) == ["health"] * 3
    assert offered.peer().lines()[1]["time_ns"] > health["time_ns"]
    peer.lines()
    offered.turns(2, HEALTH._replace(sweeping=True, ready=False))
    offered.turns(2, HEALTH._replace(skin="absent", trouble="no skin on USB", ready=False))
    swept, gone = of(peer.lines(), "state")[-2:]
    state = {"type": "state", "skin": "streaming", "trouble": "", "sweeping": True, "ready": False}
    assert swept == state
    assert (gone["skin"], gone["trouble"]) == ("absent", "no skin on USB")


@pytest.mark.parametrize("hz", [0.5, 1, 5, 8, 20])
def test_frames_come_at_the_rate_that_was_asked_for(offered, hz):
    """The newest so often, and none once 0 was asked for."""
    peer, other = offered.peer(), offered.peer()
    peer.ask(json.dumps({"frames": hz}))
    found: Lines = []
    for i in range(1250):
        offered.feed.frames(frames(first=6 * i))
        offered.turns(step_s=0.008)
        found += of(peer.lines(), "frame")
    assert len(found) == pytest.approx(10 * hz, abs=1)
    last = frames(first=6 * round(found[-1]["time_ns"] / 6000 - 5 / 6))
    assert found[-1]["time_ns"] == int(last.t_ns[-1])
    assert found[-1]["taxels"] == last.taxels[-1].tolist()
    peer.ask('{"frames": 0}')
    offered.turns(20)
    peer.lines()
    offered.feed.frames(frames())
    offered.turns(20)
    assert "frame" not in kinds(peer.lines() + other.lines())


def test_of_a_large_skin_fewer_frames_are_offered(offers):
    """10,000 counts a second at most, whatever was asked."""
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


def test_a_verdict_has_the_probabilities_of_all_labels(offered):
    """And the shift; absent speed and force are left out."""
    peer = asking(offered)
    for one in (OK, replace(OK, force_n=1.5)):
        offered.feed.answered(one)
        offered.turns()
    first, second = peer.lines()
    assert first == {"type": "verdict", **json.loads(json.dumps(OK.as_dict()))}
    assert (first["scores"], first["moved"]) == ([0.987, 0.013], "moved 2 mm")
    assert not first.keys() & {"speed_mm_s", "force_n"}
    assert (second["force_n"], "speed_mm_s" in second) == (1.5, False)


def test_counts_that_are_no_numbers_become_null(offers):
    """A float skin with a broken taxel: the line is valid JSON."""
    format = SweepFormat(1, 3, 100.0, 200, "float32", 3)
    offered = offers(format)
    peer = asking(offered, '{"frames": 20}')
    one = frames(1, format)
    one.taxels[0, 0, 1] = (np.nan, np.inf, 0.5)
    offered.feed.frames(one)
    offered.turns(5)
    assert of(peer.lines(), "frame")[0]["taxels"][0][1] == [None, None, 0.5]


def test_a_verdict_is_not_kept_for_the_next_look(offered):
    """Sent with its turn; a storm each 5 ms at most."""
    peer = asking(offered)

    def later(ns: int) -> list[str]:
        offered.turns(step_s=0)
        offered.clock.sleep_until(offered.clock.now_ns() + ns)
        offered.feed.answered(OK)
        offered.turns(step_s=0)
        return kinds(peer.lines(), "health")

    assert [later(8_000_000 - turn) for turn in range(3)] == [["verdict"]] * 3
    assert later(1_000_000) == []
    offered.turns(2, step_s=0.005)
    assert kinds(peer.lines()) == ["verdict"]


@pytest.mark.parametrize("format", [skin.FORMAT, LARGE])
def test_the_window_of_a_sweep_comes_bit_for_bit(offers, format):
    """After the verdict, on request, in pieces over 64 kB."""
    offered = offers(format)
    peers, other = [asking(offered), asking(offered)], offered.peer()
    sweep = cut(format)
    offered.feed.answered(OK)
    offered.feed.sweep(sweep, OK, {})
    offered.feed.answered(replace(OK, sweep=8))
    offered.feed.sweep(replace(sweep, frames=Frames.empty(format)), OK, {})
    got: list[Lines] = [[], []]
    for _ in range(20):
        offered.turns()
        for lines, peer in zip(got, peers, strict=True):
            lines += peer.lines()
    for lines in got:
        assert kinds(lines, "health") == ["verdict", "sweep", "verdict"]
        (line,) = of(lines, "sweep")
        shape = [format.window, format.rows, format.cols]
        assert (line["sweep"], line["start_ns"], line["shape"]) == (7, 5, shape)
        assert line["dtype"] == format.dtype
        assert b64decode(line["data"]) == sweep.frames.taxels.tobytes()
    assert "sweep" not in kinds(other.lines())


def test_readers_that_never_read_cost_little_memory(offers):
    """Less than 4 MiB, and the last is served."""
    large = offers(LARGE)
    every = '{"frames": 20, "sweeps": true}'
    peers = [asking(large, every) for _ in range(MOST_READERS - 1)]
    quick = asking(large)
    got: list[str] = []
    gc.collect()
    tracemalloc.start()
    for i in range(12):
        large.feed.answered(OK)
        large.feed.sweep(cut(LARGE), OK, {})
        for _ in range(34):
            large.feed.frames(frames(6, LARGE, 6 * i))
            large.turns()
            got += kinds(quick.lines())
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 4 << 20
    assert all(reader._size <= QUEUE_BYTES for reader in large.feed._readers.values())
    assert got.count("sweep") == 12
    assert len(large.feed._readers) == MOST_READERS == len(peers) + 1


def test_a_window_that_is_too_large_is_counted(offers):
    """Over 768 kB one `lost` line; 640 kB comes behind others."""
    format = SweepFormat(32, 32, 100.0, 300, "uint16")
    offered = offers(format)
    peer = asking(offered)
    offered.feed.sweep(cut(format), OK, {})
    offered.turns(2)
    assert peer.lines() == [{"type": "lost", "lines": 1}]
    offered.feed.answered(OK)
    offered.feed.sweep(cut(replace(format, window=234)), OK, {})
    got: Lines = []
    for _ in range(40):
        offered.turns()
        got += peer.lines()
    assert kinds(got, "health") == ["verdict", "sweep"]


def test_who_does_not_keep_up_loses_old_lines_and_hears_how_many(offered):
    """Four thousand verdicts, and a reader that does not read: its lines in the end and its lost
    lines add up to all of them. Another reader has them all, and the queue stayed within its limit.
    """
    slow, quick = offered.peer(), offered.peer()
    whole: Lines = []
    for i in range(4000):
        offered.feed.answered(replace(OK, sweep=i))
        offered.turns(step_s=0.001)
        whole += quick.lines()
    offered.turns(2)
    whole += quick.lines()
    assert [line["sweep"] for line in of(whole, "verdict")] == list(range(4000))
    waiting = next(r for r in offered.feed._readers.values() if r.waits)
    assert waiting._size <= QUEUE_BYTES
    got: Lines = []
    for _ in range(60):
        offered.turns()
        got += slow.lines()
    (lost,) = of(got, "lost")
    at = kinds(got).index("lost")  # where the gap is; each reader has a hello and health of its own
    assert got[2:at] == whole[2:at]
    rest = got[at + 1 :]
    first = whole.index(rest[0])
    assert first - at == lost["lines"]
    assert rest[: len(whole) - first] == whole[first:]


def test_a_window_takes_no_room_from_what_waits_already(offered):
    """Of thirty some fit; each line is there or counted."""
    peer = offered.peer()
    peer.ask('{"sweeps": true}')
    offered.turns(2)
    (reader,) = offered.feed._readers.values()
    for i in range(30):
        offered.feed.sweep(cut(), OK, {})
        offered.feed.answered(replace(OK, sweep=i))
    assert reader._size <= QUEUE_BYTES
    got: Lines = []
    for _ in range(40):
        got += peer.lines()
        offered.turns(5)
    windows = kinds(got).count("sweep")
    assert 20 < windows < 30
    assert [line["sweep"] for line in of(got, "verdict")] == [*range(30)]
    assert windows + sum(line["lines"] for line in of(got, "lost")) == 30


def test_one_reader_too_many_is_told_why_it_is_not_served(offered):
    """One line and its end; later there is room."""
    peers = [offered.peer() for _ in range(MOST_READERS)]
    assert all(kinds(peer.lines())[0] == "hello" for peer in peers)
    late = offered.peer()
    assert kinds(late.lines()) == ["closed"]
    assert late.ended
    offered.feed.answered(OK)
    offered.turns()
    assert all("verdict" in kinds(peer.lines()) for peer in peers)
    peers[5].socket.close()
    offered.turns(2)
    assert kinds(offered.peer().lines()) == BOTH


def test_a_thousand_connections_leave_no_file_open(offered):
    """Whatever they do, no descriptor and no reader is left."""
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
    "garbage": (b"\x00\xff\x80 garbage\n", "json"),
    "another form": (b"[1]\n", "not a request"),
    "an empty line": (b"\n", "json"),
    "nothing asked": (b"{}\n", "not a request"),
    "an unknown name": (b'{"frames": 1, "write": true}\n', "not a request"),
    "too many frames": (b'{"frames": 21}\n', "0 to 20"),
    "fewer than none": (b'{"frames": -1}\n', "0 to 20"),
    "no number": (b'{"frames": NaN}\n', "0 to 20"),
    "a truth for a number": (b'{"frames": true}\n', "0 to 20"),
    "nothing for a number": (b'{"frames": null}\n', "0 to 20"),
    "a number for a truth": (b'{"sweeps": 1}\n', "true or false"),
    "brackets in brackets": (b"[" * 1000 + b"\n", "json"),
    "a number without end": (b'{"frames": 1' + b"0" * 900 + b"}\n", "0 to 20"),
    "no end": (b"x" * 1100, "1024"),
    "a very long line": (b"x" * 5000 + b"\n", "1024"),
}


@pytest.mark.parametrize("data", WRONG)
def test_what_is_no_request_closes_its_reader_alone(offered, data):
    """It hears why; another reader goes on."""
    sent, why = WRONG[data]
    peer, other = offered.peer(), offered.peer()
    peer.ask(sent)
    offered.turns(20)
    lines = peer.lines()
    assert kinds(lines) == [*BOTH, "closed"]
    assert why in lines[-1]["why"]
    assert lines[-1]["why"].isprintable()
    assert peer.ended
    offered.feed.answered(OK)
    offered.turns(2)
    assert "verdict" in kinds(other.lines())


def test_requests_in_parts_are_requests(offered):
    """Byte by byte, and several in one."""
    peer = offered.peer()
    for byte in b'{"frames": 2.5}\n{"sweeps": true}\n{"sweeps": false, "frames": 4}\n':
        peer.ask(bytes([byte]))
        offered.turns()
    (reader,) = offered.feed._readers.values()
    assert (reader.frames_hz, reader.sweeps) == (4.0, False)
    found, rest = requests(b'{"frames": 1}\n{"sweeps": true}\n{"fr')
    assert (found, rest) == ([FeedRequest(1.0), FeedRequest(None, True)], b'{"fr')


def test_endless_requests_are_read_a_little_each_turn(offered, monkeypatch):
    """A few bytes a turn, and others are served."""
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
    assert (
        sum(reader.sweeps for reader in offered.feed._readers.values()) == 1
    )  # between the floods
    offered.feed.answered(OK)
    offered.turns(4)
    assert "verdict" in kinds(other.lines())


@pytest.mark.parametrize(
    ("cost_ns", "period_ns"),
    [
        (round(PERIOD_NS * SHARE / 2), PERIOD_NS),
        (round(PERIOD_NS * SHARE * 3), PERIOD_NS * 3),
        (PERIOD_NS, MOST_PERIOD_NS),
    ],
)
def test_a_costly_look_at_the_sockets_puts_off_the_next(offered, monkeypatch, cost_ns, period_ns):
    """Rounds use no more than SHARE of a core."""
    offered.cost_ns = cost_ns
    looks: list[int] = []
    monkeypatch.setattr(offered.feed, "_work", lambda *_: looks.append(offered.clock.now_ns()))
    offered.turns(1000, step_s=0.001)
    assert len(looks) >= 3
    assert {b - a for a, b in pairwise(looks)} == {period_ns}


def test_one_that_only_listens_may_close_its_own_side(offered):
    """As `socat` does: lines go on until it leaves."""
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


@pytest.mark.parametrize("mask", [0o000, 0o077])
def test_members_of_the_group_may_read_and_nobody_else(offers, mask):
    """Mode 660, whatever the umask, and the umask is as before."""
    before = os.umask(mask)
    try:
        offered = offers()
    finally:
        assert os.umask(before) == mask
    assert stat.S_IMODE(offered.path.stat().st_mode) == 0o660
    offered.feed.stopping()
    assert not offered.path.exists()


def test_the_socket_of_a_process_that_died_is_replaced(tmp_path, offers, logged):
    """A second box beside a living one waits for it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(tmp_path / "feed.sock"))
    first = offers()
    assert kinds(first.peer().lines()) == BOTH
    assert logged == []
    second = offers()
    second.turns(1000)
    assert len(logged) == 1
    first.turns(10)  # the second has knocked
    assert kinds(first.peer().lines()) == BOTH
    first.feed.stopping()
    second.turns(700)
    assert kinds(second.peer().lines()) == BOTH


def test_a_path_that_cannot_be_bound_is_told_once(tmp_path, offers, logged):
    """One line, turns go on; later the feed is there."""
    offered = offers(path=tmp_path / "run" / "feed.sock")
    offered.turns(2000)
    assert len(logged) == 1
    offered.path.parent.mkdir()
    offered.path.write_text("mine")
    offered.turns(2000)
    assert len(logged) == 2
    assert offered.path.read_text() == "mine"
    offered.path.unlink()
    offered.turns(700)
    assert kinds(offered.peer().lines()) == BOTH
    offers(path=tmp_path / ("x" * 120)).turns(1000)
    assert len(logged) == 4


def test_a_box_that_ends_says_so_and_nothing_is_sent_after_it(offered):
    """Waiting lines, the reason, an end."""
    peer = offered.peer()
    offered.feed.answered(OK)
    offered.feed.stopping()
    offered.feed.answered(replace(OK, status=Status.ABORTED))
    offered.feed.sweep(cut(), OK, {})
    lines = peer.lines()
    assert kinds(lines) == [*BOTH, "verdict", "closed"]
    assert "stopping" in lines[-1]["why"]
    assert peer.ended


def test_without_readers_nothing_is_written_as_text(offered, monkeypatch):
    """No verdict, no frame, no health is encoded; only changes of the state are."""
    made: list[str] = []
    monkeypatch.setattr(module, "encode", lambda kind, content: made.append(kind) or b"")
    for _ in range(500):
        offered.feed.frames(frames())
        offered.feed.answered(OK)
        offered.feed.sweep(cut(), OK, {})
        offered.turns()
    assert set(made) <= {"state"}


def test_a_clock_that_jumps_ahead_gives_one_line(offered):
    """After a suspend of a day: one health and one frame, and no frame is repeated."""
    peer = asking(offered, '{"frames": 20}')
    offered.feed.frames(frames())
    offered.clock.sleep_until(offered.clock.now_ns() + 86_400 * SECOND)
    offered.turns(10)
    assert sorted(kinds(peer.lines())) == ["frame", "health"]


def test_a_running_box_offers_its_verdicts_frames_and_sweeps(rigged, tmp_path):
    """On simulated devices, as the robot and the box."""
    simulated = tubes(1)
    path = tmp_path / "feed.sock"
    feed = FeedServer(path, skin.FORMAT, {"source": "sim"}, simulated.clock, {}, lambda: 0)
    box = rigged(simulated, observers=[feed])
    box.box.step()
    peer = FeedPeer(path)
    peer.ask('{"frames": 20, "sweeps": true}')
    lines: Lines = []
    verdicts = []
    while box.box.answered < 3:
        verdicts += box.box.step()
        lines += peer.lines()
    for _ in range(20):
        box.box.step()
        lines += peer.lines()
    told = [(v["sweep"], v["label"], v["probability"]) for v in of(lines, "verdict")]
    assert told == [(v.sweep, v.label, v.probability) for v in verdicts]
    cuts = {line["sweep"]: line for line in of(lines, "sweep")}
    for sweep in box.kept[:3]:
        assert b64decode(cuts[sweep.id]["data"]) == sweep.frames.taxels.tobytes()
    states = {(line["sweeping"], line["ready"]) for line in of(lines, "state")}
    assert {(True, False), (False, True)} <= states
    assert "frame" in kinds(lines)
    feed.stopping()
