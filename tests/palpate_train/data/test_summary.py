"""Descriptions of sets: counts, losses, and reasons against training on them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate.core.types import Status
from palpate_train.cli.main import PROGRAM
from palpate_train.data import sets, summary
from tests.factories.recordings import record
from tests.factories.sweep_sets import easy, write


def command(*words: str) -> None:
    """The command `sets`."""
    args = PROGRAM.parser("sets").parse_args(["sets", *words])
    args.run(args)


def test_a_set_is_described():
    """Sweeps, format, materials, recordings, groups; long lists are shortened."""
    s = easy(20, pieces=2)
    s.groups["force"] = np.arange(60) % 12 * 10
    first, *more = summary.description(s)
    about = "60 sweeps of 0.64 s; 2x2 uint8 at 100 Hz, window 64"
    assert first == f"easy: {about}; digest {sets.digest(s)}"
    assert more == [
        "  recordings: 30, of 2 each",
        "  materials: 3: low 20, middle 20, high 20",
        "  force: 12: 0, 10, 20, 30, 40, 50, 60, 70, …, 110",
        "  speed: 4: 0, 1, 2, 3",
    ]
    assert "of 1 to 2 each" in "\n".join(summary.description(s.take(np.arange(1, 58))))


def test_what_is_confounded_is_told():
    """A single material at a value, or a single value; not a group of one value."""
    s = easy(4, pieces=8)
    s.groups.update(object=s.labels // 2, one=np.zeros(12, int))
    text = [
        "    confounded: one material only at 1",
        "    confounded: 'low' only at 0; without it the material cannot be trained on",
        "    confounded: 'middle' only at 0; without it the material cannot be trained on",
        "    confounded: 'high' only at 1; without it the material cannot be trained on",
    ]
    assert summary.description(s)[1:] == [
        "  recordings: 2, of 4 to 8 each",
        "    1 of them hold sweeps of several materials: number recordings within one material",
        "  materials: 3: low 4, middle 4, high 4",
        "  object: 2: 0, 1",
        *text,
        "  one: 1: 0",
        "  speed: 2: 0, 1",
        *text,
    ]


def test_positions_and_sessions_are_counted_in_tables():
    """Materials down, positions across, totals, a dot for none; not with many positions."""
    s = easy(4)
    s.groups.update(position=np.array([0, 0, 0, 10] + [10] * 8), speed=np.zeros(12, int))
    assert summary.description(s)[3:] == [
        "  position: 2: 0, 10",
        "    confounded: one material only at 0",
        "    confounded: 'middle' only at 10; without it the material cannot be trained on",
        "    confounded: 'high' only at 10; without it the material cannot be trained on",
        "            0  10  all",
        "    low     3   1    4",
        "    middle  ·   4    4",
        "    high    ·   4    4",
        "    all     3   9   12",
        "  speed: 1: 0",
    ]
    s.groups.update(session=s.labels, position=np.arange(12))
    assert "    all     4  4  4   12" in summary.description(s)
    assert "    low     1  1  1  1  ·  ·  ·  ·  ·  ·   ·   ·    4" in summary.description(s)
    many = easy(13)
    many.groups["position"] = np.arange(39) % 13
    first = [line.split()[0] for line in summary.description(many)]
    assert first == ["easy:", "recordings:", "materials:", "position:", "speed:"]


def test_recordings_are_described_by_name(tmp_path: Path):
    """Places by names and numbers; lost frames, left-out sweeps, verdicts."""
    for i in range(6):
        path = tmp_path / f"run{i // 3}" / f"{i}.npy"
        position = ("tip", "side", "tip")[i % 3]
        record(path, "ab"[i % 2], id=i, position=position, session="7", lost=i // 4)
    record(tmp_path / "run0" / "9.npy", "", Status.GAP, frames=0, lost=100)
    s = sets.load(str(tmp_path))
    assert summary.describe(str(tmp_path)).splitlines() == [
        f"{tmp_path} (left out: 1 gap): 6 sweeps of 0.16 s; 2x3 int16 at 50 Hz, window 8; "
        f"digest {sets.digest(s)}",
        "  recordings: 6, of 1 each",
        "  materials: 2: a 3, b 3",
        "  position: 2: side, tip",
        "         side  tip  all",
        "    a       1    2    3",
        "    b       1    2    3",
        "    all     2    4    6",
        "  session: 1: 7",
        "         7  all",
        "    a    3    3",
        "    b    3    3",
        "    all  6    6",
        "  frames lost: 2 of 48, in 2 sweeps, filled in from their neighbours",
    ]


def test_recordings_without_a_tare_are_told(tmp_path: Path):
    """Both kinds are counted if only some know the unloaded skin."""
    for i in range(5):
        record(tmp_path / f"{i}.npy", "ab"[i % 2], id=i)
    assert "warning" not in summary.describe(str(tmp_path))
    for i in range(5):
        path = tmp_path / f"{i}.json"
        rest = {"level": [[1.0] * 3] * 2, "noise": [[0.5] * 3] * 2}
        path.write_text(json.dumps(json.loads(path.read_text()) | {"unloaded": rest}))
        warning = f"  warning: {i + 1} sweeps know the unloaded skin and {4 - i} do not; "
        assert (warning in summary.describe(str(tmp_path))) == (i < 4)
        assert ("warning" in summary.describe(str(tmp_path))) == (i < 4)
    sets.load(str(tmp_path)).save(tmp_path / "whole.npz")
    assert "warning" not in summary.describe(str(tmp_path / "whole.npz"))


def test_recordings_are_described_while_they_grow(tmp_path: Path):
    """A single material, missing names: counted, with the reason against training."""
    record(tmp_path / "0.npy", "a", position="2")
    text = summary.describe(str(tmp_path)).splitlines()
    assert "  materials: 1: a 1" in text
    assert text[-1].startswith(f"  cannot be trained on yet: {tmp_path}: only one class, 'a'")
    record(tmp_path / "1.npy", "")
    text = summary.describe(str(tmp_path)).splitlines()
    assert "  materials: 2: (none) 1, a 1" in text
    assert "  position: 2: (none), 2" in text
    assert not any("session" in line for line in text)
    assert text[-1].startswith(f"  cannot be trained on yet: {tmp_path / '1.npy'}: has no ")
    record(tmp_path / "2.npy", status=Status.SHORT)
    (tmp_path / "0.npy").unlink()
    (tmp_path / "1.npy").unlink()
    with pytest.raises(FormatError, match="1 short"):
        summary.describe(str(tmp_path))


@pytest.mark.slow
def test_still_taxels_and_empty_materials_are_told(tmp_path: Path):
    """By row and column from 1, and by name; a good set has no such line."""
    sound = easy()
    assert summary.warnings_of(sound) == []
    still = sound.samples.copy()
    still[:, :, 0, -1] = 7
    broken = replace(sound, samples=still, materials=(*sound.materials, "ghost"))
    where = ".".join(map(str, (1, still.shape[3], *([still.shape[4]] if still.ndim == 5 else []))))
    taxels, materials = summary.warnings_of(broken)
    assert f"never change in any sweep: {where};" in taxels
    assert "ghost;" in materials
    broken.save(tmp_path / "broken.npz")
    assert "ghost" in summary.describe(str(tmp_path / "broken.npz")).split("warning", 1)[1]


def test_what_is_known_can_be_loaded():
    """Every simulated set has the stated number of sweeps (the large one: a scene's)."""
    stated = dict(re.findall(r"(sim:T-\S+) +(\d+) sweeps", summary.known()))
    sizes = {"sim:T-LAB": "240", "sim:T-REAL": "540", "sim:T-HARD": "60", "sim:T-HARD:1-20": "1200"}
    assert stated == sizes
    assert len(sets.load("sim:T-LAB", 1001)) == 240
    assert len(sets.load("sim:T-HARD:1001-1002")) == 120


@pytest.mark.slow
def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """`sets` lists, `describe` describes several, `view` writes a picture."""
    command()
    assert capsys.readouterr().out == summary.known() + "\n"
    one = write(tmp_path / "a.npz")
    command("describe", one, "sim:T-HARD:1001:1")
    first, second = capsys.readouterr().out.split("\n\n")
    assert first.startswith("a.npz: 6 sweeps")
    assert second.startswith("sim:T-HARD:1001:1: 6 sweeps")
    command("view", one, "--number", "2", "--out", str(tmp_path / "new" / "a.svg"))
    assert capsys.readouterr().out == f"{tmp_path}/new/a.svg\n"
    assert (tmp_path / "new" / "a.svg").read_text().startswith("<svg")
