"""`palpate watch` with a terminal of any size, without a terminal, and over restarts of the box."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.alignment.terminal import ASCII, LEAVE
from palpate.cli.main import main
from palpate.core.clock import SystemClock
from palpate.core.errors import ConfigError, FormatError
from palpate.core.types import Status, SweepFormat
from palpate.service.feed_reader import encode
from palpate.sim import skin
from palpate.web import terminal
from palpate.web.terminal import TerminalWatch, WatchedBox, events, pass_on, picture
from tests.factories.feeds import HEALTH, OK, FeedPeer, Offered, cut, frames
from tests.factories.simulated_box import SECOND


def lines_of(folder: Path, format: SweepFormat = skin.FORMAT, **facts: str) -> list[dict[str, Any]]:
    """The lines of a box that streams, answers twice and is swept again."""
    offered = Offered(folder / "feed.sock", format, **facts)
    peer = offered.peer()
    peer.ask('{"frames": 20, "sweeps": true}')
    offered.turns(2)
    for verdict in (
        OK,
        replace(OK, sweep=8, status=Status.SHORT, label="", scores=np.empty(0), displacement=""),
    ):
        offered.feed.frames(frames(1, format, first=int(verdict.sweep) * 5))
        offered.feed.answered(verdict)
        offered.turns(4)
    offered.feed.sweep(cut(format), OK, {})
    offered.turns(4)
    lines = peer.lines()
    for _ in range(20):  # a large window is sent in several turns, before what comes after it
        offered.turns(1, replace(HEALTH, sweeping=True, ready=False))
        lines += peer.lines()
    offered.feed.stopping()
    return lines


def state_of(lines: list[dict[str, Any]]) -> WatchedBox:
    """The state after these lines."""
    state = WatchedBox()
    for line in lines:
        state.take(line)
    return state


def plain(text: str) -> str:
    """Text without control sequences."""
    return re.sub(r"\033\[[0-9;]*m", "", text)


def drawn(state: WatchedBox, width: int = 80, height: int = 24, **more: Any) -> list[str]:
    """The picture of a state, without control sequences."""
    return [plain(line) for line in picture(state, 5 * SECOND, width, height, colours=True, **more)]


def test_the_picture_has_all_that_a_person_asks_for(tmp_path: Path) -> None:
    """The picture has skin, bundle, state, load, probabilities, counters, latency, and the last
    verdicts, the newest first."""
    shown = drawn(state_of(lines_of(tmp_path, trial="7 of 20 sweeps")))
    text = "\n".join(shown)
    assert "palpate 4x4 uint8 at 750 Hz" in shown[0]
    assert "bundle 9f3c2a1b" in shown[0]
    assert shown[1].strip() == "SWEEPING"
    assert re.search(r"plastic rough +█{12} +98\.7 %", text)
    assert re.search(r"wood +░{12} +1\.3 %", text)
    assert "streaming (5,000,000 frames, 3 lost)" in text
    assert "trial    7 of 20 sweeps" in text
    assert "latency  1.2 ms; median 1.2 ms, most 1.2 ms of 1" in text
    sweeps = [line.split()[1] for line in shown if line.startswith(" sweep ")]
    assert sweeps == ["8", "7"]
    load = [[int(n) for n in line.split()[:4]] for line in shown[3:7]]
    assert load == [[5] * 4] * 4  # five frames on, each taxel is five counts above its lowest


@pytest.mark.parametrize("size", [(80, 24), (40, 12), (132, 50), (20, 8)])
@pytest.mark.parametrize(
    "format",
    [
        skin.FORMAT,
        SweepFormat(16, 16, 100, 200, "uint16"),
        SweepFormat(3, 3, 100, 200, "float32", 3),
    ],
    ids=str,
)
@pytest.mark.parametrize("colours", [True, False])
def test_it_fits_any_terminal(
    tmp_path: Path, size: tuple[int, int], format: SweepFormat, colours: bool
) -> None:
    """No line is wider and no picture is higher than the terminal; 80x24 has room for state, skin
    and last verdict."""
    state = state_of(lines_of(tmp_path, format, trial="7 of 20 sweeps", shadow="x" * 200))
    raw = picture(state, 5 * SECOND, *size, colours=colours)
    assert len(raw) <= size[1]
    assert max(len(plain(line)) for line in raw) <= size[0]
    assert colours or not any("38;5" in line for line in raw)
    if size == (80, 24):
        text = "\n".join(raw)
        assert "SWEEPING" in text
        assert "skin     streaming" in text
        assert "sweep      8" in text


def test_a_terminal_without_utf_8_gets_plain_signs(tmp_path: Path) -> None:
    """Bars of # and dots."""
    text = "\n".join(drawn(state_of(lines_of(tmp_path)), signs=ASCII))
    assert "############" in text
    assert text.isascii()


