"""Errors that pass, and a service that waits for an address."""

from __future__ import annotations

import errno
import socket
from itertools import pairwise

import pytest

from palpate.core import errors, retry
from palpate.core.clock import SystemClock
from palpate.core.errors import AddressError, ConfigError
from palpate.sim.rig import VirtualClock
from palpate.web.access import Access
from palpate.web.server import PageServer

SECOND = 1_000_000_000


def refusing(times: int):
    """A function that raises AddressError this many times, and the times of its calls."""
    clock, calls = VirtualClock(), list[int]()

    def make() -> str:
        calls.append(clock.now_ns())
        if len(calls) <= times:
            raise AddressError("port 1502 is in use")
        return "open"

    return clock, calls, make


def test_a_service_tries_again_with_a_growing_pause(monkeypatch, logged):
    """The pause doubles up to a minute; the log has one line."""
    monkeypatch.setattr(retry, "in_journal", lambda: True)
    clock, calls, make = refusing(9)
    assert retry.retried(make, clock) == "open"
    pauses = [(b - a) / SECOND for a, b in pairwise(calls)]
    assert pauses == [1, 2, 4, 8, 16, 32, 60, 60, 60]
    assert len(logged) == 1


def test_only_a_service_waits_for_errors_that_pass():
    """A full disk, a port in use, a missing address; a person hears at once."""
    clock, calls, make = refusing(1)
    with pytest.raises(AddressError):
        retry.retried(make, clock)
    assert len(calls) == 1
    passing = [OSError(n, "") for n in (errno.ENOSPC, errno.EMFILE, errno.EIO, errno.ENOMEM)]
    staying = [OSError(n, "") for n in (errno.ENOENT, errno.EACCES, errno.EROFS)]
    assert all(map(errors.passes, passing))
    assert not any(map(errors.passes, [*staying, ValueError("x")]))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for access in (Access(taken.getsockname()[1]), Access(0, "192.0.2.7")):
            with pytest.raises(AddressError) as e:
                PageServer("watch.html", access, SystemClock().now_ns)
            assert e.value.exit_code == 69
    with pytest.raises(ConfigError):
        PageServer("watch.html", Access(70_000), SystemClock().now_ns)


def test_a_stop_ends_the_wait(monkeypatch):
    """A service that waits ends within a step when it is stopped."""
    monkeypatch.setattr(retry, "in_journal", lambda: True)
    clock, _, make = refusing(99)
    end_ns = clock.now_ns() + 3 * SECOND
    with pytest.raises(AddressError):
        retry.retried(make, clock, lambda: clock.now_ns() > end_ns)
    assert clock.now_ns() - end_ns < SECOND


def test_how_a_command_ends():
    """docs/reference/exit-codes.md has these numbers."""
    codes = {
        1: [errors.ApplianceError],
        65: [errors.FormatError],
        69: [
            errors.SensorError,
            errors.LineError,
            errors.PortError,
            AddressError,
            errors.FeedError,
        ],
        70: [errors.ModelError],
        75: [errors.TemporaryError],
        78: [ConfigError, errors.BundleError],
    }
    assert {code: {kind.exit_code for kind in kinds} for code, kinds in codes.items()} == {
        code: {code} for code in codes
    }
