"""The verdicts of a shift, of today or of up to 90 days, as a page shows them: counts, a trend, and
rows as CSV. They come from the file that `palpate bridge memory` writes; without one, from
the verdicts that this program has seen."""

from __future__ import annotations

import csv
import io
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from palpate.client import verdicts
from palpate.client.verdicts import Source, VerdictFile
from palpate.core import wall_clock
from palpate.core.errors import ConfigError, FeedError, FormatError

SHIFT, TODAY = 0, 1
"""Periods; any other number is of days, today included."""
SPAN_S = {SHIFT: 900, TODAY: 3600}
"""Length of a span of the trend; a day where none is given."""
OWN_MIB = 8
"""Most verdicts of this program, some 60,000."""
ROWS = 200
"""Rows of a part of the CSV file."""


class History:
    """Verdicts of the file at `path`. shifts: when shifts begin, such as "06:00 14:00 22:00", in
    this computer's zone. Raises ConfigError if they cannot be read."""

    def __init__(self, path: Path, shifts: str) -> None:
        self._path, self._own = path, VerdictFile(None, most_mib=OWN_MIB)
        self._own_since_s = wall_clock.seconds()
        self._shifts = shifts
        try:
            wall_clock.last_s(shifts)
        except ValueError as e:
            raise ConfigError(f'watch.shifts: {e}; give times such as "06:00 14:00 22:00"') from e

    def take(self, line: Mapping[str, Any], now_ns: int) -> None:
        """Keep the verdict of a line of the feed, if no file does. now_ns: the clock of the feed.
        Raises FormatError for a line of a later version."""
        if self._kept():
            return
        try:
            self._own.add(*verdicts.dated(line, now_ns))
        except (KeyError, TypeError, sqlite3.Error) as e:
            raise FormatError(f"a verdict of the feed is of another version ({e!r}); update") from e

    def counted(self, period: str) -> dict[str, Any]:
        """The figures of a period for a page. from_s: its begin, seconds since 1970. kept_s: since
        when verdicts are kept, null for all of the period. trend: see verdicts.trend. counts: of
        each status and label. Or `why` nothing can be read."""
        source, days = self._source(), int(period)
        from_s, span_s = self._begin_s(days), SPAN_S.get(days, verdicts.DAY_S)
        now_s = wall_clock.seconds()
        try:
            trend = verdicts.trend(source, from_s, now_s + verdicts.AHEAD_S, span_s)
            counts = verdicts.counts(source, from_s, now_s + verdicts.AHEAD_S)
        except FeedError as e:
            return {"why": str(e)}
        return {
            "from_s": from_s,
            "to_s": max([now_s, *(from_s + span_s * n for n, *_ in trend[-1:])]),
            "kept_s": None if source is self._path else self._own_since_s,
            "span_s": span_s,
            "trend": trend,
            "counts": [[status, label, n] for (status, label), n in counts.items()],
        }

    def rows(self, period: str) -> Iterator[str]:
        """The verdicts of a period as parts of a CSV file (RFC 4180)."""
        to_s = wall_clock.seconds() + verdicts.AHEAD_S
        found = verdicts.since(self._source(), self._begin_s(int(period)), to_s=to_s)
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(["number", "time", *list(verdicts.COLUMNS)[1:]])
        for n, row in enumerate(found, 1):
            at = wall_clock.of(row.pop("at"), "milliseconds")
            writer.writerow([row.pop("number"), at, *map(_cell, row.values())])
            if n % ROWS == 0:
                yield text.getvalue()
                text.seek(0)
                text.truncate()
        yield text.getvalue()

    def _source(self) -> Source:
        return self._path if self._kept() else self._own.db

    def _kept(self) -> bool:
        with suppress(OSError):  # a folder that this user may not read
            return self._path.exists()
        return False

    def _begin_s(self, days: int) -> float:
        """When the period began, in seconds since 1970."""
        if days == SHIFT:
            return wall_clock.last_s(self._shifts)
        return wall_clock.last_s("00:00", min(days, verdicts.DAYS) - 1)


def _cell(value: object) -> object:
    """A value that a spreadsheet does not take for a formula."""
    formula = isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r"))
    return f"'{value}" if formula else value
