"""The figures in README and pages are those of the results. Older figures say so."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpate.core.errors import FormatError
from palpate_studies import document_figures
from palpate_studies.command import main
from palpate_studies.document_figures import (
    ALIGN,
    FIGURES,
    PICTURES,
    SPECIFICATIONS,
    DocumentPicture,
)
from palpate_studies.study import results_file
from palpate_train.reports import provenance
from tests.factories.paths import ROOT

DOCUMENTS = sorted({figure.document for figure in FIGURES})
MARKED = re.compile(r"<!-- (?!provenance|/)([a-z -]+) -->\n")
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+\.svg)\)")
Break = Callable[[Path], Any]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the project's documents and results, as the working folder."""
    results = {figure.results for figure in (*FIGURES, *document_figures.PICTURES)}
    pictures = [picture.file for picture in document_figures.PICTURES]
    for name in {*DOCUMENTS, *pictures, *(str(results_file(name)) for name in results)}:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", DOCUMENTS)
def test_documents_show_the_figures_of_their_results(name: str):
    """They are equal letter for letter; `python -m palpate_studies figures` writes them again."""
    assert (ROOT / name).read_text(encoding="utf-8") == document_figures.written(name, ROOT)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_all_markers_of_a_document_are_written(name: str):
    """Every text between markers belongs to a command."""
    known = {figure.marker for figure in FIGURES if figure.document == name}
    assert set(MARKED.findall((ROOT / name).read_text(encoding="utf-8"))) == known


@pytest.mark.parametrize("picture", PICTURES, ids=lambda picture: picture.file)
def test_pictures_show_their_results(picture: DocumentPicture):
    """They are equal byte for byte; `python -m palpate_studies figures` writes them again."""
    assert (ROOT / picture.file).read_text(encoding="utf-8") == document_figures.drawn(
        picture, ROOT
    )


def test_the_command_writes_what_has_changed_and_nothing_else(
    project: Path, capsys: pytest.CaptureFixture[str]
):
    """A changed figure changes its documents. Text beside the markers stays. A second run changes
    nothing.
    """
    results, before = project / results_file("bench"), (project / SPECIFICATIONS).read_text()
    figures = json.loads(results.read_bytes())
    figures["rss_mb"]["after_1000"] = 1234.5
    results.write_text(json.dumps(figures))
    assert main(["figures"]) == 0
    assert capsys.readouterr().out.split() == [SPECIFICATIONS]
    after = (project / SPECIFICATIONS).read_text()
    changed = [
        pair
        for pair in zip(before.split("\n"), after.split("\n"), strict=True)
        if pair[0] != pair[1]
    ]
    assert ["1234.5 MiB" in line for _, line in changed] == [True]
    assert main(["figures"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            lambda root: (root / results_file("bench")).unlink(),
            "docs/data/bench.json does not hold the figures of 'bench': .*palpate bench",
        ),
        (
            lambda root: (root / results_file("bench")).write_text("{"),
            "docs/data/bench.json .* run `palpate bench --json",
        ),
        (
            lambda root: (root / results_file("alignment")).write_text('{"moved": {"rows": []}}'),
            "alignment.json .* run `python -m palpate_studies alignment",
        ),
        (
            lambda root: (root / "README.md").write_text("# no markers"),
            "README.md has not one pair of markers",
        ),
        (
            lambda root: (root / SPECIFICATIONS).write_text("<!-- /bench --><!-- bench -->"),
            "one pair",
        ),
        (
            lambda root: (root / "README.md").unlink(),
            "no docs/ and README.md; run this in the project's folder",
        ),
    ],
    ids=["no file", "no JSON", "other JSON", "no markers", "wrong order", "elsewhere"],
)
def test_what_is_missing_is_named_and_nothing_is_written(
    project: Path, capsys: pytest.CaptureFixture[str], damage: Break, said: str
):
    """One line names the file and the remedy. No document changes."""
    damage(project)
    page = (project / ALIGN).read_bytes()
    assert main(["figures"]) == FormatError.exit_code
    assert re.search(said, capsys.readouterr().err)
    assert (project / ALIGN).read_bytes() == page


def test_a_picture_of_an_older_default_is_called_so():
    """Every document with such a picture has the sentence. A picture without a header has no
    default.
    """
    for document in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = document.read_text(encoding="utf-8")
        for name in PICTURE.findall(text):
            picture = document.parent / name
            if re.search(provenance.FOUND[".svg"], picture.read_text(encoding="utf-8"), re.DOTALL):
                assert provenance.read(picture).older in text, (document, name)
