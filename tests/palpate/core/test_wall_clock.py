"""Times of day of this computer's zone, on days when its offset from UTC changes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime

import pytest

from palpate.core import wall_clock


@pytest.fixture
def berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Summer time ends on 25 October 2026 at 3:00."""
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("berlin")
@pytest.mark.parametrize(
    ("times", "days", "began"),
    [
        ("", 0, datetime(2026, 10, 24, 22, tzinfo=UTC)),
        ("00:00", 29, datetime(2026, 9, 25, 22, tzinfo=UTC)),
        ("06:00 14:00", 0, datetime(2026, 10, 25, 5, tzinfo=UTC)),
        ("14:00 22:00", 0, datetime(2026, 10, 24, 20, tzinfo=UTC)),
    ],
)
def test_when_a_day_or_a_shift_began(monkeypatch, times, days, began):
    """By the offset of then, not of now."""

    class Noon(datetime):
        @classmethod
        def now(cls, tz: object = None) -> datetime:
            return datetime(2026, 10, 25, 12)

    monkeypatch.setattr(wall_clock, "datetime", Noon)
    assert wall_clock.last_s(times, days) == began.timestamp()
