"""Fixtures for the tests of several packages of the box."""

from __future__ import annotations

import pytest

from palpate.bridges import source
from palpate.client import feed, line
from palpate.web import web


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs beside the box that wait hundredths of a second where they wait a second."""
    monkeypatch.setattr(line, "RETRY_S", 0.02)
    monkeypatch.setattr(line, "READ_S", 0.02)
    monkeypatch.setattr(feed, "RETRY_NS", 20_000_000)
    monkeypatch.setattr(web, "READ_S", 0.05)
    monkeypatch.setattr(source, "EVERY_S", 0.05)
