"""The wall clock, for dates that people read. A box without a network may have a wrong one. Nothing
is decided by it: times that are compared come from `clock`."""

from datetime import UTC, datetime


def seconds() -> float:
    """Seconds since 1970."""
    return datetime.now(UTC).timestamp()


def date() -> str:
    """Date and time in UTC, to the second: "2026-11-26T09:05:00+00:00"."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def utc(at_s: float | None = None) -> datetime:
    """Seconds since 1970, or now, as a date and time in UTC."""
    return datetime.now(UTC) if at_s is None else datetime.fromtimestamp(at_s, UTC)


def seconds_of(date: datetime) -> float:
    """Seconds since 1970 of a date; without a zone it is in UTC, as dates of OPC UA are."""
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def of(at_s: float) -> str:
    """Seconds since 1970 as a date and time of this computer's zone, to the second."""
    return datetime.fromtimestamp(at_s).astimezone().isoformat(" ", "seconds")
