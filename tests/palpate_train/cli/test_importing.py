"""palpate-train import as users call it: the commands of its page, its report, its exit codes."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from palpate.sim import skin
from palpate_train.cli.main import main
from palpate_train.data import sets
from tests.factories.lab_files import csv_folder, write
from tests.factories.paths import ROOT


def test_names_of_files_forge_no_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Escape sequences and line breaks are shown as one printable line."""
    evil = "\x1b[2J\n\x9b1mtaken: 9 files\u202e"
    folder, report = tmp_path / "recordings", tmp_path / "report.txt"
    folder.mkdir()
    for name in ("wood_1", f"wool_{evil}", f"broken_{evil}", evil):
        rows = "1,2,3,4\n" * 40 if "broken" not in name else f"{evil}\n1,2\n"
        (folder / f"{name}.csv").write_text(rows)
    out = str(tmp_path / "set.npz")
    words = ["--pattern", "{material}_{trial}.csv", "--grid", "2x2", "--rate", "20"]
    main(["import", str(folder), *words, "--out", out, "--report", str(report)])
    main(["sets", "describe", out])
    told = capsys.readouterr()
    lines = (told.out + told.err + report.read_text()).replace("\t", " ").splitlines()
    assert [line for line in lines if not line.isprintable()] == []
    assert [line for line in lines if line.startswith(("taken: 9", "?1mtaken"))] == []
    assert sum("?[2J??1mtaken" in line for line in lines) >= 3


@pytest.mark.slow
@pytest.mark.thorough  # a whole way to a bundle
def test_the_five_commands_of_the_page_make_a_bundle(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
):
    """Sweeps come back, most labels are right."""
    page = (ROOT / "docs" / "how-to" / "import.md").read_text()

    def five() -> list[list[str]]:
        """The commands of the page, split as a shell splits them."""
        (block,) = re.findall(r"<!-- five -->\n(.*?)<!-- /five -->", page, re.S)
        return [shlex.split(line) for line in block.splitlines()]

    monkeypatch.chdir(tmp_path)
    folder = csv_folder(tmp_path / "recordings", each=3, positions=6)
    assert (folder / "wood_p0_1.csv").read_text().splitlines()[0] in page
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
    warned = [line for line in re.findall(".*[Ww]arning.*|.*Gemm.*", err) if "the mean" not in line]
    assert [*caplog.messages, *warned] == []
    assert "helped to" in out
    assert "build/rest.npz" in out
    next_commands = out.partition("next:\n")[2].splitlines()[:3]
    assert [line.split()[:2] for line in next_commands] == [
        ["palpate-train", name] for name in ("export", "score", "report")
    ]
    assert all("--set build/rest.npz" in line for line in next_commands[1:])
    assert f": {shlex.join(commands[-1])}\n" in out
    assert "README.md" in out
    found = re.search(r"classified correctly: (\d+) of 18: ", out)
    assert found
    assert int(found[1]) >= 12


def test_a_broken_file_is_told_and_the_others_are_imported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """A line for each file in the report; the others make a set; exit code 65."""
    folder = csv_folder(tmp_path / "r", each=1, positions=1)
    (folder / "foam_p0_1.csv").write_text("time,s0\n0,1\n0,x\n")
    options = "--pattern {material}_p{position:d}_{trial:d}.csv --time time:ms --grid 4x4"
    args = ["import", str(folder), *options.split()]
    args += ["--out", str(tmp_path / "s.h5"), "--report", str(tmp_path / "report.txt")]
    assert main(args) == 65
    told = capsys.readouterr()
    assert "line 3, column 2 is 'x'" in told.out
    assert "1 of 4" in told.err.splitlines()[-1]
    assert len(sets.load(str(tmp_path / "s.h5"))) == 3
    report = dict(line.split("\t") for line in (tmp_path / "report.txt").read_text().splitlines())
    assert report["metal_p0_1.csv"].startswith("taken: 1 windows of 2100")
    assert "out: line 3, column 2" in report["foam_p0_1.csv"]
    assert report.keys() == {path.name for path in folder.iterdir()}


