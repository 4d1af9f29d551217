"""The check of prose in `make lint`: it finds the patterns, and ceilings only fall."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from tests import prose


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
    for folder in ("appliance/io", "docs/how-to"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "appliance" / "io" / "port.py").write_text(
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
        "appliance/io": (4, 1),
        "docs/how-to": (2, 2),
        "README.md": (1, 0),
    }
    assert counts["appliance/io"].matches == ["appliance/io/port.py: Return what is left of it."]
    assert counts["appliance/io"].percent == 25.0


def test_a_package_above_its_ceiling_fails(project: Path, capsys: pytest.CaptureFixture[str]):
    """With one line that says how to find the clauses; a package without a ceiling may have 1 %."""
    file = project / "ceilings.toml"
    file.write_text('"appliance/io" = 24.9\n')
    assert prose.main([], project, file) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first == (
        "appliance/io: 25.0 % of 4 clauses have to be read twice; at most 24.9 % may:"
        " python -m tests.prose appliance/io lists them"
    )
    assert second.startswith("docs/how-to: 100.0 % of 2 clauses")
    file.write_text('"appliance/io" = 25.0\n"docs/how-to" = 100.0\n')
    assert prose.main([], project, file) == 0


def test_ceilings_only_fall(project: Path):
    """--lower lowers a ceiling to the measured share, keeps a lower ceiling, never goes below
    1 %, and forgets a package that has gone."""
    file = project / "ceilings.toml"
    file.write_text('"appliance/io" = 40.0\n"docs/how-to" = 50.0\n"gone" = 3.0\n')
    assert prose.main(["--lower"], project, file) == 1
    assert tomllib.loads(file.read_text()) == {
        "README.md": 1.0,
        "appliance/io": 25.0,
        "docs/how-to": 50.0,
    }


def test_the_clauses_of_a_package_are_listed(project: Path, capsys: pytest.CaptureFixture[str]):
    """Each that matches, after its file."""
    file = project / "ceilings.toml"
    file.write_text("")
    assert prose.main(["docs"], project, file) == 0
    assert capsys.readouterr().out.splitlines() == [
        "docs/how-to/a.md: That is no answer.",
        "docs/how-to/a.md: It is what was sent.",
    ]


def test_every_ceiling_is_of_a_package_that_exists():
    """No ceiling outlives its package, and none is above 100 %."""
    ceilings = tomllib.loads(prose.CEILINGS.read_text())
    assert ceilings.keys() <= {package for package, _ in prose.files()}
    assert max(ceilings.values()) <= 100
