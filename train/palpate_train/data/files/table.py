"""One recording as a table, and the choice of an array from a file that holds several."""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.text import printable

Array = NDArray[Any]
Column = tuple[str, Array | list[str]]
"""Name of a column, and its numbers [n] or its texts."""
TIME = "time"
"""The vector of the times that a file states by the interval between two frames, in s."""
MOST_LISTED = 12
"""Largest number of arrays that an error message lists."""
LEAST_SERIES = 20
"""Smallest number of arrays that are the frames of one recording."""
RUNNING = re.compile(r"(.*?)(\d+)(\D*)")
"""A name with a running number."""
KINDS = {"O": " of objects", "S": " of texts", "U": " of texts", "c": " of complex numbers"}
"""Kinds of arrays that hold no frames, by NumPy's letter."""
LONGEST = 40
"""Longest excerpt of a cell in an error message."""


@dataclass(frozen=True)
class ReadPlan:
    """What to read from a file. variable: the array, sheet, group or topic. time: the name of the
    times. decimal: the decimal sign of text, "" if the text must show it. names_only: read no
    array, only the names of arrays that hold frames. fields: what --field asks for: columns, facts
    or topics of text."""

    variable: str = ""
    time: str = ""
    decimal: str = ""
    names_only: bool = False
    fields: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Table:
    """One recording.

    values: [n, ...] numbers in the file's data type, float64 from text; NaN where a cell is not a
    number. columns: names of the columns, () if unnamed. vectors: one-dimensional arrays besides
    the values, such as times, by name. beside: names of vectors, or with names_only of arrays of
    frames, that were not read. texts: text columns, one text for each frame, by column number
    from 0. faults: for each other column with a cell that is not a number, a message about the
    first. notes: remarks. facts: texts about the whole file by name, such as attributes. labels:
    texts for each frame by name. ends: the numbers of frames before the ends of its recordings, ()
    for one recording.
    array: the name of the array of `values`, "" for none.
    reversible: whether a program may have reversed the axes, and the file does not show it.
    """

    values: Array
    columns: tuple[str, ...] = ()
    vectors: Mapping[str, Array] = field(default_factory=dict)
    beside: tuple[str, ...] = ()
    texts: Mapping[int, Sequence[str]] = field(default_factory=dict)
    faults: Mapping[int, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    reversible: bool = False
    facts: Mapping[str, str] = field(default_factory=dict)
    labels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    ends: tuple[int, ...] = ()
    array: str = ""


@dataclass(frozen=True)
class Entry:
    """An array of a file, before it is read. fields: names of the fields of a record array. kind:
    NumPy's letter for the kind of type."""

    shape: tuple[int, ...]
    kind: str
    read: Callable[[], Array]
    fields: tuple[str, ...] = ()

    @classmethod
    def of(cls, shape: tuple[int, ...], dtype: np.dtype[Any], read: Callable[[], Array]) -> Entry:
        return cls(shape, dtype.kind, read, dtype.names or ())

    @property
    def holds_frames(self) -> bool:
        """Whether the array can be frames: records, or numbers of at least two axes."""
        if self.fields:
            return len(self.shape) == 1 and self.shape[0] > 1
        return self.kind in "biuf" and sum(n > 1 for n in self.shape) > 1

    @property
    def size(self) -> int:
        """The number of elements."""
        return math.prod(self.shape)

    @property
    def is_vector(self) -> bool:
        return self.kind in "biuf" and sum(n > 1 for n in self.shape) < 2 and 0 not in self.shape


def normal(name: str) -> str:
    """A name in Unicode's composed form (NFC), so that equal names have equal characters."""
    return unicodedata.normalize("NFC", name)


def timed(table: Table, key: str, stated: Any, unit_s: float = 1.0) -> Table:
    """A table with the vector TIME of the times of its frames, in s, by the interval between two
    that its file states as the value of `key`; a remark in its place if that is no interval."""
    try:
        step_s = unit_s * float(stated)
    except (TypeError, ValueError):
        step_s = 0.0
    if not 0 < step_s < math.inf:
        note = f"{key} is {stated!r}, which is no time between two frames; give --rate HZ"
        return replace(table, notes=(*table.notes, note))
    return replace(
        table,
        vectors={TIME: step_s * np.arange(len(table.values))},
        beside=(TIME,),
        notes=(*table.notes, f"{key} is {stated}: {1 / step_s:g} Hz"),
    )


def facts_of(said: Mapping[str, Any]) -> dict[str, str]:
    """The texts and numbers in an object or in attributes, as facts."""
    return {normal(k): str(v) for k, v in said.items() if isinstance(v, str | int | float)}


def excerpt(text: str) -> str:
    """A cell as it is shown in an error message."""
    return repr(text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…")


def unpacked(values: Array, attributes: Mapping[str, Any]) -> Array:
    """Numbers as they were before xarray or netCDF packed them into counts (CF conventions, 8.1);
    NaN where none was."""
    if not {"scale_factor", "add_offset"} & set(attributes):
        return values
    scale, offset = (
        np.asarray(attributes.get(name, usual), np.float64).item()
        for name, usual in (("scale_factor", 1), ("add_offset", 0))
    )
    return np.where(values == attributes.get("_FillValue"), np.nan, values * scale + offset)


def chosen(entries: Mapping[str, Entry], wanted: ReadPlan, ends: Sequence[int] = ()) -> Table:
    """The only array of frames, or the array `wanted.variable`, with the times next to it, and
    texts or numbers for each frame or recording that `wanted.fields` asks for. ends: as in Table.

    No other array is read. Raises FormatError that lists the arrays if none or several fit.
    """
    entries = {normal(name): entry for name, entry in entries.items()}
    numbers = {name: e for name, e in entries.items() if e.kind in "biuf" or e.fields}
    if wanted.names_only:
        return Table(
            np.empty((0, 0)), beside=tuple(n for n, e in numbers.items() if e.holds_frames)
        )
    listed = _listed(numbers)
    name, time = normal(wanted.variable), normal(wanted.time)
    if name and name not in numbers:
        found = [known for known in numbers if known.rpartition("/")[2] == name]
        inside = {n: e for n, e in numbers.items() if re.match(rf"{re.escape(name)}[/.({{]", n)}
        if len(found) != 1 and inside:
            beside = {time: numbers[time]} if time in numbers else {}
            return chosen(inside | beside, replace(wanted, variable=""), ends)
        if len(found) != 1:
            raise FormatError(f"has no array {name!r}; it holds {listed}")
        (name,) = found
    tables = {name: numbers[name]} if name else {n: e for n, e in numbers.items() if e.holds_frames}
    table = _only(tables) or _series(tables) or (None if tables else _columns(numbers, time))
    if table is None and not tables:
        raise FormatError(f"holds no array of frames x taxels, but {_listed(entries)}; save one")
    if table is None:
        raise FormatError(
            f"holds {len(tables)} arrays of frames; name one with --variable: it holds {listed}"
        )
    vectors = {n: e for n, e in numbers.items() if e.is_vector and n != name}
    asked = {time: vectors[time].read().ravel()} if time in vectors else {}
    texts = (*wanted.fields, *([] if time in vectors else [time]))
    labels = _labels(entries, texts, ends, len(table.values))
    only = next(iter(tables)) if len(tables) == 1 else ""
    made = replace(table, vectors=asked, beside=tuple(vectors), labels=labels, array=only)
    return replace(made, ends=tuple(ends))


def _labels(
    entries: Mapping[str, Entry], fields: Sequence[str], ends: Sequence[int], count: int
) -> dict[str, list[str]]:
    """Arrays of these names that hold a text or a number for each of `count` frames, or for each
    recording, as texts."""
    found: dict[str, list[str]] = {}
    for asked in fields:
        named = [e for n, e in entries.items() if asked in (n, n.rpartition("/")[2])]
        if len(named) != 1 or named[0].size not in (count, len(ends)):
            continue
        texts = as_texts(named[0].read().ravel().tolist())
        of_recordings = len(texts) == len(ends) and len(texts) != count
        repeats = np.diff([0, *ends]).tolist() if of_recordings else [1] * count
        found[asked] = [text for text, n in zip(texts, repeats, strict=True) for _ in range(n)]
    return found


def _only(tables: Mapping[str, Entry]) -> Table | None:
    """The table of the only array."""
    if len(tables) != 1:
        return None
    (entry,) = tables.values()
    return records(entry.read()) if entry.fields else Table(entry.read())


def _series(tables: Mapping[str, Entry]) -> Table | None:
    """Arrays of one shape whose names differ in a running number, as the frames of a table."""
    found = [RUNNING.fullmatch(name) for name in tables]
    if len(tables) < LEAST_SERIES or None in found or any(e.fields for e in tables.values()):
        return None
    numbered = {int(one[2]): name for one, name in zip(found, tables, strict=True) if one}
    stems = {one.group(1, 3) for one in found if one}
    shapes = {entry.shape for entry in tables.values()}
    order = sorted(numbered)
    if len(stems) > 1 or len(shapes) > 1 or order[-1] - order[0] != len(tables) - 1:
        return None
    first, last = numbered[order[0]], numbered[order[-1]]
    frames = np.stack([np.squeeze(tables[numbered[k]].read()) for k in order])
    return Table(frames, notes=(f"its {len(order)} arrays {first} to {last} are its frames",))


def _columns(numbers: Mapping[str, Entry], time: str) -> Table | None:
    """Vectors of one length as the columns of a table, without the times."""
    vectors = {n: e for n, e in numbers.items() if e.is_vector and e.size > 1 and n != time}
    if len(vectors) < 2:
        return None
    usual = Counter(entry.size for entry in vectors.values()).most_common(1)[0][0]
    kept = [(n, e.read().ravel()) for n, e in vectors.items() if e.size == usual]
    return from_columns(kept, [f"its {len(kept)} arrays of {usual} numbers are its columns"])


def _listed(numbers: Mapping[str, Entry]) -> str:
    """The arrays of a file with their shapes, the first MOST_LISTED of them."""
    texts = [
        f"{printable(name)} {list(entry.shape)}"
        + (f" of {', '.join(map(printable, entry.fields))}" if entry.fields else "")
        + KINDS.get(entry.kind, "") * (not entry.fields)
        for name, entry in numbers.items()
    ]
    more = [f"and {len(texts) - MOST_LISTED} more"] if len(texts) > MOST_LISTED else []
    return ", ".join([*texts[:MOST_LISTED], *more]) or "nothing"


def records(values: Array) -> Table:
    """A table of a record array [n]: one column for each number of a field, one text column for
    each field of text. Fields of other kinds are passed over."""
    columns: list[Column] = []
    left: list[str] = []
    for name in values.dtype.names or ():
        part = values[name]
        if part.dtype.kind in "biuf":
            columns += parted(name, part)
        elif part.dtype.kind in "SUO" and part.ndim == 1:
            columns.append((name, as_texts(part)))
        else:
            left.append(name)
    return from_columns(columns, [f"field {n} is passed over" for n in left])


def parted(name: str, values: Array) -> list[Column]:
    """The numbers [n, ...] of a field as columns: `name`, or `name.0` and so on if they are several
    for each frame."""
    if values.ndim == 1:
        return [(name, values)]
    return [(f"{name}.{k}", column) for k, column in enumerate(values.reshape(len(values), -1).T)]


def as_texts(values: Iterable[Any]) -> list[str]:
    """Values as texts; bytes are read as UTF-8."""
    return [v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values]


def from_columns(
    columns: Sequence[Column], notes: Sequence[str] = (), faults: Mapping[int, str] | None = None
) -> Table:
    """A table of columns of equal length, in the smallest type that holds all numbers. faults: as
    in Table. Raises FormatError if no column holds numbers."""
    names = [normal(name) for name, _ in columns]
    texts = {i: found for i, (_, found) in enumerate(columns) if isinstance(found, list)}
    if len(texts) == len(columns):
        raise FormatError(f"holds no numbers; its columns are {', '.join(names) or 'none'}")
    kinds = [found.dtype for _, found in columns if not isinstance(found, list)]
    common = np.result_type(*kinds)
    if common.kind == "b":
        common = np.dtype(np.uint8)
    values = np.empty((len(columns[0][1]), len(columns)), common)
    for i, (_, column) in enumerate(columns):
        values[:, i] = 0 if i in texts else column
    return Table(values, tuple(names), texts=texts, faults=faults or {}, notes=tuple(notes))


def asked_topics(topics: Container[str], wanted: ReadPlan) -> dict[str, str]:
    """The topics of a recording that are wanted as fields, with or without their first slash."""
    return {n: at for n in wanted.fields for at in (n, f"/{n}") if at in topics}


def labelled(
    table: Table, at_ns: Sequence[int], said: Mapping[str, Sequence[tuple[int, str]]]
) -> Table:
    """The table with `labels`: of each topic in `said`, its times in ns and texts, the last text
    before a frame. at_ns: times of the frames.

    Frames before the first label are left out. Raises FormatError if none is left.
    """
    labels, first = dict[str, list[str]](), 0
    for topic, texts in said.items():
        which = np.searchsorted([t_ns for t_ns, _ in texts], at_ns, side="right") - 1
        if (before := int((which < 0).sum())) == len(at_ns):
            raise FormatError(f"{topic} says nothing before the last frame; say labels earlier")
        labels[topic] = [texts[k][1] for k in which]
        first = max(first, before)
    note = f"{first} frames before the first label are left out"
    return replace(
        table,
        values=table.values[first:],
        vectors={name: times[first:] for name, times in table.vectors.items()},
        texts={column: texts[first:] for column, texts in table.texts.items()},
        notes=(*table.notes, *[note] * (first > 0)),
        labels={topic: texts[first:] for topic, texts in labels.items()},
    )


def only(what: str, known: Mapping[str, str], variable: str, fits: Callable[[str], bool]) -> str:
    """The name among `known` that `variable` asks for, else the only one that `fits`.

    what: these parts of a file in the singular, such as topic. known: a remark on each, "" for
    none. Raises FormatError that lists them.
    """
    name = normal(variable)
    told = [f"{printable(n)} ({remark})" if remark else printable(n) for n, remark in known.items()]
    listed = ", ".join(told) or "nothing"
    if name and name not in known:
        raise FormatError(f"has no {what} {name!r}; it holds {listed}")
    fitting = [name] if name else list(filter(fits, known))
    if len(fitting) != 1:
        raise FormatError(
            f"holds {len(fitting)} {what}s of frames; name one with --variable: it holds {listed}"
        )
    return fitting[0]