def test_what_fails_the_same_way_is_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Five lines for twelve files, and one line for the others; only the report is written."""
    for k in range(12):
        write(tmp_path / "r" / f"wood_{k:02}.csv", np.zeros((9, 4)), 100.0)
    options = "--pattern {material}_{trial}.csv --rate 100 --grid 4x4"
    args = ["import", str(tmp_path / "r"), *options.split()]
    args += ["--out", str(tmp_path / "s.npz"), "--report", str(tmp_path / "report.txt")]
    assert main(args) == 65
    told = capsys.readouterr()
    assert told.out.count("left out: ") == 6
    assert "7 more" in told.out
    assert "12 files" in told.err
    assert not (tmp_path / "s.npz").exists()
    assert len((tmp_path / "report.txt").read_text().splitlines()) == 12


SMALL = "--rate 100 --grid 2x2 --window 10"


def imported(folder: Path, *more: str) -> int:
    """palpate-train import of four taxels at 100 Hz with windows of ten frames."""
    out = str(folder.parent / "s.npz")
    return main(["import", str(folder), *SMALL.split(), "--out", out, *more])


def nine(folder: Path, suffix: str = "csv") -> Path:
    """Eight files whose counts all differ; the ninth is missing."""
    folder.mkdir()
    for k in range(8):
        counts = 7 * np.arange(160).reshape(40, 4) % 150 + k
        np.savetxt(folder / f"{'wood' if k % 2 else 'felt'}_{k}.{suffix}", counts, "%d", ",")
    return folder


BAD_NINTH = {
    "NULs": b"1,2,3,4\n" * 9 + bytes(4096) + b"\n" + b"1,2,3,4\n" * 9,
    "a cell of 256 kB": b"1,2,3,4\n" * 9 + b"1," + b"x" * 262144 + b",3,4\n" + b"1,2,3,4\n" * 9,
    "a quote that is not closed": b'1,2,3,4\n"1,2,3,4\n' + b"1,2,3,4\n" * 20,
    "thousands": b"1,012;987;3;4\n" * 20,
    "binary": bytes(range(256)) * 40,
}


@pytest.mark.parametrize("name", BAD_NINTH)
def test_one_bad_file_of_nine_is_left_out_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
):
    """The set is of the other eight; exit code 65."""
    folder = nine(tmp_path / "r")
    (folder / "wood_9.csv").write_bytes(BAD_NINTH[name])
    assert imported(folder, "--pattern", "{material}_{trial}.csv") == 65
    told = capsys.readouterr()
    (line,) = [line for line in told.out.splitlines() if line.startswith("left out")]
    assert line.startswith("left out: wood_9.csv: ")
    assert len(line) < 200
    assert "Traceback" not in told.err
    assert len(sets.load(str(tmp_path / "s.npz"))) == 8


def test_files_of_the_system_are_passed_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """macOS, Windows and Office leave files that match the pattern; not a word is said."""
    folder = nine(tmp_path / "r")
    names = "._wood_1.csv __MACOSX/._wood_1.csv __MACOSX/wood_1.csv ~$wood_2.csv .DS_Store"
    names += " sub/._felt_3.csv .ipynb_checkpoints/wood_3.csv Thumbs.db desktop.ini"
    for name in names.split():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"\0\5\26\7")
    assert imported(folder, "--pattern", "{material}_{trial}.csv") == 0
    assert "left out: 0" in capsys.readouterr().out


def test_what_was_passed_over_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A footer: the file, the line and its text, on the screen and in the report."""
    folder = nine(tmp_path / "r")
    with (folder / "wood_1.csv").open("a") as file:
        file.write("@@\n")
    given = ("--pattern", "{material}_{trial}.csv", "--report", str(tmp_path / "report.txt"))
    assert imported(folder, *given) == 0
    assert "line 41, which is '@@'" in capsys.readouterr().out
    assert "to line 41" in (tmp_path / "report.txt").read_text()


def test_names_are_equal_in_every_normal_form(tmp_path: Path):
    """A decomposed ö in a file's name, in --rename and in --pattern is the composed one."""
    folder = tmp_path / "r"
    folder.mkdir()
    for k, name in enumerate(("ko\u0308per", "k\u00f6per", "felt")):
        np.savetxt(folder / f"{name}_{k}.csv", np.arange(160).reshape(40, 4) + k, "%d", ",")
    for old in ("k\u00f6per", "ko\u0308per"):
        given = ("--pattern", "{material}_{trial}.csv", "--rename", f"{old}=twill")
        assert imported(folder, *given) == 0
        made = sets.load(str(tmp_path / "s.npz"))
        assert made.materials == ("felt", "twill")
        assert len(made) == 3


