"""`palpate watch` without a page: a line for each event, also over restarts of the box."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from palpate.cli.main import main
from palpate.core.clock import SystemClock
from palpate.core.errors import ConfigError, FormatError
from palpate.service.feed_reader import encode
from palpate.web import lines
from palpate.web.lines import LineWatch, event, pass_on
from tests.factories.feeds import HEALTH, OK, Offered

HELLO = {"type": "hello", "pid": 7, "source": "usb", "skin": "palpate", "bundle": "9f3c2a1b"}
STATE = {"type": "state", "skin": "lost", "trouble": "gone", "sweeping": False, "ready": False}
VERDICT = {"type": "verdict", **OK.as_dict(arrays=False)}


@pytest.fixture
def offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Offered]:
    """A running feed, whose readers do not wait."""
    monkeypatch.setattr(lines, "READ_S", 0.01)
    one = Offered(tmp_path / "feed.sock")
    one.turns()
    yield one
    one.feed.stopping()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (HELLO, "box 7: palpate, bundle 9f3c2a1b"),
        (HELLO | {"source": "sim", "bundle": ""}, "box 7: SIMULATED palpate, bundle none"),
        (HELLO | {"source": "replay"}, "box 7: REPLAYED palpate, bundle 9f3c2a1b"),
        (HELLO | {"skin": "\033[2Ja"}, "box 7: ?[2Ja, bundle 9f3c2a1b"),
        (STATE | {"sweeping": True}, "SWEEPING"),
        (STATE | {"ready": True}, "READY"),
        (STATE | {"trouble": "\033[Hgone\n"}, "NOT READY: skin lost ?[Hgone?"),
        ({"type": "lost", "lines": 12}, "12 lines missed"),
        ({"type": "weather"}, ""),
        ({"type": "frame", "taxels": [[1]]}, ""),
    ],
)
def test_each_event_in_words(line, said):
    """Control characters of a device do not reach the terminal; unknown lines say nothing."""
    assert event(line, {}, 0) == said


def test_a_verdict_has_the_name_for_people_and_a_feed_that_is_off_none(capsys):
    """Unknown members are ignored; the message gives the setting."""
    said = event(VERDICT | {"more": 1}, {"plastic rough": "Kunststoff"}, 10**9)
    assert re.search(r"7 .*1 s .*ok .*ff .*98\.7", said)
    assert main(["watch", "--set", "store.runtime="]) == ConfigError.exit_code
    assert "store.runtime" in capsys.readouterr().err


@pytest.mark.parametrize(
    "line",
    [
        {"type": "hello"},
        {"type": "lost"},
        VERDICT | {"status": "fine"},
        VERDICT | {"latency_ns": None},
        {"type": "state", "skin": "lost"},
    ],
)
def test_a_malformed_line_is_an_error(line):
    """Its type is in the message."""
    with pytest.raises(FormatError, match=line["type"]):
        event(line, {}, 0)


@pytest.mark.slow
def test_connection_events_end_and_return_of_the_box(offered, monkeypatch):
    """A line each; no frames are asked for."""
    out = io.StringIO()
    watch = LineWatch(str(offered.path), out, SystemClock())
    watch.step()
    offered.turns(3)
    for _ in range(3):
        watch.step()
    assert all(reader.frames_hz == 0 for reader in offered.feed._readers.values())
    offered.feed.answered(OK)
    offered.turns(2, HEALTH._replace(sweeping=True, ready=False))
    for _ in range(3):
        watch.step()
    offered.feed.stopping()
    for _ in range(3):
        watch.step()
    said = out.getvalue().splitlines()
    assert re.match(r"box \d+: palpate", said[0])
    assert "plastic rough" in said[1]
    assert said[2:] == ["SWEEPING", "NO FEED: the box is stopping"]
    again = Offered(offered.path)
    again.turns()
    monkeypatch.setattr(lines, "READ_S", 0.7)  # longer than the wait before another attempt
    watch.step()
    again.turns(3)
    watch.step()
    assert out.getvalue().splitlines()[-1].startswith("box ")
    again.feed.stopping()


def test_what_cannot_be_read_closes_the_connection(offered):
    """A malformed verdict causes one line."""
    out = io.StringIO()
    watch = LineWatch(str(offered.path), out, SystemClock())
    watch.step()
    offered.turns(2)
    (reader,) = offered.feed._readers.values()
    reader.put(encode("verdict", {"status": "fine"}))
    offered.turns(2)
    for _ in range(4):
        watch.step()
    assert out.getvalue().count("NO FEED: ") == 1
    assert "malformed" in out.getvalue()


def test_json_passes_the_lines_on(offered):
    """The lines that any reader gets; a missing box is explained on standard error."""
    peer = offered.peer()
    out, said, turns = io.StringIO(), [], [0]

    def stopped() -> bool:
        turns[0] += 1
        if turns[0] == 4:
            offered.feed.answered(OK)
        offered.turns(step_s=0.1)
        return turns[0] > 10

    pass_on(str(offered.path), out, SystemClock(), stopped, said.append)
    got = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [line["type"] for line in got][:3] == ["hello", "health", "verdict"]
    assert got[2] in peer.lines()
    assert set(said) == {""}
    pass_on(str(offered.path) + "x", out, SystemClock(), iter([False, True]).__next__, said.append)
    assert said[-1]
