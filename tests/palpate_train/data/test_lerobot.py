"""LeRobot sets 2.1 and 3.0: episodes become recordings, tasks materials; 3.0 is written."""

import json
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from palpate.core.types import SweepFormat
from palpate_train.cli.main import main
from palpate_train.data import lerobot_writer, sets
from tests.factories import lerobot as environment
from tests.factories.foreign_files import COUNTS, TASKS, lerobot_set


def imported(folder: Path, *more: str) -> int:
    return main(
        ["import", str(folder), "--out", str(folder.parent / "s.npz"), "--window", "20", *more]
    )


MATERIAL = ("--field", "material=task", "--rename", f"{TASKS[0]}=wood")
MATERIAL += ("--rename", f"{TASKS[1]}=felt")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_tactile_columns_become_sweeps(tmp_path: Path, version: str):
    """Rate, grid and materials come from the set; other columns can be groups."""
    folder = lerobot_set(tmp_path / "set", version)
    more = ("--field", "session=operator", "--field", "trial=episode_index")
    assert imported(folder, *MATERIAL, *more) == 0
    made = sets.load(str(tmp_path / "s.npz"))
    assert made.format == SweepFormat(2, 3, 30.0, 20, "int16")
    assert [made.materials[k] for k in made.labels] == ["wood", "felt", "wood", "felt"]
    assert made.groups["session"].tolist() == ["Ada", "Ada", "Bob", "Bob"]
    assert made.groups["trial"].tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(made.samples, COUNTS[:, 20:40])


def test_the_times_of_the_set_can_be_used(tmp_path: Path):
    """--time timestamp:s, with the float32 times that LeRobot writes."""
    folder = lerobot_set(tmp_path / "set", "v3.0")
    assert imported(folder, *MATERIAL, "--time", "timestamp:s") == 0
    np.testing.assert_array_equal(sets.load(str(tmp_path / "s.npz")).samples, COUNTS[:, 20:40])


