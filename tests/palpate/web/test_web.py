"""`palpate watch --web` on a feed, with boxes that end, restart, or do not exist."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from palpate.client.verdicts import VerdictFile
from palpate.core.clock import SystemClock
from palpate.core.errors import FormatError
from palpate.web.access import Access
from palpate.web.history import History
from palpate.web.web import FRAMES_HZ, PageWatcher
from tests.factories import feed_lines
from tests.factories.browser import WAIT_S, until
from tests.factories.feeds import HEALTH, OK, Offered, cut, frames
from tests.factories.page_client import EventReader, PageAddress, ask, status
from tests.factories.shown_page import four_hours_ago

pytestmark = pytest.mark.usefixtures("hurried")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Path of the feed."""
    return tmp_path / "feed.sock"


@pytest.fixture
def watcher(path: Path) -> Iterator[PageWatcher]:
    """Watches the feed at `path`; the test takes its steps."""
    history = History(path.with_name("verdicts.db"), four_hours_ago())
    one = PageWatcher(str(path), Access(0), SystemClock().now_ns, history)
    with one.server, one.feed:
        yield one


def heard(
    watcher: PageWatcher,
    offered: Offered | None,
    name: str,
    reader: EventReader,
    wanted: object = None,
) -> object:
    """The next event of this name, with its turns. wanted: its content; others are skipped."""
    reader.socket.settimeout(0.01)
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        if offered:
            offered.turns(3)
        watcher.step()
        with suppress(TimeoutError):
            while (event := reader.until(name)) != wanted and wanted is not None:
                pass
            return event
    raise AssertionError(f"no {name}")


def test_what_the_box_does_comes_to_the_page(watcher, path):
    """Verdicts, views of the frames, and the sweep's picture under its number."""
    offered = Offered(path)
    reader = EventReader(watcher.server)
    assert heard(watcher, offered, "hello", reader)["labels"] == ["plastic rough", "wood"]
    assert heard(watcher, offered, "health", reader)["answered"] == 7
    offered.feed.answered(OK)
    assert heard(watcher, offered, "verdict", reader)["scores"] == [0.987, 0.013]
    counted = json.loads(ask(watcher.server, "/history/90").partition(b"\r\n\r\n")[2])
    assert sum(n for _, _, n in counted["counts"]) == 1
    offered.feed.sweep(cut(), OK, {})
    number = heard(watcher, offered, "signal", reader)["number"]
    picture = json.loads(ask(watcher.server, f"/sweep/{number}").partition(b"\r\n\r\n")[2])
    assert (picture["sweep"], picture["seconds"]) == (7, 2.0)
    offered.feed.frames(frames())
    assert heard(watcher, offered, "view", reader)["shape"] == [4, 4]


@pytest.mark.parametrize("content", [b"", b"no file of SQLite" * 500])
def test_a_file_of_verdicts_that_cannot_be_read(watcher, path, content):
    """Counts and CSV file say why."""
    path.with_name("verdicts.db").write_bytes(content)
    answers = [ask(watcher.server, f"/{name}/1") for name in ("history", "verdicts")]
    assert [status(answer) for answer in answers] == [200, 503]
    for answer in answers:
        assert b"verdicts.db" in answer


@pytest.mark.parametrize("wrong", [{"time_ns": "1"}, {"label": None}, {"sweep": [1]}])
def test_a_verdict_of_another_version_does_not_end_the_page(watcher, wrong):
    """It is refused as other lines of the feed are."""
    with pytest.raises(FormatError, match="version"):
        watcher.history.take(feed_lines.verdict(1, 1.0) | wrong, SystemClock().now_ns())


def test_verdicts_of_a_clock_that_was_wrong(watcher, path):
    """Years ahead they are in no count, picture or CSV file of now; an hour ahead they are."""
    file = VerdictFile(path.with_name("verdicts.db"))
    for sweep, ahead_s in ((1, 0), (2, 3600), (3, 5e8), (4, 1e300)):
        file.add(time.time() + ahead_s, {"sweep": sweep, "status": "ok", "label": "wood"})
    file.close()
    counted = watcher.history.counted("0")
    assert counted["counts"] == [["ok", "wood", 2]]
    spans = (counted["to_s"] - counted["from_s"]) / counted["span_s"]
    assert all(0 <= n <= spans for n, *_ in counted["trend"])
    assert len("".join(watcher.history.rows("0")).splitlines()) == 3


