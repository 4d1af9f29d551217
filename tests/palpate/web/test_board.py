"""The content of the page from lines of the feed: published events, kept events, refused lines."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.core.status import REASONS
from palpate.web.board import SWEEPS, PageBoard
from tests.factories import feed_lines


class Events:
    """The published events of a board."""

    def __init__(self) -> None:
        self.all: list[tuple[str, Any]] = []

    def __call__(self, name: str, content: object) -> None:
        """Take an event, which must be JSON."""
        self.all.append((name, json.loads(json.dumps(content, allow_nan=False))))

    def of(self, name: str) -> list[Any]:
        """The contents of the events of a name."""
        return [content for one, content in self.all if one == name]


@pytest.fixture
def events() -> Events:
    """The events of the board."""
    return Events()


@pytest.fixture
def board(events: Events) -> PageBoard:
    """A board that has a connection."""
    one = PageBoard(events)
    one.take(feed_lines.hello())
    one.take(feed_lines.health(1.0))
    return one


def frames(board: PageBoard, at_s: float, row: float, col: float, strength: float = 120.0) -> None:
    """Half a second of frames, 20 a second."""
    for i in range(10):
        board.take(feed_lines.frame(at_s + i / 20, feed_lines.load(row, col, strength)))


def test_the_first_lines_say_what_box_it_is(board, events):
    """The page gets the box's presence, its labels and its state."""
    assert events.of("box") == [{"there": True, "why": ""}]
    assert events.of("hello")[0]["labels"] == list(feed_lines.LABELS)
    told = feed_lines.health(1.0)
    shown = events.of("health")[0]
    assert [shown[name] for name in ("trial", "ready", "lost_frames")] == [
        told[name] for name in ("trial", "ready", "lost_frames")
    ]


def test_people_read_display_names(events):
    """The labels stay; names beside them are those of the bundle, and labels where it has none."""
    board = PageBoard(events)
    board.take(feed_lines.hello(displays={"wood": "Holz, geölt", "gone": "weg"}))
    for number, label in enumerate(("wood", "metal"), 1):
        board.take(feed_lines.verdict(number, float(number), label))
    board.take(feed_lines.verdict(3, 3.0, status="gap"))
    (hello,) = events.of("hello")
    assert hello["labels"] == list(feed_lines.LABELS)
    assert hello["names"] == ["metal", "Holz, geölt", *feed_lines.LABELS[2:]]
    shown = [(one["label"], one["name"]) for one in events.of("verdict")]
    assert shown == [("wood", "Holz, geölt"), ("metal", "metal"), ("", "")]


@pytest.mark.parametrize("status", ["ok", "unsure", "unknown", "gap", "sensor-lost"])
def test_a_verdict_comes_with_its_probabilities_or_its_reason(board, events, status):
    """Rounded probabilities of all labels, else the reason and the remedy."""
    board.take(feed_lines.verdict(7, 2.0, "wood", status))
    (shown,) = events.of("verdict")
    assert shown["pid"] == 71
    assert shown["reason"] == REASONS.get(status, "")
    assert bool(shown["reason"]) != bool(shown["label"])
    if shown["label"]:
        assert shown["scores"][feed_lines.LABELS.index("wood")] == pytest.approx(
            shown["probability"], abs=1e-4
        )
    assert "own" not in shown


def test_frames_become_the_view_of_palpate_align(board, events):
    """Load, centre and way back, at most five times a second."""
    frames(board, 2.0, 0.7, 1.5, 0)
    assert events.of("view")[-1]["state"] == "no-contact"
    frames(board, 3.0, 0.7, 1.5)
    view = events.of("view")[-1]
    assert view["state"] == "off"
    assert view["message"].endswith("towards row 1")
    assert view["fingertip"] == "first-row"
    assert np.shape(view["load"]) == (4, 4)
    assert view["centre"][0] == pytest.approx(4 * 0.7, abs=0.6)
    numbers = [one["number"] for one in events.of("view")]
    assert numbers == sorted(set(numbers))
    assert len(numbers) <= 6


def test_without_a_bundle_the_picture_has_no_positions(events):
    """Without a bundle, as in `palpate record`, the picture has the load and the centre alone."""
    board = PageBoard(events)
    board.take(
        {name: value for name, value in feed_lines.hello(bundle="").items() if name != "alignment"}
    )
    board.take(feed_lines.state())
    rng = np.random.default_rng(1)
    for i in range(40):
        board.take(
            feed_lines.frame(
                i / 20, np.round(feed_lines.load(0, 0, 0) + rng.integers(0, 2, (4, 4)))
            )
        )
    frames(board, 3.0, 1.5, 1.5)
    assert events.of("view")[-1]["state"] == "no-positions"


