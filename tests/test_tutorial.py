"""The tutorial "Your first model": its commands run as they stand on the page, and print the lines
that the page shows."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.factories.paths import ROOT

PAGE = ROOT / "docs" / "tutorials" / "first-model.md"
COMMAND = re.compile(r"(?m)^    ((?:python|palpate|palpate-train) .*)$")
SHOWN = (
    "162 files in build/recordings, materials: metal, wood, paper, plastic rough",
    "time,s0,s1,s2,s3,s4,s5,s6,s7,s8,s9,s10,s11,s12,s13,s14,s15",
    "named rightly: 36 of 36: 100.0 % [90.4, 100.0], 95 % interval, by position (2)",
)
"""Lines of the page that do not depend on the machine."""


@pytest.mark.slow
@pytest.mark.thorough
def test_the_commands_of_the_tutorial_run(tmp_path: Path):
    """In their order, in a folder of their own: recordings, import, fit, export, score, demo."""
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    (tmp_path / "build").mkdir()
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
    }
    commands = COMMAND.findall(PAGE.read_text("utf-8"))
    assert [shlex.split(command)[:2][-1] for command in commands] == [
        "docs/tutorials/csv_sweeps.py",
        "import",
        "fit",
        "export",
        "score",
        "demo",
    ]
    output = ""
    for command in commands:
        done = subprocess.run(
            shlex.split(command),
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        output += done.stdout
    output += (tmp_path / "build" / "recordings" / "wood_p3_2.csv").read_text()
    for line in SHOWN:
        assert line in PAGE.read_text("utf-8")
        assert line in output
