"""The log: lines for a terminal and the journal, a full disk, trouble that is logged once."""

from __future__ import annotations

import logging
import os
import sys

import pytest

from palpate.core.errors import ApplianceError
from palpate.core.log import LineHandler, SparseLog, TroubleLog, in_journal, log, to_stderr


@pytest.mark.parametrize(
    ("text", "level", "journal", "shown"),
    [
        ("skin: gone", logging.WARNING, True, "<4>skin: gone"),
        ("skin: gone", logging.WARNING, False, "palpate: skin: gone"),
        ("skin: streaming", logging.INFO, True, "<6>skin: streaming"),
        ("lost", logging.ERROR, True, "<3>lost"),
        ("detail", logging.DEBUG, True, "<7>detail"),
        ("skin: <4>", logging.INFO, False, "palpate: skin: <4>"),
        ("skin: X\r\n<0>board", logging.INFO, True, "<6>skin: X <0>board"),
        ("100 % of %s", logging.INFO, False, "palpate: 100 % of %s"),
        ("a\x1b[31mred\x07\x9b2J", logging.INFO, True, "<6>a?[31mred??2J"),
        ("a\x1b[31mred\x07\x9b2J", logging.INFO, False, "palpate: a?[31mred??2J"),
    ],
)
def test_a_line_for_the_journal_and_for_a_terminal(text, level, journal, shown):
    """Name or priority; text of a device cannot control a terminal."""
    record = logging.LogRecord("palpate", level, "", 0, text, None, None)
    assert LineHandler(journal=journal).format(record) == shown


def test_the_journal_is_known_by_its_stream(tmp_path):
    """JOURNAL_STREAM must name this very stream."""
    with (tmp_path / "out").open("w") as f:
        status = os.fstat(f.fileno())
        environ = {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
        assert in_journal(environ, f.fileno())
        assert not in_journal({}, f.fileno())
        assert not in_journal(environ, 0)
    assert not in_journal(environ, 1_000_000)


def test_a_line_comes_once_or_not_at_all(capsys, monkeypatch):
    """However often it is set up; a full disk raises and prints nothing else."""
    to_stderr()
    to_stderr()
    log.info("ready")
    assert capsys.readouterr().err == "palpate: ready\n"
    to_stderr()
    full = open("/dev/full", "w")  # noqa: SIM115 (its close fails, too)
    monkeypatch.setattr(sys, "stderr", full)
    log.warning("lost")
    monkeypatch.undo()
    with pytest.raises(OSError, match="space"):
        full.close()


def test_trouble_is_logged_when_it_begins_changes_and_ends(logged):
    """Once each; a first unknown state is news."""
    trouble = TroubleLog("skin", "look at the cable", end="skin: streaming")
    for now in ("", "", "gone", "gone", "busy", "", "", "gone"):
        trouble.update(now)
    quiet = TroubleLog("disk")
    for now in ("full", "", "full"):
        quiet.update(now)
    first = TroubleLog("serial", end="serial: open", known=False)
    for now in ("", ""):
        first.update(now)
    assert logged == [
        "<4>skin: gone; look at the cable",
        "<4>skin: busy; look at the cable",
        "skin: streaming",
        "<4>skin: gone; look at the cable",
        *["<4>disk: full"] * 2,
        "serial: open",
    ]


def test_an_attempt_is_repeated_in_silence(logged):
    """The same error is one line until it went well; another kind of error is the caller's."""
    trouble = TroubleLog("status: cannot be written", "classifying goes on")

    def fail(error: Exception) -> None:
        raise error

    full = OSError(28, "No space left on device")
    assert [trouble.attempt(lambda: fail(full)) for _ in range(3)] == [False] * 3
    assert trouble.attempt(lambda: None)
    assert not trouble.attempt(lambda: fail(full))
    assert not trouble.attempt(lambda: fail(ApplianceError("in use")), (OSError, ApplianceError))
    with pytest.raises(ApplianceError):
        trouble.attempt(lambda: fail(ApplianceError("in use")))
    begin = "<4>status: cannot be written: "
    end = "; classifying goes on"
    assert logged == [f"{begin}{why}{end}" for why in ["No space left on device"] * 2 + ["in use"]]


def test_what_others_cause_is_logged_sparsely(logged):
    """Refusals as fast as a peer can ask: one line in ten seconds, with the number left out."""
    now = [0]
    sparse = SparseLog(lambda: now[0])
    for _ in range(749):
        sparse.warning("modbus: START: refused")
        now[0] += 40_000_000_000 // 749
    assert len(logged) <= 5
    assert "since" in logged[1]
