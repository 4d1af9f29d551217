"""The check of prose in `make lint`: it finds the patterns."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests import prose
from tests.factories.paths import ROOT


@pytest.mark.parametrize(
    "clause",
    [
        "gives what is left of it",
        "a member that is no array",
        "the sweep is told to the robot",
        "like the one before it",
        "Chosen is the cheapest model",
        "equal in all but for a sign",
    ],
)
def test_a_pattern_is_found(clause: str):
    """Each kind of pattern matches."""
    assert prose.SYMPTOMS.search(clause)


@pytest.mark.parametrize(
    "clause",
    [
        "the stages between a sweep and its verdict",
        "a member that is not an array",
        "the skin is no longer there",
        "We choose the cheapest model.",
    ],
)
def test_a_plain_sentence_is_not_found(clause: str):
    """The cures do not match."""
    assert not prose.SYMPTOMS.search(clause)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with three packages: one of four clauses matches, both of two, none of one."""
    for folder in ("appliance/palpate/io", "docs/how-to"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "appliance" / "palpate" / "io" / "port.py").write_text(
        '"""Reads bytes from a port; keeps the time of each."""\n'
        "# The port has to be open before it.\n"
        "\n\ndef f():\n"
        '    """Return what is left of it.\n\n    Short."""\n'
        "    text = 'what is here is not counted'\n"
        "    return text  # what is behind code is not counted either\n"
    )
    (tmp_path / "docs" / "how-to" / "a.md").write_text(
        "That is no answer. It is what was sent.\n```\nwhat is code is not counted\n```\n"
    )
    (tmp_path / "README.md").write_text("All that a reader needs.\n")
    return tmp_path


def test_docstrings_comments_and_pages_are_counted(project: Path):
    """By package; code, strings and short remarks are not counted."""
    counts = prose.measure(project)
    assert {name: (c.clauses, len(c.matches)) for name, c in counts.items()} == {
        "appliance/palpate": (4, 1),
        "docs/how-to": (2, 2),
        "README.md": (1, 0),
    }
    assert counts["appliance/palpate"].matches == [
        "appliance/palpate/io/port.py: Return what is left of it."
    ]
    assert counts["appliance/palpate"].percent == 25.0


def test_a_package_above_the_ceiling_fails(project: Path, capsys: pytest.CaptureFixture[str]):
    """With one line that says how to find the clauses."""
    assert prose.main([], project) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("appliance/palpate: 25.0 % of 4 clauses")
    assert first.endswith("python -m tests.prose appliance/palpate lists them")
    assert second.startswith("docs/how-to: 100.0 % of 2 clauses")


def test_the_clauses_of_a_package_are_listed(project: Path, capsys: pytest.CaptureFixture[str]):
    """Each that matches, after its file."""
    assert prose.main(["docs"], project) == 0
    assert capsys.readouterr().out.splitlines() == [
        "docs/how-to/a.md: That is no answer.",
        "docs/how-to/a.md: It is what was sent.",
    ]


def test_every_page_is_reached_from_the_readme():
    """A person finds each page by links, without a search."""
    reached, left = set[Path](), [ROOT / "README.md"]
    while left:
        page = left.pop().resolve()
        if page not in reached:
            reached.add(page)
            links = re.findall(r"\]\(([^)#\s:]+\.md)", page.read_text())
            left += [page.parent / link for link in links]
    pages = {*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("firmware_config/**/*.md")}
    assert pages - reached == set()
