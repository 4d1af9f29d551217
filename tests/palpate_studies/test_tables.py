"""Tables of results in documents: all are written, between their markers, and nothing else."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from palpate.core.errors import FormatError
from palpate_studies import tables
from palpate_studies.__main__ import main
from palpate_studies.study import results_file
from palpate_train.metrics import score
from tests.factories.paths import ROOT
from tests.factories.study_pages import committed

DOCUMENTS = sorted({document for document, *_ in tables.TABLES})


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the documents and results of all tables, as the working folder."""
    results = {str(results_file(study)) for _, _, study, _ in tables.TABLES}
    for name in {*DOCUMENTS, *results}:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_table_is_written_once_and_the_text_around_it_stays(
    project: Path, capsys: pytest.CaptureFixture[str]
):
    """A second run changes nothing; each marker of a document belongs to a table."""
    marked = re.compile(r"<!-- (?!provenance|/)([a-z -]+) -->\n")
    marks = re.compile(r"(?s)<!--.*?-->")
    outside = {
        name: re.split(r"(?s)<!--.*?-->", (project / name).read_text()) for name in DOCUMENTS
    }
    assert main(["tables"]) == 0
    first = {name: (project / name).read_text() for name in (*DOCUMENTS, tables.FRONT)}
    capsys.readouterr()
    assert main(["tables"]) == 0
    assert capsys.readouterr().out == ""
    for name in DOCUMENTS:
        known = {marker for document, marker, *_ in tables.TABLES if document == name}
        assert set(marked.findall(first[name])) == known
        after = re.split(marks, first[name])
        assert (outside[name][0], outside[name][-1]) == (after[0], after[-1])
    assert "var(" not in first[tables.FRONT]


@pytest.mark.slow
def test_a_changed_figure_changes_its_document_alone(
    project: Path, capsys: pytest.CaptureFixture[str]
):
    """The memory after a thousand sweeps, in the specifications."""
    main(["tables"])
    file = project / results_file("bench")
    figures = json.loads(file.read_bytes())
    figures["rss_mb"]["after_1000"] = 1234.5
    file.write_text(json.dumps(figures))
    capsys.readouterr()
    assert main(["tables"]) == 0
    assert capsys.readouterr().out.split() == [tables.SPECIFICATIONS]
    assert "1234.5 MiB" in (project / tables.SPECIFICATIONS).read_text()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("docs/data/bench.json", None),
        ("docs/data/bench.json", "{"),
        ("README.md", "# no markers"),
        ("README.md", None),
        (tables.SPECIFICATIONS, "<!-- /bench --><!-- bench -->"),
    ],
)
def test_what_is_missing_is_an_error_and_nothing_is_written(
    project: Path, capsys: pytest.CaptureFixture[str], name: str, text: str | None
):
    """The error has the name of the file; no document changes."""
    (project / name).unlink()
    if text is not None:
        (project / name).write_text(text)
    page = (project / tables.RECIPE).read_bytes()
    assert main(["tables"]) == FormatError.exit_code
    assert name in capsys.readouterr().err
    assert (project / tables.RECIPE).read_bytes() == page


def test_answers_add_up_and_older_figures_say_so_first():
    """Each row counts all its sweeps once; the note stands before the caption."""
    for study, table in (("stress", tables.stressed), ("junk", tables.junk)):
        rows = [
            re.findall(r"[\d,]+(?= )", line) for line in table(committed(study)).split("\n")[3:-1]
        ]
        assert len(rows) >= 3
    (first, *_) = tables.stressed(committed("stress")).split("\n")[3:]
    right, wrong, none = map(int, re.findall(r"\| (\d+) (?=\|)", first))
    assert right + wrong + none == committed("stress")["box"]["curves"]["correct"]["noise"]["total"]
    figures: dict[str, Any] = committed("bench") | {"bundle": score.shipped()}
    assert tables.bench(figures).startswith("Measured by")
    assert "0badbead" in tables.bench(figures | {"bundle": "0badbead"}).partition("\n")[0]


def test_each_test_says_whether_ours_is_ahead():
    """Tests without means come first, then tests with more classes; seeds are averaged."""

    def result(method: str, protocol: str, right: int, removed: bool = True, **more: Any) -> Any:
        """A result as evaluate writes it, of a hundred windows and two materials."""
        ends = [right / 100 - 0.02, right / 100 + 0.02]
        return {
            **{"method": method, "protocol": protocol, "means_removed": removed, "seed": 1},
            **{"materials": ["a"] * 2, "window": {"right": right, "total": 100}, "interval": ends},
        } | more

    seven: dict[str, Any] = {"materials": ["a"] * 7}
    results = [
        result("palpate", "leave:force", 95, removed=False),
        result("static-svm", "leave:force", 98, removed=False),
        result("palpate", "leave:force", 90),
        result("minirocket", "leave:force", 80),
        result("H-svm", "leave:force", 60),
        result("palpate", "leave:rep", 70, **seven),
        result("palpate", "leave:rep", 72, seed=2, **seven),
        result("minirocket", "leave:rep", 78, **seven),
        result("H-svm", "leave:speed", 50),
    ]
    rows = tables.fabrics(results).splitlines()[2:]
    parts = (
        ("7 classes", "removed", "71.0 %", "MiniRocket: 78.0 %", "−7.0 [−9.8", "falls short"),
        ("2 classes", "removed", "90.0 %", "MiniRocket: 80.0 %", "+10.0 [+7.2", "ahead"),
        ("2 classes", "kept", "95.0 %", "static-svm: 98.0 %", "−3.0 [−5.8", "falls short"),
    )
    for row, cells in zip(rows, parts, strict=True):
        assert all(cell in row for cell in cells), row
    alone = tables.fabrics([result("palpate", "leave:force", 90)])
    assert "| – | – |" in alone
