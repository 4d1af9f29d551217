"""The findings of the feed's campaign: each target is missed by invented figures, the packet's
phase, and readers that behave as described."""

from __future__ import annotations

import copy
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.campaigns import feed_inside, feed_load, feed_readers
from tests.campaigns.feed_load import PACKET, Kind
from tests.factories.feeds import OK, Offered, frames

RATE = 750.0


def kind(share: float, late_ms: float = 1.0, **more: object) -> Kind:
    """Fifteen turns with forty answers, each this much later than the packet with its stop edge."""
    stops = np.arange(1000, 1000 + 40 * 2587, 2587)
    seen_s = (np.ceil((stops - 4) / PACKET) * PACKET + 4) / RATE
    answers = [(float(s) + late_ms / 1e3, int(stop)) for s, stop in zip(seen_s, stops, strict=True)]
    values = {
        "wall_s": 300.0,
        "cpu_s": 300 * share,
        "shares": [share] * 15,
        "rss_kib": [70_000],
        "answers": answers,
        "latency_ms": [1.2] * 40,
        "way_ms": [0.5] * 40,
    }
    return Kind(**(values | more))


@pytest.fixture
def kinds() -> dict[str, Kind]:
    """A campaign in which all is well."""
    return {"0": kind(0.05, 0.5), "1": kind(0.052), "64": kind(0.057, 1.2), "attacked": kind(0.059)}


def test_a_campaign_in_which_all_is_well_misses_nothing(kinds: dict[str, Kind]) -> None:
    """The given differences come back, the quickest answer is zero, and each kind has its row."""
    figures = feed_load.result(kinds, 69_000)
    assert feed_load.missed(figures) == []
    assert figures["64"]["share_more"] == pytest.approx([0.007] * 3)
    assert figures["64"]["late_ms"]["p50"] == pytest.approx(0.7, abs=0.01)
    assert figures["0"]["late_ms"] == {"p50": 0.0, "p99": 0.0}
    assert figures["1"]["memory_mib"] == 0.98
    content = {"machine": "m", "real_time": True, "load": 1.5, "commit": "abc", "readers": figures}
    rows = feed_load.table(content).splitlines()
    assert len(rows) == 4 + len(kinds)
    assert (
        "300 s of each kind in turns of 20 s, on m, with real-time priority; load average 1.5"
        in rows[0]
    )
    assert "+0.70 % [+0.70, +0.70]" in rows[6]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"shares": [0.07] * 15}, "2.00 % of a core at least"),
        ({"inside_s": 3.3}, "1.10 % of a core in the feed"),
        ({"rss_kib": [70_000, 73_000]}, "3.91 MiB more"),
        ({"lost": 3}, "3 frames lost"),
        ({"dropped": 1}, "1 sentences dropped"),
        ({"faults": Counter({"sweeps without an answer": 2})}, "sweeps without an answer"),
    ],
)
def test_each_target_can_be_missed(
    kinds: dict[str, Kind], change: dict[str, object], what: str
) -> None:
    """Only the kind with the fault is named."""
    worse = copy.deepcopy(kinds)
    worse["attacked"] = kind(0.059, **change)
    (found,) = feed_load.missed(feed_load.result(worse, 69_000))
    assert found.startswith("attacked: ")
    assert what in found


def test_later_answers_are_found(kinds: dict[str, Kind]) -> None:
    """A median that is two milliseconds later."""
    kinds["1"] = kind(0.052, 2.5)
    assert feed_load.missed(feed_load.result(kinds, 69_000)) == ["1: 2.00 ms later in the median"]


def test_what_the_loop_spends_in_the_feed_is_counted(tmp_path: Path) -> None:
    """The time in all calls, without the time between them; a call that fails counts too."""

    class Costly:
        def turn(self, numbers: int) -> None:
            sum(range(numbers))
            if numbers == 3:
                raise ValueError(numbers)

        frames = answered = sweep = turn

    path = tmp_path / "ns"
    feed_inside.count(path, Costly)
    before_ns = time.thread_time_ns()
    sum(range(1_000_000))
    assert feed_inside.spent_ns(path) == 0
    costly = Costly()
    costly.turn(1_000_000)
    first_ns = feed_inside.spent_ns(path)
    costly.answered(1_000_000)
    both_ns = feed_inside.spent_ns(path)
    assert 0 < first_ns < both_ns < time.thread_time_ns() - before_ns
    with pytest.raises(ValueError, match="3"):
        costly.turn(3)
    assert feed_inside.spent_ns(path) > both_ns


@pytest.mark.parametrize("name", ["1", "8"])
def test_readers_read_all_but_one_of_them(tmp_path: Path, name: str) -> None:
    """Each reader that reads gets frames, verdicts and its hello."""
    offered, seen = Offered(tmp_path / "feed.sock"), Counter[str]()
    offered.turns()
    acts = feed_readers.acts(name, str(offered.path), seen)
    for i in range(60):
        for act in acts:
            act()
        offered.feed.frames(frames(first=6 * i))
        if i == 40:
            offered.feed.answered(OK)
        offered.turns()
    reading = max(1, int(name) - 1)
    assert len(offered.feed._readers) == int(name)
    assert seen["hello"] == seen["verdict"] == reading
    assert seen["frame"] > 10 * reading
    offered.feed.stopping()


def test_attackers_attack_and_the_good_ones_are_served(tmp_path: Path) -> None:
    """Wrong requests, floods and a storm of connections: eight readers get their lines
    nevertheless."""
    offered, seen = Offered(tmp_path / "feed.sock"), Counter[str]()
    offered.turns()
    acts = feed_readers.acts("attacked", str(offered.path), seen)
    for i in range(600):
        for act in acts:
            act()
        if i > 500:
            offered.feed.answered(OK)
        offered.turns()
    assert seen["hello"] == 8
    assert seen["verdict"] > 8 * 80
    assert seen["attempts"] > 100
    assert len(offered.feed._readers) <= 64
    offered.feed.stopping()
