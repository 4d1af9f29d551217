"""Writes a sweep set as a LeRobot data set of version 3.0: each sweep is an episode, and its
material the task.

Source of the layout: lerobot 0.4.4, lerobot/datasets/utils.py and lerobot_dataset.py.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core import storage
from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate_train.data.extras import library
from palpate_train.data.lerobot import EPISODE, FRAME, INFO, TASK, TASK_INDEX, TASKS, TIME
from palpate_train.data.sets import Dataset

VERSION = "v3.0"
TACTILE = "observation.tactile"
INDEX = "index"
RESERVED = (EPISODE, FRAME, TASK, TASK_INDEX, TIME, INDEX)
FILE_BYTES, CHUNK = 100 << 20, 1000
"""Frames in a file, and largest number of files in a folder, as LeRobot writes them."""
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
INDEX_NAME = "__index_level_0__"
"""The column in which pandas keeps an index without a name; LeRobot keeps the tasks there."""


def write(sweeps: Dataset, out: Path) -> None:
    """Write a set as the new folder `out`, complete or not at all.

    The groups of the set become features of their names. Raises FormatError if `out` exists, if a
    group has the name of a column of LeRobot, or without pyarrow; OSError.
    """
    if taken := next((name for name in sweeps.groups if name in RESERVED), ""):
        raise FormatError(
            f"{sweeps.source}: its group {taken!r} has the name of a column of LeRobot; "
            "give the group another name"
        )
    if out.exists():
        raise FormatError(f"{out} is there already; name a new folder")
    if not out.parent.is_dir():
        raise FormatError(f"{out}: there is no folder {out.parent}; make it first")
    try:
        library("pyarrow.parquet", "a set of Parquet files", "write")
    except FormatError as e:
        raise FormatError(f"{out} {e}") from e
    with storage.folder(out) as folder:
        (folder / INFO).parent.mkdir()
        episodes = [row for rows in _files(sweeps, folder) for row in rows]
        columns = {name: [row[name] for row in episodes] for name in episodes[0]}
        _put(folder / "meta/episodes" / FILE.format(chunk_index=0, file_index=0), columns)
        _put_tasks(folder / TASKS[1], sweeps.materials)
        stats = {name: _stats(values) for name, values in _columns(sweeps, slice(None)).items()}
        (folder / "meta/stats.json").write_text(json.dumps(stats))
        (folder / INFO).write_text(json.dumps(_info(sweeps), indent=4, ensure_ascii=False))


def _info(sweeps: Dataset) -> dict[str, Any]:
    """The content of meta/info.json."""
    count, rate = len(sweeps), sweeps.rate_hz
    columns = _columns(sweeps, slice(0, 1), texts=True)
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": count,
        "total_frames": count * sweeps.format.window,
        "total_tasks": len(sweeps.materials),
        "chunks_size": CHUNK,
        "data_files_size_in_mb": FILE_BYTES >> 20,
        "video_files_size_in_mb": FILE_BYTES >> 20,
        "fps": int(rate) if rate == int(rate) else rate,
        "splits": {"train": f"0:{count}"},
        "data_path": f"data/{FILE}",
        "video_path": None,
        "features": {
            name: {
                "dtype": "string" if values.dtype.kind == "U" else values.dtype.name,
                "shape": list(values.shape[1:]) or [1],
                "names": None,
            }
            for name, values in columns.items()
        },
    }


def _columns(sweeps: Dataset, at: slice, *, texts: bool = False) -> dict[str, Array]:
    """The columns of the sweeps `at`, a row for each frame. texts: also the columns of names."""
    samples, numbers = sweeps.samples[at], np.arange(len(sweeps))[at]
    count, window = samples.shape[:2]
    frame = np.tile(np.arange(window, dtype=np.int64), count)
    episode = np.repeat(numbers.astype(np.int64), window)
    columns: dict[str, Array] = {TACTILE: samples.reshape(-1, *samples.shape[2:])}
    for name, values in sweeps.groups.items():
        if texts or values.dtype.kind != "U":
            kept = values[at].astype(np.int64) if values.dtype.kind in "iu" else values[at]
            columns[name] = np.repeat(kept, window)
    return columns | {
        TIME: (frame / sweeps.rate_hz).astype(np.float32),
        FRAME: frame,
        EPISODE: episode,
        INDEX: episode * window + frame,
        TASK_INDEX: np.repeat(sweeps.labels[at].astype(np.int64), window),
    }


def _files(sweeps: Dataset, folder: Path) -> Iterator[list[dict[str, Any]]]:
    """Write the frames, FILE_BYTES in each file; the rows of meta/episodes for each file."""
    each = max(1, FILE_BYTES // sweeps.samples[0].nbytes)
    for number, first in enumerate(range(0, len(sweeps), each)):
        at = slice(first, min(first + each, len(sweeps)))
        chunk, file = divmod(number, CHUNK)
        path = folder / "data" / FILE.format(chunk_index=chunk, file_index=file)
        _put(path, _columns(sweeps, at, texts=True))
        yield [_episode(sweeps, k, chunk, file) for k in range(at.start, at.stop)]


def _episode(sweeps: Dataset, number: int, chunk: int, file: int) -> dict[str, Any]:
    """The row of an episode: where its frames are, and their statistics."""
    window = sweeps.format.window
    row: dict[str, Any] = {
        EPISODE: number,
        "tasks": [sweeps.materials[sweeps.labels[number]]],
        "length": window,
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": number * window,
        "dataset_to_index": (number + 1) * window,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    for name, values in _columns(sweeps, slice(number, number + 1)).items():
        row |= {f"stats/{name}/{what}": value for what, value in _stats(values).items()}
    return row


def _stats(values: Array) -> dict[str, Any]:
    """Statistics over frames as LeRobot keeps them, as nested lists."""
    flat = values.reshape(len(values), -1)
    # one taxel after another: quantiles of all would take several times the memory of the set
    rows = np.array(
        [
            [
                *(one.min(), one.max(), one.mean(dtype=np.float64), one.std(dtype=np.float64)),
                *np.quantile(one, list(QUANTILES.values())),
            ]
            for one in flat.T
        ]
    )
    shape = values.shape[1:] or (1,)
    names = ("min", "max", "mean", "std", *QUANTILES)
    found: dict[str, Any] = {
        name: column.reshape(shape).tolist() for name, column in zip(names, rows.T, strict=True)
    }
    return found | {"count": [len(values)]}


def _put(path: Path, columns: Mapping[str, Any]) -> None:
    """Write a Parquet file; arrays [n, ...] become lists of lists."""
    arrow, parquet = library("pyarrow", ""), library("pyarrow.parquet", "")
    path.parent.mkdir(parents=True, exist_ok=True)
    made = {name: _lists(v) if isinstance(v, np.ndarray) else v for name, v in columns.items()}
    parquet.write_table(arrow.table(made), path)


def _lists(values: Array) -> Any:
    """pyarrow's column of an array [n, ...]."""
    arrow = library("pyarrow", "")
    column = arrow.array(np.ascontiguousarray(values).ravel())
    for axis in reversed(range(1, values.ndim)):
        count, width = int(np.prod(values.shape[:axis])), values.shape[axis]
        offsets = np.arange(count + 1, dtype=np.int32) * width
        column = arrow.ListArray.from_arrays(offsets, column)
    return column


def _put_tasks(path: Path, materials: tuple[str, ...]) -> None:
    """Write the tasks as pandas would, with their texts as the index."""
    arrow, parquet = library("pyarrow", ""), library("pyarrow.parquet", "")
    table = arrow.table({TASK_INDEX: np.arange(len(materials)), INDEX_NAME: list(materials)})
    types = {TASK_INDEX: ("int64", "int64"), INDEX_NAME: ("unicode", "object")}
    about = {
        "index_columns": [INDEX_NAME],
        "column_indexes": [],
        "columns": [
            {
                "name": None if name == INDEX_NAME else name,
                "field_name": name,
                "pandas_type": kind,
                "numpy_type": stored,
                "metadata": None,
            }
            for name, (kind, stored) in types.items()
        ],
        "pandas_version": "2.0.0",
    }
    described = table.replace_schema_metadata({"pandas": json.dumps(about)})
    parquet.write_table(described, path)
