"""The wall clock, for dates that people read. A box without a network may have a wrong one. Nothing
is decided by it: times that are compared come from `clock`."""

from datetime import UTC, datetime


def date() -> str:
    """Date and time in UTC, to the second: "2026-11-26T09:05:00+00:00"."""
    return datetime.now(UTC).isoformat(timespec="seconds")
