"""Reads the tactile columns of a LeRobot data set: each episode is a recording.

Layout of versions 2.0 to 3.0: meta/info.json with `fps` and `features`, data/chunk-*/*.parquet with
a row for each frame, the texts of tasks in meta/tasks.jsonl or meta/tasks.parquet.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.extras import library
from palpate_train.data.files import json_lines, parquet
from palpate_train.data.files.table import ReadPlan, Table, from_columns
from palpate_train.data.import_plan import ImportPlan

INFO = Path("meta", "info.json")
TASKS = (Path("meta", "tasks.jsonl"), Path("meta", "tasks.parquet"))
EPISODE, FRAME, TASK, TASK_INDEX, TIME = (
    "episode_index", "frame_index", "task", "task_index", "timestamp",
)  # fmt: skip
TACTILE = ("tactile", "touch", "taxel", "skin")
"""What the names of tactile features contain. LeRobot prescribes no name."""
PICTURES = ("video", "image", "string")


def is_data_set(folder: Path) -> bool:
    """Whether a folder holds a LeRobot data set."""
    return (folder / INFO).is_file()


def rate_hz(folder: Path) -> float:
    """The frame rate of a data set. Raises FormatError."""
    rate = _info(folder).get("fps")
    if not isinstance(rate, int | float) or rate <= 0:
        raise FormatError(f"{folder / INFO}: fps is {rate!r}; give the frame rate with --rate")
    return float(rate)


def with_grid(folder: Path, plan: ImportPlan) -> ImportPlan:
    """The plan with the grid that the tactile feature states, if the plan has none."""
    _, shape = _feature(folder, plan)
    if plan.grid or len(shape) not in (2, 3):
        return plan
    return replace(plan, grid="x".join(map(str, shape)))


def episodes(folder: Path, plan: ImportPlan) -> Iterator[tuple[str, Table]]:
    """Name and table of each episode.

    The columns are the values of the tactile feature, the text `task`, and the columns that
    `plan.fields` names. Raises FormatError if a feature or a file is missing, or if an episode
    lacks a frame.
    """
    arrow = library("pyarrow", "a LeRobot data set")
    name, _ = _feature(folder, plan)
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
        for episode in np.unique(numbers[EPISODE]):
            inside = numbers[EPISODE] == episode
            if (np.diff(numbers[FRAME][inside]) != 1).any():
                raise FormatError(f"{path}: episode {episode} lacks a frame; fetch the whole set")
            rows = content.filter(arrow.array(inside))
            yield f"episode {episode}", _table(rows, name, tasks, plan.fields.values())


def _info(folder: Path) -> Mapping[str, Any]:
    try:
        info = json.loads((folder / INFO).read_bytes())
    except ValueError as e:
        raise FormatError(f"{folder / INFO}: cannot be read: {e}; fetch the set again") from e
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise FormatError(f"{folder / INFO}: lists no features; it is not of LeRobot 2.0 to 3.0")
    return info


def _feature(folder: Path, plan: ImportPlan) -> tuple[str, tuple[int, ...]]:
    """Name and shape of the tactile feature: the only one with a name of TACTILE, or
    `plan.variable`."""
    features = {
        name: about
        for name, about in _info(folder)["features"].items()
        if about.get("dtype") not in PICTURES
    }
    if plan.variable and plan.variable in features:
        found = [plan.variable]
    else:
        found = [n for n in features if any(word in n.lower() for word in TACTILE)]
    if len(found) != 1 or (plan.variable and found != [plan.variable]):
        listed = ", ".join(f"{n} {about.get('shape')}" for n, about in features.items())
        raise FormatError(
            f"{folder}: holds {len(found)} tactile features; name one with --variable: "
            f"its features of numbers are {listed or 'none'}"
        )
    return found[0], tuple(int(n) for n in features[found[0]].get("shape") or ())


def _tasks(folder: Path) -> dict[int, str]:
    """The text of each task by its number; version 3 keeps the texts as the index of a table."""
    lines, table = (folder / path for path in TASKS)
    if lines.is_file():
        read = json_lines.read(lines.read_bytes(), ReadPlan())
        number, text = read.columns.index(TASK_INDEX), read.columns.index(TASK)
        return dict(zip(read.values[:, number].astype(int).tolist(), read.texts[text], strict=True))
    if not table.is_file():
        return {}
    content = parquet.arrow(table)
    (text_column,) = [name for name in content.column_names if name != TASK_INDEX]
    numbers = content.column(TASK_INDEX).to_pylist()
    return dict(zip(numbers, map(str, content.column(text_column).to_pylist()), strict=True))


def _table(rows: Any, name: str, tasks: Mapping[int, str], fields: Any) -> Table:
    """The table of an episode."""
    found = parquet.numbers(rows.column(name), name)
    if found is None:
        raise FormatError(f"{name} does not hold numbers; name a feature that does")
    flat = found.reshape(len(found), -1)
    names = [f"{name}.{k}" for k in range(flat.shape[1])]
    columns, texts = list(flat.T), {}
    for field in dict.fromkeys([TASK, *fields]):
        if field == TASK and TASK_INDEX in rows.column_names:
            numbers = rows.column(TASK_INDEX).to_pylist()
            texts[len(names)] = [tasks.get(k, str(k)) for k in numbers]
        elif field in rows.column_names:
            texts[len(names)] = [str(value) for value in rows.column(field).to_pylist()]
        else:
            continue
        names.append(field)
        columns.append(np.zeros(len(flat), np.uint8))
    made = from_columns(names, columns, texts)
    time = np.asarray(rows.column(TIME).to_numpy()) if TIME in rows.column_names else None
    vectors = {} if time is None else {TIME: time.astype(np.float64)}
    return Table(made.values, made.columns, vectors, tuple(vectors), texts)
