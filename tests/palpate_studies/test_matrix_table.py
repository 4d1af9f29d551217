"""The table of methods: order of tests, best peer, difference, verdict, and its place in a page."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from palpate.core.errors import FormatError
from palpate_studies import matrix_table
from palpate_studies.command import main


def result(
    method: str,
    protocol: str,
    right: int,
    means_removed: bool = True,
    seed: int = 1,
    classes: int = 2,
) -> dict:
    """A result as evaluate writes it, of a hundred windows."""
    return {
        "method": method,
        "protocol": protocol,
        "means_removed": means_removed,
        "seed": seed,
        "materials": ["a"] * classes,
        "window": {"right": right, "total": 100},
        "interval": [right / 100 - 0.02, right / 100 + 0.02],
        "recording": {"right": 4, "total": 10},
        "recording_interval": [0.31, 0.52],
    }


def test_each_test_says_whether_ours_is_ahead():
    """Tests without means come first, then those with more classes.

    Each has the best peer by name, the difference with an interval, and a verdict in words.
    """
    results = [
        result("palpate", "leave:force", 95, means_removed=False),
        result("static-svm", "leave:force", 98, means_removed=False),
        result("palpate", "leave:force", 90),
        result("minirocket", "leave:force", 80),
        result("H-svm", "leave:force", 60),
        result("palpate", "leave:rep", 70, classes=7),
        result("palpate", "leave:rep", 72, seed=2, classes=7),
        result("minirocket", "leave:rep", 78, classes=7),
        result("H-svm", "leave:speed", 50),
    ]
    head, _, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in matrix_table.headline(results).splitlines()
    ]
    assert head == [
        "test",
        "means",
        "Palpate, all views",
        "best of the others",
        "difference, points",
        "verdict",
    ]
    assert rows == [
        [
            "7 classes: a repetition it never felt",
            "removed",
            "71.0 % [69.0, 73.0]",
            "MiniRocket: 78.0 % [76.0, 80.0]",
            "−7.0 [−9.8, −4.2]",
            "falls short",
        ],
        [
            "2 classes: a force it never felt",
            "removed",
            "90.0 % [88.0, 92.0]",
            "MiniRocket: 80.0 % [78.0, 82.0]",
            "+10.0 [+7.2, +12.8]",
            "ahead",
        ],
        [
            "2 classes: a force it never felt",
            "kept",
            "95.0 % [93.0, 97.0]",
            "static-svm: 98.0 % [96.0, 100.0]",
            "−3.0 [−5.8, −0.2]",
            "falls short",
        ],
    ]


def test_ours_alone_has_no_verdict():
    """The line says that there is nothing to compare with."""
    assert (
        matrix_table.headline([result("palpate", "leave:force", 90)])
        .splitlines()[-1]
        .endswith("| 90.0 % [88.0, 92.0] | – | – | no peer was run |")
    )


def test_the_command_writes_the_table_between_its_markers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Picture and table are written. The error names a page without markers, which stays
    unchanged.
    """
    (tmp_path / "r.json").write_text(
        json.dumps([result("palpate", "leave:force", 90), result("H-svm", "leave:force", 60)])
    )
    page, picture = tmp_path / "README.md", tmp_path / "w.svg"
    page.write_text("# Fabrics\n\n<!-- matrix -->\nold\n<!-- /matrix -->\n\nend\n")
    command = ["matrix", str(tmp_path / "r.json"), "--out", str(picture), "--page"]
    assert main([*command, str(page)]) == 0
    text = page.read_text()
    assert "| 2 classes: a force it never felt | removed |" in text
    assert "old" not in text
    assert text.startswith("# Fabrics\n\n<!-- provenance ")
    assert "<!-- matrix -->\n| test |" in text
    assert text.endswith("<!-- /matrix -->\n\nend\n")
    assert picture.exists()
    page.write_text("# Fabrics\n")
    capsys.readouterr()
    assert main([*command, str(page)]) == FormatError.exit_code
    assert (
        "has not one pair of markers <!-- matrix --> and <!-- /matrix -->"
        in capsys.readouterr().err
    )
    assert page.read_text() == "# Fabrics\n"
