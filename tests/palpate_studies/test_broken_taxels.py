"""The table of broken taxels, with and without bridging."""

from __future__ import annotations

import re

import pytest

from palpate.bundle import bundle
from palpate_studies import broken_taxels
from palpate_studies.command import main


def test_the_table_counts_each_sweep_once(capsys: pytest.CaptureFixture[str]):
    """Twelve lines of faults. Without bridging every sweep with a stuck taxel is refused; with it
    nearly every sweep is named rightly."""
    assert main(["taxels", "--test", "sim:T-REAL/level-blind:101:1"]) == 0
    head, columns, *rows = capsys.readouterr().out.splitlines()
    n = int(head.split(": ")[1].split()[0])
    assert bundle.load(bundle.DEFAULT).id in head
    assert "rightly, wrongly, unsure, unknown, refused" in columns
    assert len(rows) == 12
    for row in rows:
        before, after = ([int(k) for k in part.split()] for part in row.split(" | ")[1:])
        assert sum(before) == sum(after) == n
        assert after[0] >= 0.9 * n
        if row.startswith("stuck"):
            assert before == [0, 0, 0, 0, n]


def test_times_are_measured_in_turns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """The line has a median for each case."""
    monkeypatch.setattr(broken_taxels, "RUNS", 3)
    assert main(["taxels", "--times"]) == 0
    said = capsys.readouterr().out
    cases = "without|with|with a dead taxel|network"
    assert said.startswith("median of 3 classifications in turns: ")
    assert re.findall(rf"(?:^|: |, )({cases}) \d+\.\d{{3}} ms", said) == cases.split("|")
