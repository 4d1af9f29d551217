"""Files of other programs: Octave's HDF5, Tekscan's movies, sets of LeRobot."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

OCTAVE = np.random.default_rng(0).integers(0, 250, (2, 8, 1600), np.uint8)
RANGE = np.dtype([("base", "<f8"), ("limit", "<f8"), ("increment", "<f8")])
FRAMES = np.arange(12 * 3 * 4).reshape(12, 3, 4)
HEAD = """DATA_TYPE MOVIE
VERSION I-Scan 7.60
SENSOR_TYPE 5051
ROWS 3
COLS 4
ROW_SPACING 1.27 mm
SECONDS_PER_FRAME 0.01
START_FRAME 1
END_FRAME 12
UNITS Raw
ASCII_DATA @@

"""
COUNTS = np.arange(4 * 60 * 6, dtype=np.float32).reshape(4, 60, 2, 3) % 997
TASKS = ("slide over wood", "slide over felt")


def _variable(file: h5py.Group, name: str, kind: bytes, value: object = None) -> h5py.Group:
    """A variable as `save -hdf5` stores it; a structure without a value."""
    one = file.create_group(name)
    one.attrs["OCTAVE_NEW_FORMAT"] = np.uint8(1)
    one["type"] = np.bytes_(kind)
    if value is not None:
        one["value"] = value
    return one


def octave(path: Path) -> Path:
    """The file of `save -hdf5 FILE skin t run c name z e ok`, as Octave's own."""
    with h5py.File(path, "w") as file:
        _variable(file, "skin", b"uint8 matrix", OCTAVE.T)
        for where in (file, _variable(file, "run", b"scalar struct").create_group("value")):
            t = _variable(where, "t", b"double_range", np.array((0, 15.99, 0.01), RANGE))
            t["value"].attrs["OCTAVE_RANGE_NELEM"] = np.int64(1600)
        cell = _variable(file, "c", b"cell").create_group("value")
        cell["dims"] = np.array([1, 1])
        _variable(cell, "_0", b"float matrix", np.arange(40, dtype="f4").reshape(10, 4))
        _variable(file, "name", b"sq_string", np.zeros((4, 1), "i1"))
        _variable(file, "z", b"complex matrix", np.zeros((3, 3), [("real", "f8"), ("imag", "f8")]))
        _variable(file, "e", b"matrix", np.zeros(2, "i8")).attrs["OCTAVE_EMPTY_MATRIX"] = np.uint8(
            1
        )
        _variable(file, "ok", b"bool", 1.0)
    return path


def movie(frames: np.ndarray = FRAMES, head: str = HEAD, tail: str = "") -> str:
    """A movie as I-Scan exports it."""
    blocks = [
        f"Frame {k}\n" + "".join(",".join(map(str, row)) + tail + "\n" for row in frame.tolist())
        for k, frame in enumerate(frames, 1)
    ]
    return head + "\n".join(blocks) + "\n@@\n"


def lerobot_set(folder: Path, version: str, **features: Any) -> Path:
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
