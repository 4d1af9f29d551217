"""`python -m palpate_studies reports`: stale results and reasons, their commands, and failures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from palpate.core.errors import FormatError
from palpate_studies import reports, tables
from palpate_studies.__main__ import main
from palpate_studies.reports import ResultFile
from palpate_studies.study import save
from palpate_train.metrics import score

RESULTS: dict[str, Any] = {"method": "palpate", "seed": 1, "set": "sim:T-REAL:1", "commit": "abc"}
NEED = "a thing that is not here"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with four reports: older, current, with an unmet requirement, and never made."""
    (tmp_path / "README.md").write_text("# Project\n")
    for name, bundle in (("current", score.shipped()), ("older", "0badbead")):
        save(tmp_path / "docs" / "data" / f"{name}.json", RESULTS | {"shipped": bundle})
    monkeypatch.setitem(reports.NEEDS, NEED, lambda: False)
    made = (
        ResultFile("older", "data/older.json", ("palpate_train", "older"), folds=True),
        ResultFile("current", "data/current.json", ("palpate_train", "current", "--out", "x")),
        ResultFile("lacking", "data/lacking.json", ("tests.lacking",), (NEED,)),
        ResultFile("new", "data/new.json", ("palpate", "new")),
    )
    monkeypatch.setattr(reports, "REPORTS", made)
    monkeypatch.setattr(tables, "write", list)
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
    """Each has its command as a person types it, and its state with the unmet requirement."""
    assert main(["reports", "--list"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [line[:2] for line in lines[::2]] == [
        ["older", "stale:"],
        ["current", "of"],
        ["lacking", "stale:"],
        ["new", "stale:"],
    ]
    commands = (
        "palpate-train older",
        "palpate-train current",
        "python -m tests.lacking",
        "palpate",
    )
    for line, command in zip(lines[1::2], commands, strict=True):
        assert " ".join(line).startswith(command)
    assert lines[3][2:] == ["--out", "x"]
    assert "0badbead;" in lines[0]
    assert " ".join(lines[4]).endswith(NEED)


def test_stale_results_are_made_in_order_and_none_twice(project: Path):
    """A named one whatever it is; commands of folds get the options of the machine."""
    run, lines = RunCommands(), []
    reports.make((), ("--scheduler", "tcp://here"), lines.append, run)
    older = ["palpate_train", "older", "--scheduler", "tcp://here"]
    assert run.words == [older, ["palpate", "new"]]
    assert NEED in lines[1]
    save(project / "docs" / "data" / "older.json", RESULTS | {"shipped": score.shipped()})
    again = RunCommands()
    reports.make((), (), lines.append, again)
    assert again.words == [["palpate", "new"]]
    run = RunCommands()
    reports.make(("current", "older"), (), lambda line: None, run)
    assert [words[1] for words in run.words] == ["older", "current"]


def test_a_failure_is_reported_and_the_others_are_made(project: Path):
    """The error has the failed report with its exit code, and the unmet requirement."""
    run = RunCommands(older=3)
    with pytest.raises(FormatError, match=r"older .* 3"):
        reports.make((), (), lambda line: None, run)
    assert len(run.words) == 2
    with pytest.raises(FormatError, match="lacking"):
        reports.make(("lacking",), (), lambda line: None, RunCommands())


def test_an_unknown_report_or_another_folder_is_an_error(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """One line lists the reports, or says which folder is wrong."""
    assert main(["reports", "olde"]) == FormatError.exit_code
    assert "older, current" in capsys.readouterr().err
    monkeypatch.chdir(project / "docs")
    assert main(["reports"]) == FormatError.exit_code
    assert str(project / "docs") in capsys.readouterr().err


def test_a_process_runs_the_command(project: Path, monkeypatch: pytest.MonkeyPatch):
    """It runs `python -m` with the words in the project's folder, and returns the exit code."""
    (project / "made.py").write_text(
        "import pathlib, sys; pathlib.Path('said').write_text(sys.argv[1]); sys.exit(7)"
    )
    report = ResultFile("made", "data/made.json", ("made", "word"))
    monkeypatch.setattr(reports, "REPORTS", (report,))
    with pytest.raises(FormatError, match=r"made .* 7"):
        reports.make((), (), lambda line: None)
    assert (project / "said").read_text() == "word"
