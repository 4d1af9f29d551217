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


def told(sweeps: sets.Dataset) -> dict[str, list[str]]:
    """The lines of a description that name a property, as its name and the parts of its text."""
    lines = [line[2:] for line in summary.description(sweeps)[1:] if line[2] != " "]
    return {line.partition(": ")[0]: line.partition(": ")[2].split(", ") for line in lines}


def test_a_set_is_described_with_what_is_confounded():
    """Format, materials, groups; a material or value alone; long lists are shortened."""
    s = easy(20, pieces=2)
    s.groups["force"] = np.arange(60) % 12 * 10
    first, *_ = summary.description(s)
    assert first == f"easy: 60 sweeps of 0.64 s; {s.format}; digest {sets.digest(s)}"
    assert told(s) == {
        "recordings": ["30", "of 2 each"],
        "materials": ["3: low 20", "middle 20", "high 20"],
        "force": ["12: 0", *map(str, range(10, 80, 10)), "…", "110"],
        "speed": ["4: 0", "1", "2", "3"],
    }
    assert told(s.take(np.arange(1, 58)))["recordings"][1] == "of 1 to 2 each"
    s = easy(4, pieces=8)
    s.groups.update(object=s.labels // 2, one=np.zeros(12, int))
    every = summary.description(s)
    places = ("one material only at 1", "'low' only at 0", "'middle' only at 0", "'high' only at 1")
    for group in ("object", "speed"):
        start = next(i for i, line in enumerate(every) if line.startswith(f"  {group}: "))
        for line, place in zip(every[start + 1 : start + 5], places, strict=True):
            assert line.startswith(f"    confounded: {place}")
    assert len([line for line in every if "confounded" in line]) == 8
    assert told(s)["one"] == ["1: 0"]
    assert any(line.startswith("    1 of them hold") for line in every)


def test_positions_and_sessions_are_counted_in_tables():
    """Materials down, positions across, totals, a dot for none; not with many positions."""
    s = easy(4)
    s.groups.update(position=np.array([0, 0, 0, 10] + [10] * 8), speed=np.zeros(12, int))
    table = summary.description(s)[-6:-1]
    assert [line.split() for line in table] == [
        ["0", "10", "all"],
        ["low", "3", "1", "4"],
        ["middle", "·", "4", "4"],
        ["high", "·", "4", "4"],
        ["all", "3", "9", "12"],
    ]
    assert len({*map(len, table)}) == 1  # numbers end below each other
    s.groups.update(session=s.labels, position=np.arange(12))
    rows = [line.split() for line in summary.description(s)]
    assert ["all", "4", "4", "4", "12"] in rows
    assert ["low", *"1111", *"··" * 4, "4"] in rows
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
    *described, lost = summary.describe(str(tmp_path)).splitlines()
    assert described == summary.description(s)
    assert described[0].startswith(f"{tmp_path} (left out: 1 gap): 6 ")
    assert told(s)["position"] == ["2: side", "tip"]
    rows = [line.split() for line in described]
    assert ["a", "1", "2", "3"] in rows
    assert ["all", "6", "6"] in rows
    assert lost.startswith("  frames lost: 2 of 48, ")


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
    assert text[-1].endswith("a classifier needs two")
    record(tmp_path / "1.npy", "")
    text = summary.describe(str(tmp_path)).splitlines()
    assert any("2: (none) 1, a 1" in line for line in text)
    assert "  position: 2: (none), 2" in text
    assert not any("session" in line for line in text)
    assert f"{tmp_path / '1.npy'}: has no " in text[-1]
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
    assert f": {where};" in taxels
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

    def command(*words: str) -> None:
        """The command `sets`."""
        args = PROGRAM.parser("sets").parse_args(["sets", *words])
        args.run(args)

    command()
    assert capsys.readouterr().out == summary.known() + "\n"
    one = write(tmp_path / "a.npz")
    names = (one, "sim:T-HARD:1001:1")
    command("describe", *names)
    for name, said in zip(names, capsys.readouterr().out.split("\n\n"), strict=True):
        assert said.startswith(f"{name.rpartition('/')[2]}: 6 sweeps")
    command("view", one, "--number", "2", "--out", str(tmp_path / "new" / "a.svg"))
    assert capsys.readouterr().out == f"{tmp_path}/new/a.svg\n"
    assert (tmp_path / "new" / "a.svg").read_text().startswith("<svg")