def test_the_same_content_counts_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A copy, in another format too, is left out; under another material it is warned of."""
    folder = nine(tmp_path / "r")
    content = (folder / "wood_1.csv").read_bytes()
    (folder / "wood_1copy.csv").write_bytes(content)
    (folder / "wood_1b.csv").write_bytes(content.replace(b",", b";"))
    (folder / "felt_1c.csv").write_bytes(content)
    assert imported(folder, "--pattern", "{material}_{trial}.csv") == 0
    told = capsys.readouterr().out
    assert "felt_1c.csv, of felt" in told
    made = sets.load(str(tmp_path / "s.npz"))
    assert len(made) == 9
    (folder / "felt_1c.csv").unlink()
    assert imported(folder, "--pattern", "{material}_{trial}.csv") == 0
    told = capsys.readouterr().out
    assert "wood_1b.csv" in told
    assert "wood_1copy.csv" in told
    assert len(sets.load(str(tmp_path / "s.npz"))) == 8


def test_columns_give_material_and_session(tmp_path: Path):
    """A label and a date beside the counts: each run of a label is a recording."""
    folder = tmp_path / "r"
    folder.mkdir()
    rows = ["when,what,a,b,c,d"]
    for k in range(120):
        label = ("wood", "felt", "wood")[k // 40]
        rows.append(f"2026-01-{10 + k // 80} 10:00:{k / 100:05.2f},{label},{k},{k + 1},{k},0")
    (folder / "all.csv").write_text("\n".join(rows))
    given = ("--field", "material=what", "--field", "session=when", "--time", "when:date")
    assert imported(folder, *given) == 0
    made = sets.load(str(tmp_path / "s.npz"))
    assert [made.materials[k] for k in made.labels] == ["wood", "felt", "wood"]
    assert made.groups["session"].tolist() == ["2026-01-10", "2026-01-10", "2026-01-11"]
    assert made.groups["recording"].tolist() == [0, 1, 2]
    np.testing.assert_array_equal(made.samples[0, :, 0, 0], np.arange(15, 25))


@pytest.mark.slow
def test_a_terminal_without_unicode_shows_replaced_characters(tmp_path: Path):
    """A file whose name is not even UTF-8, on a terminal that knows only ASCII: no traceback."""
    folder = nine(tmp_path / "r")
    (folder / "k\u00f6per_\u2713.txt").write_text("nothing")
    os.close(os.open(os.fsencode(folder) + b"/k\xf6per.txt", os.O_CREAT))
    words = ["import", str(folder), "--pattern", "{material}_{trial}.csv", *SMALL.split()]
    words += ["--out", str(tmp_path / "s.npz"), "--report", str(tmp_path / "report.txt")]
    done = subprocess.run(
        [sys.executable, "-m", "palpate_train", *words],
        cwd=ROOT,
        env={**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        check=False,
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"left out: k?per_?.txt: its name does not match the pattern" in done.stdout


def test_labels_in_a_separate_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """By path or name; files without a label are left out, a missing file is a fault."""
    table = "file;material;force\na/1.csv;felt;5N\n2.csv;cork;2.5N\n3.csv;felt;5N\nno.csv;cork;5N\n"
    for name in ("a/1", "b/2", "b/3", "b/4"):
        counts = np.random.default_rng(int(name[-1])).integers(0, 99, (30, 4))
        (tmp_path / name).parent.mkdir(exist_ok=True)
        np.savetxt(tmp_path / f"{name}.csv", counts, "%d", ",")
    (tmp_path / "labels.csv").write_text(table)
    out = tmp_path.parent / "made.npz"
    given = ("--rate", "100", "--grid", "2x2", "--window", "10", "--out", str(out))
    labels = ("--labels", str(tmp_path / "labels.csv"), "--pattern", "{session}/{}.csv")
    assert main(["import", str(tmp_path), *labels, *given]) == 65
    made = sets.load(str(out))
    assert [made.materials[k] for k in made.labels] == ["felt", "cork", "felt"]
    assert made.groups["force"].tolist() == [5, 2.5, 5]
    assert made.groups["session"].tolist() == ["a", "b", "b"]
    said = capsys.readouterr().out
    for name in ("b/4.csv", "labels.csv", "no.csv"):
        assert f"left out: {name}" in said


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "first line"),
        ("file\n1.csv\n", "first line"),
        ("file,material,material\n1.csv,a,b\n", "first line"),
        ("file,material\n1.csv,a\n1.csv,b\n", "row 3"),
        ("file,material\n1.csv,\n", "row 2"),
        ("file,material\n1.csv,a,b\n", "row 2"),
        ("file,position\n1.csv,3\n", "material"),
    ],
)
def test_tables_of_labels_that_cannot_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, why: str
):
    """Before anything is imported."""
    (tmp_path / "labels.csv").write_text(text)
    given = ("--rate", "100", "--grid", "2x2", "--out", str(tmp_path / "a.npz"))
    assert main(["import", str(tmp_path), "--labels", str(tmp_path / "labels.csv"), *given]) == 65
    assert why in capsys.readouterr().err


def test_the_folder_comes_before_the_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A file, or a name without a folder, is the first thing that is wrong."""
    assert main(["import", str(tmp_path / "none"), "--out", str(tmp_path / "s.npz")]) == 65
    assert "not a folder" in capsys.readouterr().err
