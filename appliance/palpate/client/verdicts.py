"""Every verdict of the last 90 days in an SQLite file, which outlives restarts and power cuts.

One process writes (`palpate bridge memory`), any number read. Each verdict is on the disk before
the next is taken; the loop of the box knows nothing of it.
"""

from __future__ import annotations

import math
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

from palpate.core import storage, wall_clock
from palpate.core.errors import FeedError, TemporaryError
from palpate.core.log import log

DAYS, MOST_MIB = 90, 64
"""Older verdicts are deleted, and the oldest of a larger file."""
DAY_S = AHEAD_S = 86_400
"""Verdicts that are a day ahead of now were given while the clock was wrong; less can be a clock
that was set right, in either direction."""
EVERY, OLD = 100, 200
"""Verdicts between two looks at age and size; most verdicts that one look deletes for their age: a
clock that is wrong for a while must not empty the file."""
WAIT_S = 10.0
"""Longest wait for another program that has the file open."""
PART = 1000
"""Verdicts that are read at once."""
COLUMNS = {
    "at": "REAL NOT NULL",
    "sweep": "INTEGER NOT NULL",
    "status": "TEXT NOT NULL",
    "label": "TEXT NOT NULL",
    "probability": "REAL",
    "margin": "REAL",
    "fused": "INTEGER",
    "lost": "INTEGER",
    "latency_ms": "REAL",
    "bundle": "TEXT",
    "detail": "TEXT",
}
"""Columns after `number`, which counts on over restarts. at: seconds since 1970, of this computer's
clock. STRICT: SQLite would take a number of a wrong kind as bytes, which count as 0."""


class VerdictFile:
    """The file at `path`, None for verdicts in memory alone, for its one writer, which locks the
    folder: a second one would write each verdict again. A file that is damaged or of another
    version is moved aside. db: to read with the functions below. Raises TemporaryError if it cannot
    be opened."""

    def __init__(self, path: Path | None, *, most_mib: float = MOST_MIB) -> None:
        self._path, self._most, self._since = path, most_mib * (1 << 20), 0
        with ExitStack() as opened:
            try:
                if path:
                    lock = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
                    opened.callback(os.close, lock)
                    if not storage.locked(lock):
                        raise BlockingIOError("another program writes there")
                self.db = self._open()
            except (OSError, sqlite3.OperationalError) as e:
                why = getattr(e, "strerror", None) or e
                raise TemporaryError(f"{path}: {why}; name a file in a folder of your own") from e
            except sqlite3.DatabaseError as e:
                self.db = self._anew(e)
            self._opened = opened.pop_all()

    def close(self) -> None:
        self.db.close()
        self._opened.close()

    def add(self, at_s: float, verdict: Mapping[str, Any]) -> None:
        """Write a verdict. at_s: seconds since 1970. Raises sqlite3.Error, such as for a full
        disk; then it is not written."""
        if self._path and not self._path.exists():  # somebody has taken it away
            self.db.close()
            self.db = self._open()
        values = [at_s, *(verdict.get(name) for name in COLUMNS if name != "at")]
        try:
            self._insert(values)
        except sqlite3.DatabaseError as e:
            if type(e) is not sqlite3.DatabaseError:  # this verdict, or the disk
                raise
            self.db.close()
            self.db = self._anew(e)
            self._insert(values)
        self._since += 1
        if self._since >= EVERY:
            with suppress(sqlite3.OperationalError):  # a full disk: with the next verdict
                self.trim(at_s)
                self._since = 0

    def trim(self, now_s: float) -> None:
        """Delete old verdicts, and the oldest of a file that is too large."""
        with self.db:
            old = "SELECT number FROM verdicts WHERE at < ? ORDER BY number LIMIT ?"
            limits = [now_s - DAYS * DAY_S, OLD]
            self.db.execute(f"DELETE FROM verdicts WHERE number IN ({old})", limits)
            if self._size() > self._most:
                tenth = "SELECT min(number) + (max(number) - min(number)) / 10 FROM verdicts"
                self.db.execute(f"DELETE FROM verdicts WHERE number <= ({tenth})")

    def _insert(self, values: list[Any]) -> None:
        names, marks = ", ".join(COLUMNS), ", ".join("?" * len(COLUMNS))
        with self.db:
            self.db.execute(f"INSERT INTO verdicts ({names}) VALUES ({marks})", values)

    def _anew(self, why: sqlite3.DatabaseError) -> sqlite3.Connection:
        """Keep the file under another name, and open a new file. Raises sqlite3.DatabaseError."""
        path = self._path
        if path is None:
            raise why
        aside = path.with_suffix(".damaged")
        log.warning(f"{path}: {why}; it is kept as {aside}, and a new one begins")
        path.rename(aside)
        for end in ("-wal", "-shm"):
            path.with_name(path.name + end).unlink(missing_ok=True)
        return self._open()

    def _size(self) -> int:
        """Bytes of the pages in use."""
        pages, free, size = (
            int(self.db.execute(f"PRAGMA {name}").fetchone()[0])
            for name in ("page_count", "freelist_count", "page_size")
        )
        return (pages - free) * size

    def _open(self) -> sqlite3.Connection:
        """Raises sqlite3.DatabaseError."""
        # psow=0: a power cut in a write may spoil its whole sector, and with it the end of the
        # verdict before; so SQLite fills the sector
        url = f"{self._path.absolute().as_uri() if self._path else 'file::memory:'}?psow=0"
        db = sqlite3.connect(url, timeout=WAIT_S, uri=True, check_same_thread=False)
        try:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            db.execute(f"PRAGMA journal_size_limit = {4 << 20}")
            columns = ", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())
            number = "number INTEGER PRIMARY KEY AUTOINCREMENT"
            there = [name for _, name, *_ in db.execute("PRAGMA table_info(verdicts)")]
            if there and there != ["number", *COLUMNS]:
                raise sqlite3.DatabaseError("it has the columns of another version")
            with db:
                db.execute(f"CREATE TABLE IF NOT EXISTS verdicts ({number}, {columns}) STRICT")
                db.execute("CREATE INDEX IF NOT EXISTS by_time ON verdicts (at)")
            if (found := db.execute("PRAGMA quick_check").fetchone()[0]) != "ok":
                raise sqlite3.DatabaseError(str(found))
        except BaseException:
            db.close()
            raise
        return db


