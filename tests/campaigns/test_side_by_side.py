"""The measurement of a box with everything attached and attacked: its judgement, its shared line,
its attackers."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.tools import pseudo_terminal
from tests.campaigns.feed_readers import PAUSE_S
from tests.factories.bridges import LONG_S, bridge
from tests.factories.speaking_box import SpeakingBox, state
from tests.robots import attackers, side_by_side
from tests.robots.shared_line import SharedLine
from tests.robots.side_by_side import worse

GOOD: dict[str, Any] = {
    "frames_lost": 0,
    "sentences_dropped": 0,
    "faults": {},
    "share": 0.05,
    "before_mib": 66.0,
    "most_mib": 66.5,
    "answers": 9,
    "seconds": 30,
    **{f"{name}_ms": {"p50": 1.0, "p99": 2.0, "max": 3.0} for name in ("edge", "latency", "way")},
}


def test_a_box_that_fared_alike_is_no_worse():
    """Also if both lost a frame because of the machine."""
    assert worse({"alone": GOOD, "attacked": GOOD}) == []
    lossy = GOOD | {"frames_lost": 6}
    assert worse({"alone": lossy, "attacked": lossy}) == []


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ({"frames_lost": 6}, "6 frames lost, alone 0"),
        ({"sentences_dropped": 1}, "1 sentences dropped"),
        ({"faults": {"sweeps without an answer": 1}}, "{'sweeps without an answer': 1}, alone {}"),
        ({"share": 0.0801}, "8.01 % of a core, alone 5.00 %"),
        ({"most_mib": 68.1}, "68.1 MiB, before 66.0"),
        ({"latency_ms": {"p50": 2.1, "p99": 3.0, "max": 3.0}}, "latency_ms 2.1 ms, alone 1.0"),
        ({"way_ms": {"p50": 2.1, "p99": 3.0, "max": 3.0}}, "way_ms 2.1 ms, alone 1.0"),
    ],
)
def test_what_is_worse_is_named(bad: dict[str, Any], said: str):
    """Each target by itself, with both figures."""
    assert worse({"alone": GOOD, "attacked": GOOD | bad}) == [said]


def test_the_table_has_both_boxes_and_the_peers():
    """A row each; the number of attacks, and the answers that good peers got."""
    peers = {
        "tcp": {"attempts": 1500, "answers of the bridge": 20},
        "feed": {"attempts": 7, "hello": 8},
    }
    content = {"machine": "m", "real_time": True, "load": 1.0, "commit": "c" * 40, "peers": peers}
    text = side_by_side.table(
        content | {"boxes": {"alone": deepcopy(GOOD), "attacked": GOOD | {"frames_lost": 3}}}
    )
    assert "| nothing attached | 0 | 9 | 1.0 / 2.0 / 3.0 ms |" in text
    assert "| page, TCP, Modbus and feed, all attacked | 3 | 9 |" in text
    assert text.endswith(
        "connections: tcp 1,500, feed 7. Meanwhile one good peer of each got answers: tcp 20."
    )


def test_the_shared_line_carries_both_ways():
    """The box's sentences are noted and reach the bridge's end; the bridge's bytes reach the box; a
    line without a bridge is not a fault."""
    shared = SharedLine()
    with pseudo_terminal.pair() as (far, near), pseudo_terminal.pair() as (here, there):
        shared._far, shared._bridge, shared.line = far, here, there
        shared._box, shared._robot = (
            SimpleNamespace(poll=lambda: None),
            SimpleNamespace(hear=lambda *_: None),
        )
        box, peer = (os.open(name, os.O_RDWR | os.O_NOCTTY) for name in (near, there))
        os.write(box, state())
        assert [line for _, line in shared.heard(LONG_S)] == [state().decode().strip()]
        assert os.read(peer, 4096) == state()
        os.write(peer, b"$PPLP,ID\r\n")
        assert shared.heard(LONG_S) == []
        assert os.read(box, 4096) == b"$PPLP,ID\r\n"
        for _ in range(200):  # more bytes than a pseudo-terminal holds
            os.write(box, state())
            assert len(shared.heard(LONG_S)) == 1
        for end in (box, peer):
            os.close(end)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tcp", "modbus"])
def test_attackers_attack_and_the_good_one_is_served(kind: str, tmp_path: Path):
    """Floods, noise, endless lines, a storm of connections: a good peer gets answers nevertheless,
    and the bridge goes on."""
    seen: Counter[str] = Counter()
    with SpeakingBox(tmp_path / "line") as box, bridge(kind, "--port", box.path) as address:
        acts = attackers.acts(kind, address, seen)
        end_s = time.monotonic() + 4 * LONG_S
        while seen["answers of the bridge"] <= 3 or seen["attempts"] <= 300:
            assert time.monotonic() < end_s, seen
            for act in acts:
                act()
            threading.Event().wait(PAUSE_S)
    assert seen["answers of the bridge"] > 3
    assert seen["attempts"] > 300
    assert not {heard.kind for heard in box.heard} & {"START", "ABORT"}
