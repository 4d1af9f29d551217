"""`python -m train.studies reports`: which results are stale and why, which commands run for them,
and what happens if one fails."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from appliance.core.errors import FormatError
from train.metrics import score
from train.studies import document_figures, reports
from train.studies.command import main
from train.studies.reports import ResultFile
from train.studies.study import save

TODAY: dict[str, Any] = {
    "method": "default",
    "seed": 1,
    "set": "sim:T-REAL:1",
    "commit": "abc",
    "date": "2026-11-22",
}
NEED = "a thing that is not here"


def today() -> dict[str, Any]:
    """Results of the default that is packaged now."""
    return TODAY | {"shipped": score.shipped()}


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with four reports: of today, older, never made, and one with a need that is not
    met here."""
    (tmp_path / "README.md").write_text("# Project\n")
    (tmp_path / "docs" / "data").mkdir(parents=True)
    for name, results in (("current", today()), ("older", TODAY | {"shipped": "0badbead"})):
        save(tmp_path / "docs" / "data" / f"{name}.json", results)
    monkeypatch.setitem(reports.NEEDS, NEED, lambda: False)
    made = (
        ResultFile("older", "data/older.json", ("train", "older"), folds=True),
        ResultFile("current", "data/current.json", ("train", "current", "--out", "x")),
        ResultFile("lacking", "data/lacking.json", ("tests.lacking",), (NEED,)),
        ResultFile("new", "data/new.json", ("appliance", "new")),
    )
    monkeypatch.setattr(reports, "REPORTS", made)
    monkeypatch.setattr(document_figures, "write", list)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class RunCommands:
    """Takes down which commands are run, and makes no page; `codes` are their exit codes, 0 where
    none is given."""

    def __init__(self, **codes: int) -> None:
        self.words: list[list[str]] = []
        self.codes = codes

    def __call__(self, words: Sequence[str]) -> int:
        """Run one."""
        self.words.append(list(words))
        return self.codes.get(words[1], 0)


def test_the_list_says_what_would_run_and_why(project: Path, capsys: pytest.CaptureFixture[str]):
    """Each page with its command as a person types it; what is of today, what is older, what is
    missing and what it needs."""
    assert main(["reports", "--list"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "older    stale: Made with an older default, bundle 0badbead; "
        f"the box ships bundle {score.shipped()} now",
        "         python -m train older",
        "current  of today",
        "         python -m train current --out x",
        "lacking  stale: docs/data/lacking.json: No such file or directory; "
        f"left out: it needs {NEED}",
        "         python -m tests.lacking",
        "new      stale: docs/data/new.json: No such file or directory",
        "         palpate new",
    ]
    assert main(["reports", "--list", "current"]) == 0
    assert "older" not in capsys.readouterr().out


def test_stale_pages_are_made_in_order(project: Path):
    """The first tells most; what is of today is not made; only commands of folds get the options of
    where they run."""
    run, lines = RunCommands(), []
    reports.make((), ("--scheduler", "tcp://here"), lines.append, run)
    assert run.words == [["train", "older", "--scheduler", "tcp://here"], ["appliance", "new"]]
    assert lines[0].startswith("1/3 older: Made with an older default")
    assert lines[1] == f"lacking is left out: it needs {NEED}"


def test_after_an_interruption_only_what_is_left_is_made(project: Path):
    """A page that was made is of today then; the next run begins behind it."""
    save(project / "docs" / "data" / "older.json", today())
    run = RunCommands()
    reports.make((), (), lambda line: None, run)
    assert run.words == [["appliance", "new"]]


def test_a_named_page_is_made_again_whatever_it_is(project: Path):
    """In the order of the list, not of the names."""
    run = RunCommands()
    reports.make(("current", "older"), (), lambda line: None, run)
    assert [words[1] for words in run.words] == ["older", "current"]


def test_a_failure_is_named_and_the_others_are_made(project: Path):
    """All that did not come stands in the error: what failed, and what was named but lacks
    something."""
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
    """One line that says which there are, or where to go."""
    assert main(["reports", "olde"]) == FormatError.exit_code
    assert "no report olde; there are older, current, lacking, new" in capsys.readouterr().err
    monkeypatch.chdir(project / "docs")
    assert main(["reports"]) == FormatError.exit_code
    assert "has no docs/ and README.md; run this in the project's folder" in capsys.readouterr().err


def test_a_process_runs_the_command(project: Path, monkeypatch: pytest.MonkeyPatch):
    """`python -m` and the words, in the project's folder; its exit code comes back."""
    (project / "made.py").write_text(
        "import pathlib, sys; pathlib.Path('said').write_text(sys.argv[1]); sys.exit(7)"
    )
    report = ResultFile("made", "data/made.json", ("made", "word"))
    monkeypatch.setattr(reports, "REPORTS", (report,))
    with pytest.raises(FormatError, match="made ended with exit code 7"):
        reports.make((), (), lambda line: None)
    assert (project / "said").read_text() == "word"