Source = Path | sqlite3.Connection
"""A file of verdicts, or a database that is open in this process."""


def dated(line: Mapping[str, Any], now_ns: int) -> tuple[float, dict[str, Any]]:
    """When the verdict of a line of the feed was given, in seconds since 1970, and its columns.
    now_ns: by the clock of the feed. Raises KeyError or TypeError for a line of a later version."""
    age_s = (now_ns - line["time_ns"]) / 1e9
    return wall_clock.seconds() - age_s, {**line, "latency_ms": line["latency_ns"] / 1e6}


def since(
    source: Source, from_s: float, most: int = -1, *, to_s: float = math.inf
) -> Iterator[dict[str, Any]]:
    """The first `most` verdicts from this time on, in order; -1: all. to_s: none after it, such as
    of a clock that was wrong. Raises FeedError if the file cannot be read."""
    # +at: by number, so that each part goes on where the last one ended
    where = f"number > ? AND +at BETWEEN ? AND ? ORDER BY number LIMIT {PART}"
    query, last = f"SELECT number, {', '.join(COLUMNS)} FROM verdicts WHERE {where}", 0
    while rows := _rows(source, query, [last, from_s, to_s]):
        for row in rows:
            if most == 0:
                return
            most -= 1
            yield dict(zip(("number", *COLUMNS), row, strict=True))
        last = rows[-1][0]


def counts(source: Source, from_s: float, to_s: float = math.inf) -> dict[tuple[str, str], int]:
    """The number of verdicts between these times by status and label. Raises FeedError."""
    where = "WHERE at BETWEEN ? AND ? GROUP BY 1, 2 ORDER BY 1, 2"
    query = f"SELECT status, label, count(*) FROM verdicts {where}"
    return {(status, label): n for status, label, n in _rows(source, query, [from_s, to_s])}


def trend(
    source: Source, from_s: float, to_s: float, width_s: float
) -> list[tuple[int, int, int, int]]:
    """For each span of width_s between these times with verdicts: its index, and the number of all
    verdicts, of unsure ones and of unknown ones. Raises FeedError."""
    sums = "count(*), sum(status = 'unsure'), sum(status = 'unknown')"
    span = f"SELECT CAST((at - ?) / ? AS INTEGER), {sums} FROM verdicts"
    where = "WHERE at BETWEEN ? AND ? GROUP BY 1 ORDER BY 1"
    return _rows(source, f"{span} {where}", [from_s, width_s, from_s, to_s])


def _rows(source: Source, query: str, values: list[float]) -> list[tuple[Any, ...]]:
    if isinstance(source, sqlite3.Connection):
        return source.execute(query, values).fetchall()
    # after a clean end only `immutable` reads a file in a folder of another user
    ways = ("mode=ro", "mode=ro&immutable=1")
    why: object = "there is no such file"
    for way in ways if source.exists() else ():
        try:
            with closing(
                sqlite3.connect(f"{source.absolute().as_uri()}?{way}", timeout=WAIT_S, uri=True)
            ) as db:
                return db.execute(query, values).fetchall()
        except sqlite3.Error as e:
            why = e
    raise FeedError(
        f"{source}: {why}; verdicts are kept while palpate-bridge@memory runs (systemctl enable"
        " --now palpate-bridge@memory), for members of group palpate"
    )
