"""`python -m palpate_studies reports`: stale results and reasons, their commands, and failures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from palpate.core.errors import FormatError
from palpate_studies import document_figures, reports
from palpate_studies.command import main
from palpate_studies.reports import ResultFile
from palpate_studies.study import save
from palpate_train.metrics import score

TODAY: dict[str, Any] = {
    "method": "palpate",
    "seed": 1,
    "set": "sim:T-REAL:1",
    "commit": "abc",
    "date": "2026-11-22",
}
NEED = "a thing that is not here"


def today() -> dict[str, Any]:
    """Results of the packaged default."""
    return TODAY | {"shipped": score.shipped()}


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with four reports: current, older, never made, and with an unmet requirement."""
    (tmp_path / "README.md").write_text("# Project\n")
    (tmp_path / "docs" / "data").mkdir(parents=True)
    for name, results in (("current", today()), ("older", TODAY | {"shipped": "0badbead"})):
        save(tmp_path / "docs" / "data" / f"{name}.json", results)
    monkeypatch.setitem(reports.NEEDS, NEED, lambda: False)
    made = (
        ResultFile("older", "data/older.json", ("palpate_train", "older"), folds=True),
        ResultFile("current", "data/current.json", ("palpate_train", "current", "--out", "x")),
        ResultFile("lacking", "data/lacking.json", ("tests.lacking",), (NEED,)),
        ResultFile("new", "data/new.json", ("palpate", "new")),
    )
    monkeypatch.setattr(reports, "REPORTS", made)
    monkeypatch.setattr(document_figures, "write", list)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class RunCommands:
    """Records the commands instead of running them. codes: their exit codes, by default 0."""

    def __init__(self, **codes: int) -> None:
        self.words: list[list[str]] = []
        self.codes = codes

    def __call__(self, words: Sequence[str]) -> int:
        """Record a command; returns its exit code."""
        self.words.append(list(words))
        return self.codes.get(words[1], 0)


def test_the_list_says_what_would_run_and_why(project: Path, capsys: pytest.CaptureFixture[str]):
    """Each page has its command as a person types it, and its state: current, older or missing.

    A missing page has its requirement.
    """
    assert main(["reports", "--list"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "older    stale: Made with an older default, bundle 0badbead; "
        f"the box ships bundle {score.shipped()} now",
        "         palpate-train older",
        "current  of today",
        "         palpate-train current --out x",
        "lacking  stale: docs/data/lacking.json: No such file or directory; "
        f"left out: it needs {NEED}",
        "         python -m tests.lacking",
        "new      stale: docs/data/new.json: No such file or directory",
        "         palpate new",
    ]
    assert main(["reports", "--list", "current"]) == 0
    assert "older" not in capsys.readouterr().out


def test_stale_pages_are_made_in_order(project: Path):
    """The order is that of the list. Current pages are not made.

    Only commands of folds get the options of the machine that runs them.
    """
    run, lines = RunCommands(), []
    reports.make((), ("--scheduler", "tcp://here"), lines.append, run)
    assert run.words == [
        ["palpate_train", "older", "--scheduler", "tcp://here"],
        ["palpate", "new"],
    ]
    assert lines[0].startswith("1/3 older: Made with an older default")
    assert lines[1] == f"lacking is left out: it needs {NEED}"


def test_after_an_interruption_only_what_is_left_is_made(project: Path):
    """A finished page is current, so the next run begins after it."""
    save(project / "docs" / "data" / "older.json", today())
    run = RunCommands()
    reports.make((), (), lambda line: None, run)
    assert run.words == [["palpate", "new"]]


def test_a_named_page_is_made_again_whatever_it_is(project: Path):
    """The pages are made in the order of the list, not of the names."""
    run = RunCommands()
    reports.make(("current", "older"), (), lambda line: None, run)
    assert [words[1] for words in run.words] == ["older", "current"]


def test_a_failure_is_named_and_the_others_are_made(project: Path):
    """The error lists all missing pages: those that failed, and those with an unmet requirement."""
    run = RunCommands(older=3)
    with pytest.raises(
        FormatError, match="older ended with exit code 3; see above, and run the command again"
    ):
        reports.make((), (), lambda line: None, run)
    assert len(run.words) == 2
    with pytest.raises(FormatError, match="lacking is left out"):
        reports.make(("lacking",), (), lambda line: None, RunCommands())


def test_an_unknown_report_or_another_folder_is_an_error(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """One line lists the reports, or names the right folder."""
    assert main(["reports", "olde"]) == FormatError.exit_code
    assert "no report olde; there are older, current, lacking, new" in capsys.readouterr().err
    monkeypatch.chdir(project / "docs")
    assert main(["reports"]) == FormatError.exit_code
    assert "has no docs/ and README.md; run this in the project's folder" in capsys.readouterr().err


def test_a_process_runs_the_command(project: Path, monkeypatch: pytest.MonkeyPatch):
    """It runs `python -m` with the words in the project's folder, and returns the exit code."""
    (project / "made.py").write_text(
        "import pathlib, sys; pathlib.Path('said').write_text(sys.argv[1]); sys.exit(7)"
    )
    report = ResultFile("made", "data/made.json", ("made", "word"))
    monkeypatch.setattr(reports, "REPORTS", (report,))
    with pytest.raises(FormatError, match="made ended with exit code 7"):
        reports.make((), (), lambda line: None)
    assert (project / "said").read_text() == "word"
