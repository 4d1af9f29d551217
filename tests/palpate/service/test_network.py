"""Boxes on the network: found by name and address, and nothing announced that is not open."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import Self

import pytest

from palpate.core.clock import SystemClock
from palpate.service import network
from palpate.sim.rig import VirtualClock

pytest.importorskip("zeroconf", reason="palpate[found] is not installed")


@pytest.fixture
def open_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loopback addresses play the network."""
    monkeypatch.setattr(network, "local", lambda host: False)


@pytest.mark.slow
@pytest.mark.usefixtures("open_loopback")
def test_two_boxes_of_one_name(monkeypatch):
    """Each is found at its own address, with all that is open."""
    kinds = (("page", 8137), ("opcua", 4840))
    loopback = ["127.0.0.1", "127.0.0.2"]
    ends = []
    for own, host in zip(("aaaaaa", "bbbbbb"), loopback, strict=True):
        monkeypatch.setattr(network, "box_id", lambda own=own: own)
        ends += [network.announce(kind, host, port, "line_3") for kind, port in kinds]
    try:
        wanted = {
            network.Reachable(f"line-3-{own}", kind, host, port)
            for own, host in zip(("aaaaaa", "bbbbbb"), loopback, strict=True)
            for kind, port in kinds
        }
        found: set[network.Reachable] = set()
        for _ in range(10):
            found = {*network.found(SystemClock(), loopback)}
            if found >= wanted:
                break
        assert {one for one in found if one.box.startswith("line-3-")} == wanted
    finally:
        for end in ends:
            end()


def test_the_id_is_stable_and_a_closed_box_says_nothing(monkeypatch):
    """Six letters; no socket is opened for an address of this machine alone."""
    monkeypatch.setattr(socket, "socket", None)
    for host in ("127.0.0.1", "::1"):
        assert network.announce("tcp", host, 1503)() is None
    assert network.box_id() == network.box_id()
    assert len(network.box_id()) == 6


def test_a_network_of_hostile_names(monkeypatch):
    """Thousands of names without an address do not hold it up; texts of others cannot change the
    terminal."""
    clock, asked = VirtualClock(), []

    class HostileNetwork:
        def __init__(self, interfaces: object) -> None:
            pass

        def __enter__(self) -> Self:
            return self

        def __exit__(self, *reason: object) -> None:
            pass

        def get_service_info(self, kind: str, name: str, timeout: int) -> object:
            asked.append(name)
            if name.startswith("0"):
                text = {"kind": "page\x1b[2J"}
                return SimpleNamespace(
                    decoded_properties=text, port=1, parsed_addresses=lambda: ["10.0.0.1"]
                )
            clock.sleep_until(clock.now_ns() + 1_000_000 * timeout)
            return None

    def browse(one: HostileNetwork, kind: str, handlers: list) -> None:
        for name in ("0\x1b[31m page", *map("x{}".format, range(5000))):
            handlers[0](one, kind, name, None)

    monkeypatch.setattr("zeroconf.Zeroconf", HostileNetwork)
    monkeypatch.setattr("zeroconf.ServiceBrowser", browse)
    assert network.found(clock) == [network.Reachable("0?[31m", "page?[2J", "10.0.0.1", 1)]
    assert len(asked) < 30