def test_a_skin_that_goes_is_shown_and_later_lines_are_passed_over(board, events):
    """Another skin has its own lowest value; unknown lines change nothing."""
    frames(board, 2.0, 1.5, 1.5)
    board.take(feed_lines.state("absent", "check the cable"))
    wanted = feed_lines.state("absent", "check the cable")
    assert events.of("state")[-1] | {"type": "state"} == wanted
    view = events.of("view")[-1]
    assert (view["state"], view["hint"]) == ("no-skin", "check the cable")
    board.take(feed_lines.state())
    board.take(feed_lines.frame(9.0, feed_lines.load(1.5, 1.5)))
    assert events.of("view")[-1]["state"] == "wait"
    before = len(events.all)
    board.take({"type": "weather", "sun": True})
    board.take({"type": "lost", "lines": 7})
    board.take({})
    assert len(events.all) == before
    board.take(feed_lines.health(2.0, later=1))
    assert events.of("health")[-1]["later"] == 1


def test_loss_is_counted_by_the_minute_and_late_sweeps_are_kept(board, events):
    """Not over a restart; sweeps by a number of their own."""
    for at_s in range(2, 125):
        board.take(feed_lines.health(float(at_s), lost_frames=3 if at_s > 70 else 0))
    assert [(one["frames"], one["lost"]) for one in events.of("minute")] == [
        (45_000, 0),
        (45_000, 3),
    ]
    board.away("the box has ended")
    board.take(feed_lines.hello(pid=72))
    for at_s in range(200, 262):
        board.take(feed_lines.health(float(at_s), frames=750 * (at_s - 200), lost_frames=1, pid=72))
    assert (events.of("minute")[-1]["frames"], events.of("minute")[-1]["lost"]) == (45_000, 0)
    for number in range(SWEEPS + 3):
        board.take(feed_lines.sweep(number))
    numbers = [one["number"] for one in events.of("signal")]
    assert numbers == list(range(1, SWEEPS + 4))
    assert board.sweep("3") is None
    assert board.sweep("4")["sweep"] == 3
    assert board.sweep(str(SWEEPS + 4)) is None


def test_a_restart_is_noted_with_what_has_changed(board, events):
    """A note with the new bundle; a cut connection makes none."""
    board.away("the connection was cut")
    assert events.of("box")[-1] == {"there": False, "why": "the connection was cut"}
    board.take(feed_lines.hello())
    board.take(feed_lines.health(5.0))
    assert events.of("note") == []
    board.take(feed_lines.hello(pid=72, bundle="aaaa0001"))
    board.take(feed_lines.health(9.0, pid=72))
    board.take(feed_lines.health(10.0, pid=72))
    (note,) = events.of("note")
    assert note["time_ns"] == 9 * feed_lines.SECOND
    assert re.search("aaaa0001.* 9f3c2a1b", note["text"])


HELLO, SWEEP = feed_lines.hello(), feed_lines.sweep(1)


@pytest.mark.parametrize(
    "line",
    [
        {"type": "hello"},
        HELLO | {"format": {"rows": 0}},
        HELLO | {"format": "4x4"},
        HELLO | {"frames_hz": "many"},
        HELLO | {"alignment": {"contact": 5.0}},
        HELLO | {"alignment": HELLO["alignment"] | {"unloaded": [[0.0]]}},
        HELLO | {"alignment": HELLO["alignment"] | {"place": {"pitch_mm": -4.0}}},
        {"type": "health", "skin": "streaming"},
        feed_lines.health(1.0) | {"frames": "many"},
        {"type": "state"},
        {"type": "verdict", "sweep": 1},
        feed_lines.verdict(1, 1.0) | {"scores": ["high"]},
        {"type": "frame", "time_ns": 1, "taxels": [[1, 2], [3]]},
        {"type": "frame", "time_ns": 1, "taxels": [[1, 2], [3, 4]]},
        {"type": "frame", "time_ns": None, "taxels": [[0] * 4] * 4},
        SWEEP | {"data": "###"},
        SWEEP | {"data": SWEEP["data"][:-8]},
        SWEEP | {"dtype": "object"},
        SWEEP | {"shape": [1500, 4]},
        SWEEP | {"shape": [-1, 4, 4]},
        SWEEP | {"shape": [0, 4, 4], "data": ""},
    ],
)
def test_a_line_that_is_not_as_it_must_be_is_refused(board, line):
    """The error names the type and the remedy; the board continues with the next line."""
    with pytest.raises(FormatError, match=f"{line['type']}.*update"):
        board.take(line)
    board.take(HELLO)
    board.take(feed_lines.health(3.0))
    frames(board, 4.0, 1.5, 1.5)