def test_text_from_outside_does_not_steer_the_terminal(tmp_path: Path) -> None:
    """Control characters in names of skins and labels, and in texts of a device, become question
    marks."""
    lines = lines_of(tmp_path)
    lines[0] |= {"skin": "\033[2Ja", "labels": ["\033]0;b", "wood"], "bundle": "\a"}
    lines.append(
        {
            "type": "state",
            "skin": "absent",
            "trouble": "\033[Hgone\n",
            "sweeping": False,
            "ready": False,
        }
    )
    state = state_of(lines)
    shown = drawn(state)
    assert "?[2Ja" in shown[0]
    assert shown[1] == " NOT READY: skin absent ?[Hgone?"
    assert not any(c in line for line in shown for c in "\033\a")
    assert all(text.isprintable() for line in lines[-1:] for text in events(state, line, 0))


@pytest.mark.parametrize(
    "change",
    [
        {"type": "hello", "format": {"rows": 0}},
        {"type": "hello", "labels": 7},
        {"type": "health", "lost_frames": "many"},
        {"type": "verdict", "status": "fine"},
        {"type": "verdict", "latency_ns": None},
        {"type": "verdict", "scores": ["a"]},
        {"type": "frame", "taxels": []},
        {"type": "frame", "taxels": [[1, 2], [3]]},
        {"type": "frame", "taxels": 5},
        {"type": "frame", "taxels": [["x"]]},
        {"type": "lost", "lines": "many"},
        {"type": "sweep", "data": "AAAA"},
        {"type": "sweep", "dtype": "object"},
        {"type": "sweep", "shape": [6000, 4]},
        {"type": "sweep", "shape": [0, 4, 4]},
    ],
    ids=str,
)
def test_a_line_that_is_not_as_it_must_be_is_named(tmp_path: Path, change: dict[str, Any]) -> None:
    """The error is one line, and the state can still be shown."""
    lines = [*lines_of(tmp_path), {"type": "lost", "lines": 1}]
    state = state_of(lines)
    whole = next(line for line in lines if line["type"] == change["type"])
    with pytest.raises(FormatError, match=f"the feed's line {change['type']} is malformed") as e:
        state.take(whole | change)
    assert str(e.value).isprintable()
    assert drawn(state)


def test_lines_of_a_later_version_are_passed_over(tmp_path: Path) -> None:
    """Unknown types and members are ignored."""
    lines = [line | {"more": [1]} for line in lines_of(tmp_path)]
    assert drawn(state_of([{"type": "weather"}, *lines])) == drawn(state_of(lines))


def test_while_sweeps_are_recorded_the_last_one_is_shown(tmp_path: Path) -> None:
    """A recording has no labels: signal and spectrogram of the sweep are beside the skin, missing
    sweeps below."""
    lines = lines_of(tmp_path, recorded="missing: wood at 1: 7")
    lines[0] |= {"labels": [], "bundle": ""}
    shown = drawn(state_of(lines))
    text = "\n".join(shown)
    assert "375 Hz" in text
    assert "recorded missing: wood at 1: 7" in text
    assert max(map(len, shown)) <= 80
    assert len(shown) <= 24


def test_missed_lines_are_counted(tmp_path: Path) -> None:
    """The number of lines that this reader has lost is shown."""
    state = state_of([*lines_of(tmp_path), {"type": "lost", "lines": 1200}])
    assert any("1,200 lines missed" in line for line in drawn(state))


class Terminal(io.StringIO):
    """An output that claims to be a terminal."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        """It is."""
        return True

    def fileno(self) -> int:
        """One whose size is known."""
        return 1


@pytest.fixture
def offered(tmp_path: Path) -> Iterator[Offered]:
    """A running feed."""
    one = Offered(tmp_path / "feed.sock")
    one.turns()
    yield one
    one.feed.stopping()


def test_it_draws_and_gives_the_terminal_back(
    offered: Offered, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command asks for frames and draws the box; at the end the screen is as before."""
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(terminal, "READ_S", 0.01)
    monkeypatch.setattr(terminal, "DRAW_NS", 0)
    monkeypatch.setattr("os.get_terminal_size", lambda fd: (80, 24))
    out, turns = Terminal(), [0]
    watch = TerminalWatch(str(offered.path), out, SystemClock())

    def stopped() -> bool:
        offered.feed.frames(frames(first=turns[0]))
        offered.turns()
        turns[0] += 1
        return turns[0] > 12

    watch.run(stopped)
    assert watch._state.load
    assert "streaming (5,000,000 frames" in out.getvalue()
    assert out.getvalue().endswith(LEAVE)


