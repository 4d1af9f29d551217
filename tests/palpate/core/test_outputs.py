"""The ending of a new file must fit its kind; another is refused before any work."""

from __future__ import annotations

import re
from argparse import ArgumentTypeError
from pathlib import Path

import pytest

from palpate.cli import main as box
from palpate.core import outputs
from palpate_studies import __main__ as studies
from palpate_train.cli import main as desktop

DESKTOP = (
    ("import", "none", "--pattern", "{material}.csv", "--rate", "1"),
    ("fit", "--set", "none", "--seed", "1"),
    ("report", "none", "--set", "none"),
    ("export", "none", "--name", "a", "--version", "1"),
    ("sets", "view", "none"),
    ("pull", "none"),
)
BOX = (("record", "--format", "4x4:uint8:750"),)
STUDIES = (("fabrics", "--method", "H-svm"),)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["i.csv", "r.pdf"])
@pytest.mark.parametrize(
    ("run", "words"),
    [
        *((desktop.main, words) for words in DESKTOP),
        *((box.main, words) for words in BOX),
        *((studies.main, words) for words in STUDIES),
    ],
    ids=lambda x: x[0] if isinstance(x, tuple) else "",
)
def test_no_command_writes_another_kind_of_file(run, words, name, tmp_path, capsys):
    """Named; nothing is read or written; exit code of bad options."""
    out = tmp_path / name
    try:
        code = run([*words, "--out", str(out)])
    except SystemExit as e:
        code = e.code
    assert code in (2, 65)
    said = " ".join(capsys.readouterr().err.split())
    assert "--out" in said
    assert name in said
    assert re.search("an? .* file|a folder|ends so", said), said
    assert not [*tmp_path.iterdir()]


def test_a_file_has_its_ending_and_a_folder_any(tmp_path):
    """All allowed ones are named; a folder keeps its name, with a point as in a version."""
    assert outputs.folder("bundle-1.2") == Path("bundle-1.2")
    (tmp_path / "old.csv").mkdir()
    assert outputs.folder(str(tmp_path / "old.csv")) == tmp_path / "old.csv"
    with pytest.raises(ArgumentTypeError, match=r"i\.csv"):
        outputs.folder("i.csv")
    read = outputs.file(".svg", ".html")
    assert (read("a.SVG"), read("a")) == (Path("a.SVG"), Path("a"))
    with pytest.raises(ArgumentTypeError, match=r"\.html"):
        read("a.pdf")
