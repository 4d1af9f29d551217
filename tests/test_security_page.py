"""docs/security.md names tests for its claims: each test exists, and every way in has a test."""

from __future__ import annotations

import ast
import re

from tests.factories.paths import ROOT

PAGE = ROOT / "docs" / "security.md"
NAMED = re.compile(r"`(tests/[\w/]+\.py)(?:::(\w+))?`")


def rows() -> list[list[str]]:
    """The cells of the table's rows, without its head."""
    lines = [line for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_every_test_that_is_named_exists():
    """By file and function; one that is renamed or removed makes the page wrong."""
    named = NAMED.findall(PAGE.read_text())
    assert len(named) > 40
    missing = []
    for file, test in named:
        text = (ROOT / file).read_text() if (ROOT / file).is_file() else ""
        there = {
            node.name for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)
        }
        if not text or (test and test not in there):
            missing.append(f"{file}::{test}")
    assert not missing


def test_every_way_in_is_told_whole():
    """Who reaches it, the possible harm, the defence, and at least one test that shows it."""
    for row in rows():
        assert len(row) == 5, row[0]
        assert all(row), row[0]
        assert all(test for _, test in NAMED.findall(row[4])), row[0]
        assert NAMED.findall(row[4]), row[0]


def test_the_ways_in_are_those_of_the_box():
    """Each interface that the settings and units open has its row."""
    named = " ".join(row[0] for row in rows())
    for way in (
        "USB",
        "serial",
        "GPIO",
        "ssh",
        "feed",
        "page",
        "bridges",
        "bundle",
        "enrolled",
        "names",
        "recordings",
    ):
        assert way in named, way
