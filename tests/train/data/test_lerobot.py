"""LeRobot data sets: episodes become recordings, tasks become materials; versions 2.1 and 3.0."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from train.cli.main import main
from train.data import sets

COUNTS = np.arange(4 * 60 * 6, dtype=np.float32).reshape(4, 60, 2, 3) % 997
TASKS = ("slide over wood", "slide over felt")


def data_set(folder: Path, version: str, **features: Any) -> Path:
    """Four episodes of 60 frames at 30 Hz of a 2x3 skin; the task of an episode alternates."""
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    skin = {"observation.tactile": {"dtype": "float32", "shape": [2, 3], "names": None}}
    arm = {"observation.state": {"dtype": "float32", "shape": [6], "names": None}}
    camera = {"observation.images.touch": {"dtype": "video", "shape": [480, 640, 3]}}
    info = {"codebase_version": version, "fps": 30, "features": skin | arm | camera | features}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    tables = [
        pa.table(
            {
                "observation.state": np.zeros((60, 6)).tolist(),
                "observation.tactile": frames.tolist(),
                "timestamp": np.arange(60, dtype=np.float32) / 30,
                "frame_index": np.arange(60),
                "episode_index": np.full(60, k),
                "task_index": np.full(60, k % 2),
                "operator": ["Ada" if k < 2 else "Bob"] * 60,
            }
        )
        for k, frames in enumerate(COUNTS)
    ]
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if version == "v3.0":
        parquet.write_table(pa.concat_tables(tables), chunk / "file-000.parquet")
        tasks = pa.table({"task_index": [0, 1], "__index_level_0__": list(TASKS)})
        parquet.write_table(tasks, folder / "meta" / "tasks.parquet")
        return folder
    for k, table in enumerate(tables):
        parquet.write_table(table, chunk / f"episode_{k:06}.parquet")
    lines = [json.dumps({"task_index": k, "task": text}) + "\n" for k, text in enumerate(TASKS)]
    (folder / "meta" / "tasks.jsonl").write_text("".join(lines))
    return folder


def imported(folder: Path, *more: str) -> int:
    return main(
        ["import", str(folder), "--out", str(folder.parent / "s.npz"), "--window", "20", *more]
    )


MATERIAL = (
    "--field",
    "material=task",
    "--rename",
    f"{TASKS[0]}=wood",
    "--rename",
    f"{TASKS[1]}=felt",
)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_tactile_columns_become_sweeps(tmp_path: Path, version: str):
    """Rate, grid and materials come from the set; other columns can be groups."""
    folder = data_set(tmp_path / "set", version)
    more = ("--field", "session=operator", "--field", "trial=episode_index")
    assert imported(folder, *MATERIAL, *more) == 0
    made = sets.load(str(tmp_path / "s.npz"))
    assert str(made.format) == "2x3 int16 at 30 Hz, window 20"
    assert [made.materials[k] for k in made.labels] == ["wood", "felt", "wood", "felt"]
    assert made.groups["session"].tolist() == ["Ada", "Ada", "Bob", "Bob"]
    assert made.groups["trial"].tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(made.samples, COUNTS[:, 20:40])


def test_the_times_of_the_set_can_be_used(tmp_path: Path):
    """--time timestamp:s, with the float32 times that LeRobot writes."""
    folder = data_set(tmp_path / "set", "v3.0")
    assert imported(folder, *MATERIAL, "--time", "timestamp:s") == 0
    np.testing.assert_array_equal(sets.load(str(tmp_path / "s.npz")).samples, COUNTS[:, 20:40])


def test_a_feature_is_named_where_several_are_tactile(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The features of numbers are listed with their shapes."""
    more = {"observation.touch_left": {"dtype": "float32", "shape": [4]}}
    folder = data_set(tmp_path / "set", "v3.0", **more)
    assert imported(folder, *MATERIAL) == 65
    told = capsys.readouterr().err
    assert "holds 2 tactile features; name one with --variable: its features of numbers are" in told
    assert "observation.tactile [2, 3], observation.state [6]" in told
    assert imported(folder, *MATERIAL, "--variable", "observation.tactile") == 0


def test_an_episode_that_lacks_a_frame_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """A row that was filtered out would be spliced over."""
    folder = data_set(tmp_path / "set", "v3.0")
    parquet = pytest.importorskip("pyarrow.parquet")
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    whole = parquet.read_table(path)
    pa = pytest.importorskip("pyarrow")
    parquet.write_table(pa.concat_tables([whole.slice(0, 70), whole.slice(71)]), path)
    assert imported(folder, *MATERIAL) == 65
    assert "episode 1 lacks a frame; fetch the whole set" in capsys.readouterr().err
