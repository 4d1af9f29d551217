"""The wall clock, for dates that people read. A box without a network may have a wrong one. Nothing
is decided by it: times that are compared come from `clock`."""

from datetime import UTC, datetime, time, timedelta


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


def read(text: str) -> float:
    """Seconds since 1970 of a date and time as text; without a zone it is in UTC. Raises
    ValueError or OverflowError."""
    return seconds_of(datetime.fromisoformat(text))


def of(at_s: float, to: str = "seconds") -> str:
    """Seconds since 1970 as a date and time of this computer's zone, to the second."""
    return datetime.fromtimestamp(at_s).astimezone().isoformat(" ", to)


def last_s(times: str, days: int = 0) -> float:
    """When the last of these times of day was, such as "06:00 14:00", in this computer's zone, less
    a number of days; in seconds since 1970. Raises ValueError for other texts."""
    now = datetime.now()  # without a zone: another day can have another offset from UTC
    begins = [now.replace(hour=0, minute=0, second=0, microsecond=0)]
    if times.split():
        found = [time.fromisoformat(one) for one in times.split()]
        begins = [begins[0].replace(hour=one.hour, minute=one.minute) for one in found]
    day = timedelta(days=1)
    return (max(one if one <= now else one - day for one in begins) - days * day).timestamp()