def test_a_feature_is_named_where_several_are_tactile(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The features of numbers are listed with their shapes."""
    more = {"observation.touch_left": {"dtype": "float32", "shape": [4]}}
    folder = lerobot_set(tmp_path / "set", "v3.0", **more)
    assert imported(folder, *MATERIAL) == 65
    told = capsys.readouterr().err
    assert "2 tactile features" in told
    assert "tactile [2, 3]" in told
    assert imported(folder, *MATERIAL, "--variable", "observation.tactile") == 0


FIVE = COUNTS.reshape(4, 60, 6)[:, :, :5].repeat(4, axis=2) + np.arange(20)
"""Rows of five frames of a 2x2 skin each."""


def of_windows(folder: Path, rows: np.ndarray, name: str = "tactile") -> Path:
    """A set whose rows [episode, row, frame, taxel] hold several frames each."""
    pa, parquet = (pytest.importorskip(one) for one in ("pyarrow", "pyarrow.parquet"))
    lerobot_set(folder, "v2.1")
    info = json.loads((folder / "meta/info.json").read_text())
    del info["features"]["observation.tactile"]
    info["features"][name] = {"dtype": "float32", "shape": list(rows.shape[2:]), "names": None}
    (folder / "meta/info.json").write_text(json.dumps(info))
    for k, path in enumerate(sorted(folder.glob("data/*/*.parquet"))):
        table = parquet.read_table(path).append_column(name, pa.array(rows[k].tolist()))
        parquet.write_table(table, path)
    return folder


@pytest.mark.parametrize("name", ["tactile", "tactile_window", "skin.history", "touch.times"])
def test_a_row_can_hold_several_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
):
    """Their grid says so, and the rate follows; without it the shape is asked for, or said."""
    rows = FIVE.reshape(4, 60, 5, 4)
    folder = of_windows(tmp_path / "set", rows, name)
    asked = imported(folder, *MATERIAL) == 65
    out = capsys.readouterr()
    assert "[5, 4]" in (out.err if asked else out.out)
    assert asked == (name != "tactile")
    assert imported(folder.parent, *MATERIAL) == 65
    assert f"{folder} in it is a LeRobot data set" in capsys.readouterr().err
    assert imported(folder, *MATERIAL, "--grid", "2x2") == 0
    made = sets.load(str(tmp_path / "s.npz"))
    assert (made.format.rate_hz, made.samples.shape) == (150, (4, 20, 2, 2))
    whole = rows.reshape(4, 300, 2, 2)
    np.testing.assert_array_equal(made.samples, whole[:, 140:160])
    assert imported(folder, *MATERIAL, "--grid", "5x4") == 0
    assert sets.load(str(tmp_path / "s.npz")).format.rate_hz == 30


def test_rows_that_repeat_frames_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Each row repeats four of its five frames: the skin is not five times as fast."""
    series = FIVE.reshape(4, 300, 4)
    rows = np.stack([series[:, k : k + 5] for k in range(60)], axis=1)
    folder = of_windows(tmp_path / "set", rows)
    assert imported(folder, *MATERIAL, "--grid", "2x2") == 65
    assert "--columns 17-20" in capsys.readouterr().err
    assert imported(folder, *MATERIAL, "--grid", "2x2", "--columns", "17-20") == 0


def test_an_episode_that_lacks_a_frame_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """A row that was filtered out would be spliced over."""
    folder = lerobot_set(tmp_path / "set", "v3.0")
    parquet = pytest.importorskip("pyarrow.parquet")
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    whole = parquet.read_table(path)
    pa = pytest.importorskip("pyarrow")
    parquet.write_table(pa.concat_tables([whole.slice(0, 70), whole.slice(71)]), path)
    assert imported(folder, *MATERIAL) == 65
    assert "episode 1 lacks" in capsys.readouterr().err


def written(folder: Path) -> sets.Dataset:
    """A simulated set of three materials that is written as the data set `folder`."""
    whole = sets.load("sim:T-REAL:1:1").select(["material=foam,metal,wood", "position<=1"])
    whole.save(folder.with_suffix(".npz"))
    assert main(["sets", "lerobot", str(folder.with_suffix(".npz")), str(folder)]) == 0
    return whole


def test_a_set_is_written_and_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Sweeps, type, rate, materials and groups stay; also with several files."""
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(lerobot_writer, "FILE_BYTES", 4 * 24000)
    whole = written(tmp_path / "set")
    assert len(list((tmp_path / "set" / "data").rglob("*.parquet"))) == 2
    out = tmp_path / "back.npz"
    more = ("--field", "material=task", "--field", "position=position")
    assert main(["import", str(tmp_path / "set"), *more, "--out", str(out)]) == 0
    back = sets.load(str(out))
    np.testing.assert_array_equal(back.samples, whole.samples)
    assert back.format == whole.format
    names, same = ([s.materials[k] for k in s.labels] for s in (back, whole))
    assert names == same
    assert back.groups["position"].tolist() == whole.groups["position"].tolist()


@pytest.mark.slow
def test_lerobot_itself_reads_a_written_set(tmp_path: Path):
    """Frames at neighbouring times, tasks, groups and statistics."""
    by_lerobot = dedent("""
    import json, sys
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    first, second = 0, 1 / 750
    whole = LeRobotDataset("own/set", root=sys.argv[1])
    part = LeRobotDataset("own/set", root=sys.argv[1], episodes=[5],
                          delta_timestamps={"observation.tactile": [first, second]})
    print(json.dumps({
        "size": [whole.num_episodes, len(whole), whole.fps],
        "tasks": [part[0]["task"], whole[0]["task"]],
        "two frames": part[0]["observation.tactile"].tolist(),
        "position": int(part[0]["position"]),
        "mean": whole.meta.stats["observation.tactile"]["mean"].tolist(),
        "normal": whole.meta.stats["observation.tactile"]["std"].shape,
    }))
    """)
    environment.required()
    pytest.importorskip("pyarrow")
    whole = written(tmp_path / "set")
    found = environment.run(by_lerobot, tmp_path / "set")
    assert found["size"] == [6, 9000, 750]
    assert found["tasks"] == [whole.materials[whole.labels[k]] for k in (5, 0)]
    assert found["two frames"] == whole.samples[5, :2].tolist()
    assert found["position"] == whole.groups["position"][5]
    np.testing.assert_allclose(found["mean"], whole.samples.mean(axis=(0, 1)))
    assert found["normal"] == [4, 4]


@pytest.mark.parametrize(
    ("group", "folder", "why"),
    [
        ("timestamp", "new", "'timestamp'"),
        ("person", "s.npz", "already"),
        ("person", "no/new", "folder"),
    ],
)
def test_a_set_that_cannot_be_written_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], group: str, folder: str, why: str
):
    """Nothing is written."""
    samples = np.arange(2 * 9 * 4, dtype=np.uint8).reshape(2, 9, 2, 2)
    people = {group: np.array(["Ada", "Bob"])}
    made = sets.Dataset(samples, np.array([0, 1]), ("felt", "wood"), 12.5, people)
    made.save(tmp_path / "s.npz")
    out = tmp_path / folder
    assert main(["sets", "lerobot", str(tmp_path / "s.npz"), str(out)]) == 65
    assert why in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s.npz"]


def test_names_and_a_broken_rate_are_written(tmp_path: Path):
    """Groups of names are texts, which have no statistics."""
    pytest.importorskip("pyarrow")
    samples = np.arange(2 * 9 * 4, dtype=np.float32).reshape(2, 9, 2, 2)
    people = {"person": np.array(["Ada", "Bob"]), "force": np.array([0.5, 1.5])}
    made = sets.Dataset(samples, np.array([0, 1]), ("felt", "wood"), 12.5, people)
    lerobot_writer.write(made, tmp_path / "set")
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    assert info["fps"] == 12.5
    assert info["features"]["person"] == {"dtype": "string", "shape": [1], "names": None}
    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    assert "person" not in stats
    assert (stats["force"]["min"], stats["force"]["q50"], stats["force"]["count"]) == (
        [0.5],
        [1.0],
        [18],
    )
