"""docs/security.md: each way in has a defence, and files of tests that show it."""

from __future__ import annotations

import re

from tests.factories.paths import ROOT

PAGE = (ROOT / "docs" / "security.md").read_text()
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if line.startswith("| ")
][1:]


def test_every_way_in_is_described_whole():
    """Who reaches it, the possible harm, the defence, and tests that exist."""
    assert len(ROWS) > 10
    for row in ROWS:
        assert len(row) == 5, row[0]
        assert all(row), row[0]
        files = re.findall(r"`(tests/[\w/]+\.py)`", row[4])
        assert files, row[0]
        assert all((ROOT / file).is_file() for file in files), row[4]


def test_the_ways_in_are_those_of_the_box():
    """Each interface that settings and units open has its row."""
    found = " ".join(row[0] for row in ROWS)
    ways = "USB serial GPIO ssh feed page bridges bundle enrolled names recordings"
    assert [way for way in ways.split() if way not in found] == []
