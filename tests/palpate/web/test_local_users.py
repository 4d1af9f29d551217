"""The page on loopback is for the users who may read the feed."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from http.client import HTTPConnection

import pytest

from palpate.core.clock import SystemClock
from palpate.web import local_users
from palpate.web.access import Access
from palpate.web.server import PageServer


@pytest.fixture
def page() -> Iterator[PageServer]:
    """A page on loopback, at a free port."""
    with PageServer("watch.html", Access(0), SystemClock().now_ns) as made:
        yield made


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_owner_of_a_connection(host):
    """This user for both families, and nobody for a connection that is not there."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with (
        socket.create_server((host, 0), family=family) as listener,
        socket.create_connection(listener.getsockname()[:2]) as client,
    ):
        places = client.getsockname()[:2], client.getpeername()[:2]
        assert local_users.owner(*places) == os.geteuid()
        assert local_users.owner(places[0], (host, 1)) is None


def test_another_user_gets_nothing(page, monkeypatch):
    """Root and this user see the box; the answer to others names the group."""

    def port(page: PageServer) -> int:
        """The port of a page."""
        return int(page.address.rpartition(":")[2])

    def status(page: PageServer, host: str = "127.0.0.1") -> tuple[int, str]:
        """The answer to a request for the page. host: address of the client."""
        asked = HTTPConnection("127.0.0.1", port(page), timeout=60, source_address=(host, 0))
        try:
            asked.request("GET", "/")
            answer = asked.getresponse()
            return answer.status, answer.reason
        finally:
            asked.close()

    assert local_users.may_see(0)
    assert local_users.may_see(os.geteuid())
    assert not local_users.may_see(None)
    assert not local_users.may_see(987_654)
    assert status(page)[0] == 200
    monkeypatch.setattr(local_users, "owner", lambda peer, own: 987_654)
    code, why = status(page)
    assert (code, "group palpate" in why) == (403, True)
