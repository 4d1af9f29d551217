"""The file of verdicts: a killed writer, limits, damage, and readers during writing."""

from __future__ import annotations

import math
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from palpate.bridges.memory import MemoryBridge
from palpate.cli.main import main
from palpate.client.feed import Feed
from palpate.client.verdicts import AHEAD_S, DAY_S, DAYS, EVERY, OLD, VerdictFile, counts, since
from palpate.core.clock import SystemClock
from palpate.core.errors import FeedError, TemporaryError
from tests.factories import feed_lines
from tests.factories.paths import ROOT

NOW = 1_800_000_000.0


def verdict(sweep: int, status: str = "ok", label: str = "wood") -> dict:
    """A verdict as the bridge writes it."""
    return {**feed_lines.verdict(sweep, 1.0, label, status), "latency_ms": 1.2}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A file that is not there yet."""
    return tmp_path / "verdicts.db"


@pytest.mark.slow
def test_what_is_written_is_read(path):
    """Rows and counts, also during writing; numbers go on after a restart."""
    for start in (1, 3):
        file = VerdictFile(path)
        for sweep in (start, start + 1):
            file.add(NOW + sweep, verdict(sweep, "ok" if sweep < 4 else "unknown"))
        beside = [*since(path, NOW)]
        file.close()
    assert [(row["number"], row["sweep"]) for row in beside] == [(n, n) for n in (1, 2, 3, 4)]
    assert [*since(path, NOW)] == beside
    assert counts(path, NOW) == {("ok", "wood"): 3, ("unknown", ""): 1}
    assert len([*since(path, NOW + 3)]) == 2
    assert {type(row["probability"]) for row in beside} == {float}


def test_no_file_is_made_of_what_is_kept_in_memory(tmp_path, monkeypatch):
    """Each has rows of its own, which end with it."""
    monkeypatch.chdir(tmp_path)
    for sweep in (1, 2):
        kept = VerdictFile(None)
        kept.add(NOW, verdict(sweep))
        assert [row["sweep"] for row in since(kept.db, NOW)] == [sweep]
        kept.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_killed_writer_loses_nothing(path):
    """SIGKILL at any moment: all verdicts that were written are there, and the file is sound."""
    code = (
        "import sys; from pathlib import Path; from palpate.client.verdicts import VerdictFile; "
        "file = VerdictFile(Path(sys.argv[1])); one = dict(sweep=1, status='ok', label='wood')\n"
        "for n in range(10**6): file.add(n, one | {'sweep': n}); print(n, flush=True)"
    )
    words = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT) as writer:
        assert writer.stdout
        last = [int(writer.stdout.readline()) for _ in range(60)][-1]
        writer.send_signal(signal.SIGKILL)
        last = max([last, *map(int, writer.stdout.read().split())])
    VerdictFile(path).close()
    assert [row["sweep"] for row in since(path, -1)][: last + 1] == [*range(last + 1)]


@pytest.mark.slow
def test_the_oldest_goes_first(path):
    """Verdicts of more than 90 days are deleted; a file above its limit loses its oldest tenth."""
    file = VerdictFile(path, most_mib=0.05)
    for n in range(10):
        file.add(NOW - (DAYS + 1) * DAY_S, verdict(n))
    file.trim(NOW)
    assert counts(path, 0) == {}
    for n in range(1000):
        file.add(NOW + n, verdict(n))
    kept = [row["sweep"] for row in since(path, 0)]
    assert kept[-1] == 999
    assert kept == [*range(kept[0], 1000)]
    assert 0 < len(kept) < 900
    file.close()


def test_a_damaged_file_is_moved_aside(path, caplog):
    """A file with other bytes is kept under another name, and a new file begins."""
    path.write_bytes(os.urandom(8192))
    file = VerdictFile(path)
    file.add(NOW, verdict(1))
    file.close()
    assert len([*since(path, 0)]) == 1
    assert path.with_suffix(".damaged").stat().st_size == 8192
    assert "damaged" in caplog.text


@pytest.mark.parametrize(
    "made",
    [
        "CREATE TABLE verdicts (number INTEGER PRIMARY KEY, at REAL, sweep INTEGER, colour TEXT)",
        "CREATE TABLE verdicts (x)",
        "CREATE VIEW verdicts AS SELECT 1",
    ],
)
def test_a_file_of_another_version_is_moved_aside(path, made):
    """Its verdicts are kept; new ones are written."""
    with closing(sqlite3.connect(path)) as db:
        db.execute(made)
        db.commit()
    file = VerdictFile(path)
    file.add(NOW, verdict(1))
    file.close()
    assert [row["sweep"] for row in since(path, 0)] == [1]
    with closing(sqlite3.connect(path.with_suffix(".damaged"))) as db:
        assert db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] >= 1


@pytest.mark.parametrize("how", ["damaged", "moved", "deleted"])
def test_a_file_that_is_spoilt_while_it_is_written(path, how):
    """Later verdicts are written to a new file."""
    file = VerdictFile(path)
    file.add(NOW, verdict(1))
    file.db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    file.db.execute("PRAGMA shrink_memory")
    if how == "damaged":
        head = path.read_bytes()[:4096]
        path.write_bytes(head + bytes(range(256)) * ((path.stat().st_size - len(head)) // 256))
    else:
        path.rename(path.with_name("old.db")) if how == "moved" else path.unlink()
    for sweep in (2, 3):
        file.add(NOW, verdict(sweep))
    file.close()
    assert [row["sweep"] for row in since(path, 0)] == [2, 3]


def test_a_clock_that_is_wrong_for_a_while(path):
    """Half a year ahead it deletes few verdicts; those of then are in no period of now."""
    file = VerdictFile(path)
    for n in range(3 * OLD):
        file.add(NOW + n, verdict(n))
    for n in range(EVERY):
        file.add(NOW + 180 * DAY_S + n, verdict(n, "unknown", ""))
    file.close()
    found = counts(path, NOW, NOW + AHEAD_S)
    assert found[("ok", "wood")] >= 2 * OLD
    assert [*found] == [("ok", "wood")]


def test_a_disk_that_is_full_when_old_verdicts_are_deleted(path, monkeypatch):
    """The verdict of then is there once; they are deleted later."""
    file, calls = VerdictFile(path), []

    def trim(now_s: float) -> None:
        calls.append(now_s)
        if len(calls) < 3:
            raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(file, "trim", trim)
    for n in range(EVERY + 5):
        file.add(NOW + n, verdict(n))
    file.close()
    assert [row["sweep"] for row in since(path, 0)] == [*range(EVERY + 5)]
    assert len(calls) == 3


@pytest.mark.parametrize("value", ["high", np.float32(0.9), np.bool_(True), b"1"])
def test_wrong_kinds_are_refused(path, value):
    """Texts and numpy's numbers are refused, NaN is missing: SQLite would count bytes as 0."""
    file = VerdictFile(path)
    with pytest.raises(sqlite3.Error):
        file.add(NOW, verdict(1) | {"probability": value})
    file.add(NOW, verdict(2) | {"probability": math.nan})
    assert [row["probability"] for row in since(path, 0)] == [None]
    file.close()


