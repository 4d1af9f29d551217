"""Reads JSON lines, one frame on each line, and JSON files with a list of frames or of columns."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.files.table import (
    Column,
    ReadPlan,
    Table,
    excerpt,
    facts_of,
    from_columns,
    timed,
)
from palpate_train.data.files.text import decoded, lines_of

NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
"""A number, as programs write it in quotes."""
SUFFIXES = (".jsonl", ".ndjson", ".json", ".jsonlines")


def read(data: bytes, wanted: ReadPlan) -> Table:
    """The frames in a text of JSON. Raises FormatError with the line and the key."""
    text, notes = decoded(data)
    whole, facts = _whole(text), dict[str, str]()
    acquired: dict[str, Any] | None = None
    if isinstance(whole, dict):
        facts = facts_of(whole)
        if isinstance(inner := whole.get("payload"), dict) and "values" in inner:
            acquired, whole = inner, _acquired(inner)
            facts |= facts_of(inner)
        else:
            whole, said = _unwrapped(whole, wanted)
            notes += said
    if isinstance(whole, list) and whole and isinstance(whole[0], list | dict):
        rows, what = list(enumerate(whole, 1)), "entry"
    else:
        rows, said = _lines(lines_of(text))
        notes, what = [*notes, *said], "line"
    frames = [(i, dict(flat("", value))) for i, value in rows]
    if not frames:
        raise FormatError("holds no frames; write one object or list of numbers on each line")
    while len(frames) > 2 and frames[0][1].keys() != frames[1][1].keys() == frames[2][1].keys():
        notes = [*notes, f"{what} {frames[0][0]} is passed over: it has other keys"]
        frames = frames[1:]
    made = replace(table_of(frames, what, notes), facts=facts)
    if acquired is None:
        return made
    return timed(made, "payload.interval_ms", acquired.get("interval_ms"), 1e-3)


def _unwrapped(whole: dict[str, Any], wanted: ReadPlan) -> tuple[Any, list[str]]:
    """The list of frames in an object, and remarks; the object itself if it is a frame.

    An object holds a list for each column, as pandas writes them in four ways, or one list of
    frames next to facts about them. Raises FormatError.
    """
    if {"columns", "data"} <= whole.keys() and isinstance(whole["columns"], list):
        return _rows(list(map(str, whole["columns"])), "columns", whole["data"], "data"), []
    if _is_numbered(whole) and all(isinstance(v, dict) for v in whole.values()):
        return list(whole.values()), []
    if all(isinstance(v, dict) and _is_numbered(v) for v in whole.values()):
        whole = {key: list(values.values()) for key, values in whole.items()}
    lists = {k: v for k, v in whole.items() if isinstance(v, list) and len(v) > 1}
    frames = [k for k, v in lists.items() if isinstance(v[0], list | dict)]
    if wanted.variable in frames:
        frames = [wanted.variable]
    if len(frames) == 1 and (len(lists) < len(whole) or wanted.variable):
        return lists[frames[0]], [f"its list {frames[0]!r} holds the frames"]
    if len(lists) < len(whole):
        return whole, []
    lengths = {key: len(values) for key, values in whole.items()}
    if len(set(lengths.values())) > 1:
        raise FormatError(f"its columns differ in length: {lengths}")
    return [dict(zip(whole, row, strict=True)) for row in zip(*whole.values(), strict=True)], []


def _acquired(payload: dict[str, Any]) -> list[dict[str, Any]]:
    """The frames of Edge Impulse's data acquisition format, by the names of its sensors."""
    sensors, values = payload.get("sensors"), payload["values"]
    each: list[Any] = sensors if isinstance(sensors, list) else [sensors]
    if not all(isinstance(one, dict) and "name" in one for one in each):
        raise FormatError(
            f"payload.sensors is {excerpt(str(sensors))}; write an object with a name for each "
            "sensor there"
        )
    names = [str(one["name"]) for one in each]
    if len({*names}) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FormatError(
            f"payload.sensors has the name {twice!r} twice; give each sensor its own name there"
        )
    if isinstance(values, list):
        values = [row if isinstance(row, list) else [row] for row in values]
    return _rows(names, "payload.sensors", values, "payload.values")


