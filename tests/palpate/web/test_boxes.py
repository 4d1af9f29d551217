"""The list of a site's other boxes."""

from __future__ import annotations

from palpate.core.errors import ConfigError
from palpate.service import network
from palpate.service.network import Reachable
from palpate.sim.rig import VirtualClock
from palpate.web.web import KEPT_NS, OtherBoxes


def test_pages_of_other_boxes_are_listed_once_a_minute(monkeypatch):
    """Not this box or a bridge; none without zeroconf."""
    own, asked, clock = network.box_id(), [], VirtualClock()
    there = [
        Reachable(f"here-{own}", "page", "10.0.0.1", 8137),
        Reachable("cell-7-abc", "modbus", "10.0.0.7", 1502),
        Reachable("cell-7-abc", "page", "10.0.0.7", 8137),
        Reachable("cell-7-abc", "page", "10.0.0.7", 8138),
        Reachable("cell-8-def", "page", "fd00::8", 8137),
    ]
    monkeypatch.setattr(network, "found", lambda clock: asked.append(1) or there)
    boxes = OtherBoxes(clock)
    for _ in range(2):
        assert [one["address"] for one in boxes()] == [
            "https://10.0.0.7:8137/",
            "https://[fd00::8]:8137/",
        ]
    assert len(asked) == 1

    def missing(clock: object) -> list[Reachable]:
        raise ConfigError("no zeroconf; install it")

    monkeypatch.setattr(network, "found", missing)
    assert len(boxes()) == 2
    clock.sleep_until(clock.now_ns() + KEPT_NS)
    assert boxes() == []
