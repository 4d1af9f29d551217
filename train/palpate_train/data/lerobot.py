"""Reads the tactile columns of a LeRobot data set: each episode is a recording.

Layout of versions 2.0 to 3.0: meta/info.json with `fps` and `features`, data/chunk-*/*.parquet with
a row for each frame, the texts of tasks in meta/tasks.jsonl or meta/tasks.parquet. A row of a fast
skin may hold the frames since the row before, along the first axis of its feature.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.data import raw_files
from palpate_train.data.extras import library
from palpate_train.data.files import parquet
from palpate_train.data.files.table import Column, Table, excerpt, from_columns, parted
from palpate_train.data.import_plan import ImportPlan, grid_shape

INFO = Path("meta", "info.json")
TASKS = (Path("meta", "tasks.jsonl"), Path("meta", "tasks.parquet"))
EPISODE, FRAME, TASK, TASK_INDEX, TIME = (
    "episode_index", "frame_index", "task", "task_index", "timestamp",
)  # fmt: skip
TACTILE = ("tactile", "touch", "taxel", "skin")
"""What the names of tactile features contain. LeRobot prescribes no name."""
SEVERAL = ("time", "window", "history", "buffer", "stack", "sequence", "frames", "steps")
"""What the names of features and axes contain if a row holds several frames."""
PICTURES = ("video", "image", "string")
MOST = 1_000_000
"""Beyond the number of taxels of any skin."""


def is_data_set(folder: Path) -> bool:
    """Whether a folder holds a LeRobot data set."""
    return (folder / INFO).is_file()


def rate_hz(folder: Path, variable: str = "", grid: str = "") -> float:
    """The frame rate of a data set, several times its rate of rows if a row holds several frames.
    Raises FormatError."""
    rate = _info(folder).get("fps")
    if not isinstance(rate, int | float) or rate <= 0:
        raise FormatError(f"{folder / INFO}: fps is {rate!r}; give the frame rate with --rate")
    return float(rate) * _frames_of_a_row(_feature(folder, variable)[1], grid)


def with_grid(folder: Path, plan: ImportPlan) -> tuple[ImportPlan, tuple[str, ...]]:
    """The plan with the grid that the tactile feature states, if the plan has none, and a remark on
    it. Raises FormatError if its first axis seems to be time."""
    name, shape = _feature(folder, plan.variable)
    if plan.grid or len(shape) not in (2, 3):
        return plan, ()
    sizes, grid = list(shape), "x".join(map(str, shape))
    other = f"if a row holds {shape[0]} frames, give the grid of one with --grid ROWSxCOLUMNS"
    about = f"{name} {_info(folder)['features'][name].get('names') or ''}".lower()
    if any(word in about for word in SEVERAL):
        raise FormatError(
            f"{folder}: {name} has the shape {sizes}; {other}, or --grid {grid} if all are taxels"
        )
    return replace(plan, grid=grid), (f"{name} {sizes} is taken as {grid} taxels; {other}",)


def _frames_of_a_row(shape: tuple[int, ...], grid: str) -> int:
    """The number of frames in a row of a feature, as the grid of one frame shows."""
    taxels = int(np.prod(grid_shape(grid))) if grid else 0
    several = len(shape) > 1 and shape[0] > 1 and int(np.prod(shape[1:])) == taxels
    return shape[0] if several else 1


def episodes(folder: Path, plan: ImportPlan) -> Iterator[tuple[str, Table]]:
    """Name and table of each episode.

    The columns are the values of the tactile feature, the text `task`, and the columns that
    `plan.fields` names. Raises FormatError if a feature or a file is missing, or if an episode
    lacks a frame.
    """
    arrow = library("pyarrow", "a LeRobot data set")
    name, shape = _feature(folder, plan.variable)
    each = 1 if plan.columns else _frames_of_a_row(shape, plan.grid)
    tasks = _tasks(folder)
    paths = sorted(folder.glob("data/**/*.parquet"))
    if not paths:
        raise FormatError(f"{folder}: holds no file data/chunk-*/*.parquet; fetch the whole set")
    for path in paths:
        content = parquet.arrow(path)
        known = content.column_names
        if missing := [c for c in (name, EPISODE, FRAME) if c not in known]:
            raise FormatError(f"{path}: has no column {missing[0]}; it has {', '.join(known)}")
        numbers = {c: np.asarray(content.column(c).to_numpy()) for c in (EPISODE, FRAME)}
        if odd := [c for c, found in numbers.items() if found.dtype.kind not in "iu"]:
            raise FormatError(f"{path}: {odd[0]} is not a whole number in each row; write it there")
        for episode in np.unique(numbers[EPISODE]):
            inside = numbers[EPISODE] == episode
            if (np.diff(numbers[FRAME][inside]) != 1).any():
                raise FormatError(f"{path}: episode {episode} lacks a frame; fetch the whole set")
            rows = content.filter(arrow.array(inside))
            yield f"episode {episode}", _table(rows, (name, each), tasks, plan.fields.values())


def _info(folder: Path) -> Mapping[str, Any]:
    try:
        info = json.loads((folder / INFO).read_bytes())
    except ValueError as e:
        raise FormatError(f"{folder / INFO}: cannot be read: {e}; fetch the set again") from e
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise FormatError(f"{folder / INFO}: lists no features; it is not of LeRobot 2.0 to 3.0")
    return info


def _feature(folder: Path, variable: str) -> tuple[str, tuple[int, ...]]:
    """Name and shape of the tactile feature: `variable`, or the only one with a name of
    TACTILE."""
    features = {
        name: about
        for name, about in _info(folder)["features"].items()
        if isinstance(about, dict) and about.get("dtype") not in PICTURES
    }
    if variable and variable in features:
        found = [variable]
    else:
        found = [n for n in features if any(word in n.lower() for word in TACTILE)]
    if len(found) != 1 or (variable and found != [variable]):
        listed = ", ".join(f"{n} {about.get('shape')}" for n, about in features.items())
        raise FormatError(
            f"{folder}: holds {len(found)} tactile features; name one with --variable: "
            f"its features of numbers are {listed or 'none'}"
        )
    shape = features[found[0]].get("shape") or []
    if not isinstance(shape, list) or not all(n in range(1, MOST) for n in shape):
        raise FormatError(
            f"{folder / INFO}: the shape of {found[0]} is {excerpt(str(shape))}; write a list of "
            "whole numbers above 0 there"
        )
    return found[0], tuple(map(int, shape))


def _tasks(folder: Path) -> dict[int, str]:
    """The text of each task by its number; version 3 keeps the texts as the index of a table."""
    path = next((folder / path for path in TASKS if (folder / path).is_file()), None)
    if path is None:
        return {}
    read = raw_files.read(path)
    texts = {read.columns[k]: text for k, text in read.texts.items()}
    texts = {TASK: texts[TASK]} if TASK in texts else texts
    if TASK_INDEX not in read.columns or len(texts) != 1:
        raise FormatError(
            f"{path}: has the columns {', '.join(read.columns)}; "
            f"write {TASK_INDEX} and a text there"
        )
    numbers = read.values[:, read.columns.index(TASK_INDEX)].tolist()
    return dict(zip(numbers, *texts.values(), strict=True))


def _table(
    rows: Any, feature: tuple[str, int], tasks: Mapping[int, str], fields: Collection[str]
) -> Table:
    """The table of an episode. feature: its name, and the frames of a row."""
    name, each = feature
    found = parquet.numbers(rows.column(name), name)
    if found is None:
        raise FormatError(f"{name} does not hold numbers; name a feature that does")
    flat = _apart(name, found.reshape(len(found), -1), each)
    columns: list[Column] = list(parted(name, flat))
    for field in dict.fromkeys([TASK, *fields]):
        if field == TASK and TASK_INDEX in rows.column_names:
            numbers = rows.column(TASK_INDEX).to_pylist()
            given = [tasks.get(k, str(k)) for k in numbers]
        elif field in rows.column_names:
            given = [str(value) for value in rows.column(field).to_pylist()]
        else:
            continue
        columns.append((field, [text for text in given for _ in range(each)]))
    made = from_columns(columns)
    timed = TIME in rows.column_names and each == 1
    time = parquet.numbers(rows.column(TIME), TIME) if timed else None
    vectors = {} if time is None else {TIME: time.astype(np.float64)}
    return replace(made, vectors=vectors, beside=tuple(vectors))


def _apart(name: str, rows: NDArray[Any], each: int) -> NDArray[Any]:
    """Rows [n, each * taxels] as frames [n * each, taxels]. Raises FormatError if a row repeats
    frames of the row before."""
    frames = rows.reshape(len(rows), each, -1)
    for new in range(1, each):
        repeated = np.array_equal(frames[1:, : each - new], frames[:-1, new:])
        if repeated and (frames[1:] != frames[:-1]).any():
            first = rows.shape[1] - frames.shape[2] + 1
            raise FormatError(
                f"{name}: each row repeats {each - new} of its {each} frames; "
                f"take the last one with --columns {first}-{rows.shape[1]}, at the rate of the rows"
            )
    return frames.reshape(len(rows) * each, -1)
