"""palpate-train import as users call it: the commands of its page, its report, its exit codes."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from appliance.sim import skin
from tests.factories.lab_files import csv_folder, write
from tests.factories.paths import ROOT
from train.cli.main import main
from train.data import sets

PAGE = (ROOT / "docs" / "how-to" / "import.md").read_text()


def five() -> list[list[str]]:
    """The commands of the page, split as a shell splits them."""
    (block,) = re.findall(r"<!-- five -->\n(.*?)<!-- /five -->", PAGE, re.S)
    return [shlex.split(line) for line in block.splitlines()]


@pytest.mark.slow
@pytest.mark.thorough  # a whole way to a bundle
def test_the_five_commands_of_the_page_make_a_bundle(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
):
    """The commands of the page on simulated sweeps written as CSV: the sweeps come back, most of
    the rest get the right label, and no library prints anything."""
    monkeypatch.chdir(tmp_path)
    folder = csv_folder(tmp_path / "recordings", each=3, positions=6)
    assert (folder / "wood_p0_1.csv").read_text().splitlines()[0] in PAGE
    commands = five()
    assert len(commands) == 5
    for program, *args in commands:
        assert program == "palpate-train"
        assert main(args) == 0, capsys.readouterr()
    made = sets.load("build/mine.npz")
    samples, labels, position = skin.sweep_set("T-REAL", 5, 3)
    expected = samples[(labels < 3) & (position < 6)]
    assert len(made) == len(expected) == 54
    assert {s.tobytes() for s in made.samples} == {s.tobytes() for s in expected}
    out, err = capsys.readouterr()
    assert [*caplog.messages, *re.findall(".*[Ww]arning.*|.*Gemm.*", err)] == []
    assert "they also helped to choose the model" in out
    assert (
        "which no part of the fit has seen; after export: "
        "palpate-train score BUNDLE --set build/rest.npz\n" in out
    )
    assert (
        f"to score it on the sweeps that fit --split left out: {shlex.join(commands[-1])}\n" in out
    )
    assert "left out: README.md: its name does not match the pattern" in out
    found = re.search(r"named rightly: (\d+) of 18: ", out)
    assert found
    assert int(found[1]) >= 12


def test_a_broken_file_is_told_and_the_others_are_imported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """A broken file gets a line; the other files make a set; the report has a line for each file;
    the exit code is 65."""
    folder = csv_folder(tmp_path / "r", each=1, positions=1)
    (folder / "foam_p0_1.csv").write_text("time,s0\n0,1\n0,x\n")
    args = [
        "import",
        str(folder),
        "--pattern",
        "{material}_p{position:d}_{trial:d}.csv",
        "--time",
        "time:ms",
        "--grid",
        "4x4",
    ]
    args += ["--out", str(tmp_path / "s.h5"), "--report", str(tmp_path / "report.txt")]
    assert main(args) == 65
    told = capsys.readouterr()
    assert "left out: foam_p0_1.csv: line 3, column 2 is 'x', which is not a number" in told.out
    assert told.err.splitlines()[-1].startswith(
        "palpate-train: 1 of 4 files could not be used, as said above"
    )
    assert len(sets.load(str(tmp_path / "s.h5"))) == 3
    report = dict(line.split("\t") for line in (tmp_path / "report.txt").read_text().splitlines())
    assert report["metal_p0_1.csv"] == "taken: 1 windows of 2100 frames"
    assert report["foam_p0_1.csv"].startswith("left out: line 3, column 2")
    assert report.keys() == {path.name for path in folder.iterdir()}


def test_what_fails_the_same_way_is_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Five lines for twelve files, and one line for the others; only the report is written."""
    for k in range(12):
        write(tmp_path / "r" / f"wood_{k:02}.csv", np.zeros((9, 4)), 100.0)
    args = [
        "import",
        str(tmp_path / "r"),
        "--pattern",
        "{material}_{trial}.csv",
        "--rate",
        "100",
        "--grid",
        "4x4",
    ]
    args += ["--out", str(tmp_path / "s.npz"), "--report", str(tmp_path / "report.txt")]
    assert main(args) == 65
    told = capsys.readouterr()
    assert told.out.count("left out: ") == 6
    assert (
        "left out: 7 more for the same reason: it has 5 columns, but a grid of 4x4 needs 16"
        in told.out
    )
    assert "none of 12 files could be imported" in told.err
    assert not (tmp_path / "s.npz").exists()
    assert len((tmp_path / "report.txt").read_text().splitlines()) == 12


@pytest.mark.skipif(
    "PALPATE_DATA" not in os.environ, reason="PALPATE_DATA names no folder of real sweeps"
)
@pytest.mark.slow
def test_real_sweeps_come_back_from_csv(tmp_path: Path):
    """FabricSlide with each window as a CSV file, with force and speed in its name: the same counts
    and groups come back."""
    real = sets.load(str(Path(os.environ["PALPATE_DATA"]) / "fabricslide" / "fabricslide.npz"))
    real = real.take(np.arange(len(real)) % 20 == 0)
    for i, counts in enumerate(real.samples):
        force, speed = real.groups["force"][i], real.groups["speed"][i]
        name = f"{real.materials[real.labels[i]]}/{force}_{speed}_{i}.csv"
        write(tmp_path / "r" / name, counts.reshape(len(counts), -1), real.rate_hz)
    args = [
        "import",
        str(tmp_path / "r"),
        "--pattern",
        "{material}/{force:d}_{speed:d}_{number:d}.csv",
        "--time",
        "time:ms",
    ]
    args += [
        "--grid",
        "16x1",
        "--window",
        "128",
        "--dtype",
        real.samples.dtype.name,
        "--out",
        str(tmp_path / "s.npz"),
    ]
    assert main(args) == 0
    made = sets.load(str(tmp_path / "s.npz"))
    order = np.argsort(made.groups["number"])
    assert made.rate_hz == pytest.approx(real.rate_hz, rel=0.005)
    np.testing.assert_array_equal(made.samples[order], real.samples)
    for group in ("force", "speed"):
        np.testing.assert_array_equal(made.groups[group][order], real.groups[group])
    assert [made.materials[k] for k in made.labels[order]] == [
        real.materials[k] for k in real.labels
    ]


def test_a_folder_that_may_not_be_read_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The message names the cause instead of an empty result."""

    def denied(self: Path) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", denied)
    out = str(tmp_path / "x.npz")
    assert (
        main(
            ["import", str(tmp_path), "--pattern", "{material}.csv", "--rate", "100", "--out", out]
        )
        == 65
    )
    assert "the folder cannot be read: Permission denied" in capsys.readouterr().err
