"""The feed's reader: lines in parts, boxes that come, go, restart, and `palpate run` itself."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from palpate.client.feed import ENDED, MOST_LINE, Feed, parse
from palpate.core.errors import FeedError, FormatError
from tests.factories.feeds import OK, Offered
from tests.factories.paths import ROOT

pytestmark = pytest.mark.usefixtures("hurried")

HELLO = b'{"type": "hello", "schema": 1}\n'


class FakeFeed:
    """A box that sends the lines of a test."""

    def __init__(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.listener.bind(str(path))
        self.listener.listen()
        self.listener.settimeout(5)

    def meet(self, feed: Feed, data: bytes) -> socket.socket:
        """Let the reader connect, and send it something."""
        assert feed.read(0) is None
        connection, _ = self.listener.accept()
        connection.settimeout(5)
        connection.sendall(data)
        return connection


@pytest.fixture
def feed(tmp_path: Path) -> Iterator[Feed]:
    """A reader of a feed that is not there yet."""
    with Feed(tmp_path / "feed.sock") as one:
        yield one


def test_lines_come_whole_and_a_loop_ends_with_the_reason(feed, monkeypatch):
    """Split at every byte; without a box an error with exit code 69."""
    data = HELLO + b'{"type": "health", "skin": "r\\u00e4u"}\n{"type'
    whole, rest = parse(data)
    assert [line["type"] for line in whole] == ["hello", "health"]
    assert rest == b'{"type'
    for cut in range(len(data)):
        first, left = parse(data[:cut])
        then, left = parse(data[cut:], left)
        assert (first + then, left) == (whole, rest)
    monkeypatch.setattr(Feed, "read", lambda self, timeout_s: None)
    with pytest.raises(FeedError, match="nothing") as e:
        next(iter(feed))
    assert e.value.exit_code == 69


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"SSH-2.0-OpenSSH\r\n", "a line of a feed"),
        (b"[1]\n", "a line of a feed"),
        (b'{"kind": "hello"}\n', "a line of a feed"),
        (b'{"type": 1}\n', "a line of a feed"),
        (b"[" * 100_000 + b"\n", "a line of a feed"),
        (b"x" * (MOST_LINE + 1), "over 1048576 bytes"),
        (b'{"type": "hello", "schema": 2}\n', "speaks schema 2"),
        (b'{"type": "hello"}\n', "speaks schema None"),
    ],
)
def test_what_is_no_feed_is_named(feed, data, why):
    """`parse` raises; a Feed closes the connection and gives the reason."""
    with pytest.raises(FormatError, match=why):
        parse(data)
    server = FakeFeed(feed.path)
    with server.meet(feed, b"") as connection:
        connection.setblocking(False)
        sent = 0
        while sent < len(data) and feed.connected:
            sent += connection.send(data[sent : sent + 65536])
            assert feed.read(0) is None
        assert why in feed.trouble
        assert not feed.connected


@pytest.mark.slow
def test_what_is_asked_for_is_asked_again_after_a_restart(feed):
    """Each new connection begins with the requests of this reader."""
    server = FakeFeed(feed.path)
    feed.ask(frames_hz=5)
    with server.meet(feed, HELLO) as connection:
        assert json.loads(connection.recv(1000)) == {"frames": 5, "sweeps": False}
        assert feed.read()["type"] == "hello"
        feed.ask(sweeps=True)
        assert json.loads(connection.recv(1000)) == {"frames": 5, "sweeps": True}
    assert feed.read(0) is None
    assert (feed.trouble, feed.connected) == (ENDED, False)
    time.sleep(0.6)
    with server.meet(feed, HELLO) as connection:
        assert json.loads(connection.recv(1000)) == {"frames": 5, "sweeps": True}
        assert feed.read()["type"] == "hello"
        assert feed.trouble == ""


@pytest.mark.slow
def test_without_a_box_it_says_what_to_do(feed, tmp_path):
    """No socket, or a socket without a server: a reason and not an error."""
    assert feed.read(0) is None
    assert "start" in feed.trouble
    FakeFeed(feed.path).listener.close()
    time.sleep(0.6)
    assert feed.read(0.01) is None
    assert "start" in feed.trouble
    assert feed.fileno() == -1
    file = Feed(tmp_path)
    assert file.read(0) is None
    assert file.trouble


def test_a_box_is_read_and_its_reason_is_kept(tmp_path):
    """Silence ends nothing; the reason is in `trouble` and is a line."""
    offered = Offered(tmp_path / "feed.sock")
    offered.turns()
    with Feed(offered.path) as feed:
        assert feed.read(0.01) is None
        assert feed.connected
        assert feed.trouble
        offered.turns(5)
        offered.feed.answered(OK)
        offered.turns(2)
        lines = list(iter(lambda: feed.read(0), None))
        assert [line["type"] for line in lines] == ["hello", "health", "verdict"]
        assert lines[2]["label"] == "plastic rough"
    with Feed(offered.path, frames_hz=50) as feed:
        feed.read(0)
        offered.turns(10)
        kinds = [line["type"] for line in iter(lambda: feed.read(0), None)]
        assert kinds == ["hello", "health", "closed"]
        assert "from" in feed.trouble
    offered.feed.stopping()


@pytest.mark.slow
def test_palpate_run_is_killed_and_comes_back_under_a_reader(tmp_path):
    """One reader, two processes; the end gives its reason."""

    @contextmanager
    def running(path: Path) -> Iterator[subprocess.Popen]:
        """`palpate run` on a simulated skin, with its feed at `path`; killed at the end."""
        words = ["-m", "palpate", "run", "--sim", "skin", "--set", f"store.runtime={path.parent}"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen([sys.executable, *words], cwd=ROOT, **quiet) as process:
            try:
                yield process
            finally:
                process.kill()

    path = tmp_path / "feed.sock"
    pids = []
    with Feed(path, frames_hz=5, sweeps=True) as feed:
        for wait in ("sweep", "health"):
            with running(path) as process:
                seen: list[str] = []
                for line in iter(lambda: feed.read(120), None):
                    seen.append(line["type"])
                    if line["type"] == "hello":
                        pids.append(line["pid"])
                        assert line["labels"]
                    # the last lines of the first box come before the hello of the second
                    begin = seen.index("hello") if "hello" in seen else len(seen)
                    if {wait, "frame", "health"} <= {*seen[begin:]}:
                        break
                assert seen[begin : begin + 2] == ["hello", "health"]
                if wait == "health":
                    process.send_signal(signal.SIGTERM)
                    assert process.wait(60) == 0
            assert path.exists() == (wait == "sweep")
        rest = list(iter(lambda: feed.read(0), None))
        assert rest[-1] == {"type": "closed", "why": "the box is stopping"}
    assert len(set(pids)) == 2