def test_frames_are_asked_for_while_somebody_watches(watcher, path):
    """From the first browser to the last: without one the page costs nothing."""
    offered = Offered(path)
    until(lambda: (offered.turns(3), watcher.step(), watcher.feed.connected)[-1])

    def asked() -> set[float]:
        offered.turns(3)
        watcher.step()
        return {reader.frames_hz for reader in offered.feed._readers.values()}

    until(lambda: asked() == {0.0})
    reader = EventReader(watcher.server)
    until(lambda: asked() == {FRAMES_HZ})
    reader.socket.close()
    until(lambda: asked() == {0.0})
    assert not watcher.server.watched


def test_a_box_that_ends_and_comes_back_with_another_bundle(watcher, path):
    """Away and why; the history has the changes."""
    offered = Offered(path)
    reader = EventReader(watcher.server)
    heard(watcher, offered, "box", reader, wanted={"there": True, "why": ""})
    heard(watcher, offered, "health", reader)
    offered.turns(3, HEALTH._replace(skin="lost", trouble="unplugged", ready=False))
    assert heard(watcher, None, "state", reader)["trouble"] == "unplugged"
    offered.feed.stopping()
    assert heard(watcher, None, "box", reader) == {"there": False, "why": "the box is stopping"}
    again = Offered(path)
    again.feed._hello = again.feed._hello.replace(b"9f3c2a1b", b"aaaa0001").replace(
        b'"pid": ', b'"pid": 1'
    )
    heard(watcher, again, "box", reader, wanted={"there": True, "why": ""})
    assert "aaaa0001" in heard(watcher, again, "note", reader)["text"]


def test_a_box_that_is_not_there_is_shown_as_away(watcher, path, logged):
    """The page gets it again and again; the log has it once."""
    reader = EventReader(watcher.server)
    for _ in range(2):
        said = heard(watcher, None, "box", reader)
        assert said["there"] is False
        assert "systemctl" in said["why"]
    assert sum(line.startswith("<4>feed: ") for line in logged) == 1


RUBBISH = [
    b"\x00\xff\xfe\n",
    b"{}\n",
    b"[" * 100_000 + b"\n",
    b'{"type": "hello", "schema": 99}\n',
    b"x" * (2 << 20),
    b'{"type": "health"}\n',
    (json.dumps(feed_lines.hello() | {"format": 7}) + "\n").encode(),
    b"",
]


@pytest.mark.parametrize("sent", RUBBISH, ids=range(len(RUBBISH)))
def test_a_socket_that_is_no_feed_is_shown_as_a_box_that_is_away(watcher, path, sent):
    """And a real feed is read later."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            with suppress(OSError):
                while True:
                    one, _ = listener.accept()
                    with one, suppress(OSError):
                        one.sendall(sent)

        threading.Thread(target=serve, daemon=True).start()
        reader = EventReader(watcher.server)
        assert heard(watcher, None, "box", reader)["there"] is False
        assert status(ask(watcher.server)) == 200
        listener.shutdown(socket.SHUT_RDWR)
    path.unlink()
    offered = Offered(path)
    while not heard(watcher, offered, "box", reader)["there"]:
        pass


@pytest.mark.slow
def test_the_command_serves_its_page_until_it_is_ended(tmp_path):
    """The real command: address, page, a box that is away, exit 0 at SIGTERM."""
    command = [sys.executable, *["-m", "palpate", "watch", "--web", "0", "--set"]]
    command += [f"store.runtime={tmp_path}/none"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as run:
        address = re.search(r"page: (http://127\.0\.0\.1:\d+)", run.stderr.readline())[1]
        there = PageAddress(address)
        assert status(ask(there)) == 200
        reader = EventReader(there)
        assert reader.until("box")["there"] is False
        run.send_signal(signal.SIGTERM)
        assert run.wait(timeout=WAIT_S) == 0
        run.stderr.close()