def _rows(names: list[str], named_by: str, rows: Any, key: str) -> list[dict[str, Any]]:
    """The rows of a table by the names of its columns. named_by, key: where the names and the rows
    stand. Raises FormatError if they do not fit."""
    if not isinstance(rows, list):
        raise FormatError(f"{key} is {excerpt(str(rows))}; write a list with each frame there")
    for k, row in enumerate(rows, 1):
        if not isinstance(row, list) or len(row) != len(names):
            raise FormatError(
                f"entry {k} of {key} is {excerpt(str(row))}; write {len(names)} numbers, as "
                f"{named_by} says"
            )
    return [dict(zip(names, row, strict=True)) for row in rows]


def _is_numbered(column: dict[str, Any]) -> bool:
    return list(column) == [str(i) for i in range(len(column))]


def _whole(text: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError):
        return None


def _once(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """An object. Raises FormatError if a key occurs twice, because JSON would keep the last."""
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FormatError(f"the key {twice!r} occurs twice in one object; give each its own name")
    return dict(pairs)


def _lines(lines: Sequence[str]) -> tuple[list[tuple[int, Any]], list[str]]:
    """The value of each line that is not blank. A last line that is cut off is dropped."""
    kept = [(i, line.strip().rstrip(",")) for i, line in enumerate(lines, 1)]
    kept = [(i, line) for i, line in kept if line not in ("", "[", "]")]
    rows = []
    for i, line in kept:
        try:
            rows.append((i, json.loads(line, object_pairs_hook=_once)))
        except FormatError as e:
            raise FormatError(f"line {i}: {e}") from e
        except (ValueError, RecursionError) as e:
            if rows and i == kept[-1][0]:
                return rows, [f"read up to line {i}, which is cut off"]
            raise FormatError(f"line {i} is {excerpt(line.strip())}, which is not JSON") from e
    return rows, []


def flat(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The numbers and texts in a value, with their paths: t, header.stamp, taxels.0."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from flat(f"{name}.{key}" if name else key, inner)
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from flat(f"{name}.{k}" if name else str(k), inner)
    else:
        yield name, value


def table_of(
    frames: Sequence[tuple[int, dict[str, Any]]], what: str, notes: Sequence[str]
) -> Table:
    """A table of frames with their numbers. what: how a message calls one. Raises FormatError."""
    names = list(frames[0][1])
    if any(list(frame) != names for _, frame in frames):
        names = sorted(names)  # no order of its own; numbers in names will give it
    columns: list[Column] = []
    faults: dict[int, str] = {}
    for i, frame in frames:
        if len(frame) != len(names) or set(frame) != set(names):
            odd = sorted(set(frame) ^ set(names))[0]
            has = "has" if odd in frame else "lacks"
            raise FormatError(f"{what} {i} {has} {odd!r}, unlike {what} {frames[0][0]}")
    for k, name in enumerate(names):
        values = [frame[name] for _, frame in frames]
        words = sum(isinstance(value, str) for value in values)
        if words == len(values) and all(map(NUMBER.fullmatch, values)):
            values, words = list(map(float, values)), 0
        if 2 * words > len(values):
            columns.append((name, list(map(str, values))))
            continue
        flags = all(isinstance(v, bool) for v in values)  # true is no count
        kinds = (bool,) if flags else (int, float)
        numbers = [v if type(v) in kinds else None for v in values]
        for (i, _), number, value in zip(frames, numbers, values, strict=True):
            if number is None:
                faults.setdefault(k, f"{what} {i}, {name} is {value!r}, which is not a number")
        columns.append((name, np.array([np.nan if v is None else v for v in numbers], np.float64)))
    return from_columns(columns, notes, faults)