@pytest.mark.slow
def test_without_a_terminal_each_event_is_a_line(
    offered: Offered, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A line is printed for connection, verdict, change of the state, end of the box and its
    return; the command asks for no frames."""
    monkeypatch.setattr(terminal, "READ_S", 0.01)
    out = io.StringIO()
    watch = TerminalWatch(str(offered.path), out, SystemClock())
    watch.step()
    offered.turns(3)
    for _ in range(3):
        watch.step()
    assert all(reader.frames_hz == 0 for reader in offered.feed._readers.values())
    offered.feed.answered(OK)
    offered.turns(2, replace(HEALTH, sweeping=True, ready=False))
    for _ in range(3):
        watch.step()
    offered.feed.stopping()
    for _ in range(3):
        watch.step()
    lines = out.getvalue().splitlines()
    assert re.match(r"box \d+: palpate 4x4 uint8 at 750 Hz", lines[0])
    assert "plastic rough" in lines[1]
    assert lines[2:] == ["SWEEPING", "NO FEED: the box is stopping"]
    again = Offered(offered.path)
    again.turns()
    monkeypatch.setattr(terminal, "READ_S", 0.7)  # longer than the wait before another attempt
    watch.step()
    again.turns(3)
    watch.step()
    assert out.getvalue().splitlines()[-1].startswith("box ")
    again.feed.stopping()


def test_what_cannot_be_read_is_said_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A malformed verdict causes one line, and the connection is closed."""
    monkeypatch.setattr(terminal, "READ_S", 0.01)
    offered = Offered(tmp_path / "feed.sock")
    offered.turns()
    out = io.StringIO()
    watch = TerminalWatch(str(offered.path), out, SystemClock())
    watch.step()
    offered.turns(2)
    (reader,) = offered.feed._readers.values()
    reader.put(encode("verdict", {"status": "fine"}))
    offered.feed._let_wait(reader)
    offered.turns(2)
    for _ in range(4):
        watch.step()
    assert "NO FEED: the feed's line verdict is malformed" in out.getvalue()
    offered.feed.stopping()


def test_json_passes_the_lines_on(offered: Offered, monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard output has the same bytes as any reader gets; the reason for a missing box goes to
    standard error."""
    monkeypatch.setattr(terminal, "READ_S", 0.01)
    peer: list[FeedPeer] = [offered.peer()]
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
    assert got[2] in peer[0].lines()
    assert set(said) == {""}
    pass_on(str(offered.path) + "x", out, SystemClock(), iter([False, True]).__next__, said.append)
    assert "no palpate offers its feed there" in said[-1]


def test_a_feed_that_is_off_cannot_be_watched(capsys: pytest.CaptureFixture[str]) -> None:
    """The message names the setting."""
    assert main(["watch", "--set", "store.runtime="]) == ConfigError.exit_code
    assert 'store.runtime = "" turns the feed off' in capsys.readouterr().err


def test_the_skins_of_all_fingers_are_drawn(tmp_path: Path):
    """Each above its own lowest counts, side by side in the order of their first frames."""
    box = WatchedBox()
    for line in lines_of(tmp_path):
        if line["type"] in ("hello", "health"):
            box.take(line)
    low, high = [[10, 20], [30, 40]], [[11, 22], [33, 44]]
    box.take({"type": "frame", "time_ns": 1, "taxels": low, "finger": "left"})
    box.take({"type": "frame", "time_ns": 1, "taxels": [[5, 5, 5]], "finger": "right"})
    box.take({"type": "frame", "time_ns": 2, "taxels": high, "finger": "left"})
    box.take({"type": "frame", "time_ns": 2, "taxels": [[5, 6, 7]], "finger": "right"})
    assert box.load == ([[1, 2], [3, 4]], [[0, 1, 2]])
    assert box.full == 4
    drawn = picture(box, 0, 100, 30, colours=False)
    assert len(drawn) > 5
