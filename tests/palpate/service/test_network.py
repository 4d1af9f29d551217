"""Boxes on the network: found by name and address, and nothing announced that is not open."""

from __future__ import annotations

import socket

import pytest

from palpate.core.clock import SystemClock
from palpate.service import network

pytest.importorskip("zeroconf", reason="palpate[found] is not installed")
LOOPBACK = ["127.0.0.1", "127.0.0.2"]


@pytest.fixture
def open_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loopback addresses play the network."""
    monkeypatch.setattr(network, "local", lambda host: False)


@pytest.mark.slow
@pytest.mark.usefixtures("open_loopback")
def test_two_boxes_of_one_name(monkeypatch):
    """Each is found at its own address, with all that is open."""
    ends = []
    for own, host in zip(("aaaaaa", "bbbbbb"), LOOPBACK, strict=True):
        monkeypatch.setattr(network, "box_id", lambda own=own: own)
        ends += [network.announce(kind, host, port, "line_3") for kind, port in KINDS]
    try:
        wanted = {
            network.Reachable(f"line-3-{own}", kind, host, port)
            for own, host in zip(("aaaaaa", "bbbbbb"), LOOPBACK, strict=True)
            for kind, port in KINDS
        }
        found: set[network.Reachable] = set()
        for _ in range(10):
            found = {*network.found(SystemClock(), LOOPBACK)}
            if found >= wanted:
                break
        assert {one for one in found if one.box.startswith("line-3-")} == wanted
    finally:
        for end in ends:
            end()


KINDS = (("page", 8137), ("opcua", 4840))


def test_the_id_is_stable_and_a_closed_box_says_nothing(monkeypatch):
    """Six letters; no socket is opened for an address of this machine alone."""
    monkeypatch.setattr(socket, "socket", None)
    for host in ("127.0.0.1", "::1"):
        assert network.announce("tcp", host, 1503)() is None
    assert network.box_id() == network.box_id()
    assert len(network.box_id()) == 6