def test_a_copy_during_writing(path, tmp_path):
    """With its -wal it has every verdict; without it the rest is sound."""
    file = VerdictFile(path)
    for sweep in range(20):
        file.add(NOW, verdict(sweep))
    copies = [tmp_path / name / path.name for name in ("alone", "whole")]
    for copy in copies:
        copy.parent.mkdir()
        shutil.copy(path, copy)
    shutil.copy(f"{path}-wal", f"{copies[1]}-wal")
    file.close()
    VerdictFile(copies[0]).close()
    assert [row["sweep"] for row in since(copies[1], 0)] == [*range(20)]
    assert len([*since(copies[0], 0)]) <= 20


def test_no_file(path, tmp_path):
    """A reader says which unit writes it; a writer, that the folder is missing."""
    with pytest.raises(FeedError, match="palpate-bridge@memory"):
        counts(path, 0)
    with pytest.raises(TemporaryError, match="none"):
        VerdictFile(tmp_path / "none" / "x.db")


def test_a_second_writer_is_refused(path):
    """It would write each verdict again; once the first has ended it may."""
    first = VerdictFile(path)
    with pytest.raises(TemporaryError, match="another program"):
        VerdictFile(path)
    first.close()
    VerdictFile(path).close()


def test_the_bridge_writes_verdicts_alone(path, caplog):
    """Other lines are passed over, a line of a later version is left out with a warning."""

    class ScriptedFeed(Feed):
        """A feed of these lines."""

        def __init__(self, *lines: dict) -> None:
            super().__init__("/nonexistent")
            self.left = [*lines]

        def read(self, timeout_s: float = 1.0) -> dict | None:
            """The next of them."""
            return self.left.pop(0) if self.left else None

    now_s = time.monotonic()
    lines = [feed_lines.hello(), feed_lines.health(1.0), feed_lines.verdict(1, now_s - 5)]
    lines += [{"type": "verdict"}, feed_lines.verdict(2, now_s)]
    bridge = MemoryBridge(ScriptedFeed(*lines), VerdictFile(path), SystemClock())
    for _ in range(6):
        bridge.work()
    bridge.close()
    first, second = since(path, 0)
    assert (first["sweep"], second["sweep"]) == (1, 2)
    assert 4 < second["at"] - first["at"] < 6
    assert "left out" in caplog.text


def test_status_since(path, capsys):
    """The command counts, and gives rows as JSON; a wrong time ends with exit code 2."""
    file = VerdictFile(path)
    file.add(time.time(), verdict(1))
    file.add(time.time() - 7200, verdict(2))
    file.close()
    words = ["status", "--set", f"bridge.memory={path}", "--since"]
    assert main([*words, "1h"]) == 0
    assert "1 sweeps since" in capsys.readouterr().out
    assert main([*words, "1d", "--json"]) == 0
    assert capsys.readouterr().out.count('"sweep"') == 2
    with pytest.raises(SystemExit):
        main([*words, "yesterday"])
