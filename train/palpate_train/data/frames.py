"""Frames of taxels from the table of a file: which axis is time, which column is a taxel, and which
columns hold times or fields. Nothing is guessed: an ambiguous table raises an error."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from itertools import pairwise

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.core.text import printable
from palpate.core.types import LARGEST_READING
from palpate_train.data import sampling
from palpate_train.data.files.table import MOST_LISTED, Table, excerpt, normal
from palpate_train.data.import_plan import DATE, ImportPlan

RANGE = re.compile(r"([1-9]\d*)(?:-([1-9]\d*))?")
DAY = re.compile(r"(\d{4}-\d\d-\d\d|\d{1,2}[./]\d{1,2}[./]\d{2,4})[T ].*")
"""A date with a clock time; the first group is the day."""
DAY_S = sampling.UNITS_S["d"]
_NAMED = r"\d{1,2}\.?[- ][^\W\d_]{3,9}\.?[- ]\d{2,4}|[A-Za-z]{3,9} \d{1,2}(?:,? \d{4})?"
MOMENT = re.compile(
    r"(?:(?:[A-Z][a-z]{1,8},? )?"
    rf"(?P<day>\d{{1,4}}[-./年]\d{{1,2}}[-./月]\d{{1,4}}日?|{_NAMED})[T ,_-]+)?"
    r"(?:(?P<since>\d+)(?: days?,? |\.(?=\d\d:)))?(?P<hour>\d{1,2}):(?P<minute>\d{1,2})"
    r"(?::(?P<second>\d{1,2}(?:[.,]\d+|:\d{3}(?:\d{3})?)?))?\s?(?P<noon>[aApP]\.?[mM]\.?)?"
    r"\s?(?P<zone>Z|UTC|GMT|[+-]\d\d(?::?\d\d)?)?\s?(?P<place>[A-Z]{3,5}|\[[\w/]+\])?"
    r"(?P<year> \d{4})?"
)
"""A time of the day, perhaps with its date and zone; the year may stand at the end. Or a time since
the beginning, with its days."""
COMPACT = re.compile(r"(\d{4})-?(\d\d)-?(\d\d)[T_ -](\d\d)-?(\d\d)-?(\d\d)(?:[._,-](\d+))?(Z?)")
"""The same in digits, perhaps with -, as in names of files."""
MINUTES = re.compile(r"(\d{1,2}):(\d\d[.,]\d+)")
"""Minutes and seconds alone, as spreadsheets write times below an hour."""
WITH_UNIT = re.compile(r"([-+]?\d+(?:[.,]\d*)?(?:[eE][-+]?\d+)?)\s*(?P<unit>[^\W\d_]+)")
WORDS = {
    "s": "s", "sec": "s", "second": "s", "ms": "ms", "msec": "ms", "millisecond": "ms",
    "us": "us", "usec": "us", "\u00b5s": "us", "\u03bcs": "us", "microsecond": "us",
    "ns": "ns", "nsec": "ns", "nanosecond": "ns", "min": "min", "minute": "min",
    "h": "h", "hr": "h", "hour": "h", "d": "d", "day": "d",
}  # fmt: skip
"""Units of times behind each number, as tables of durations have them."""

SQUARE = (
    "if MATLAB's h5write wrote it, rows and columns have changed places: give --axes "
    "frame,column,row"
)


class GridMissing(FormatError):
    """Columns of taxels without --grid, which says how they lie."""


def frames(table: Table, plan: ImportPlan) -> tuple[Array, Array | None, list[str]]:
    """The frames [n, R, C] or [n, R, C, A] of a table, as recorded; their times [n] in seconds, or
    None without --time; and remarks.

    Raises FormatError with the option that decides, or the first reading that is not a
    number.
    """
    if plan.order == ("taxel", "frame") and table.values.ndim == 2:
        table, plan = _turned(table), replace(plan, axes="frame,taxel", transpose=False)
    values = table.values.astype(np.uint8) if table.values.dtype.kind == "b" else table.values
    if values.dtype.kind not in "iuf" or values.ndim < 2 or not values.size:
        raise FormatError(
            f"holds {values.dtype} {list(values.shape)}; give an array of frames x taxels"
        )
    values = _without_single_axes(values, plan)
    values, notes = _time_first(values, table, plan)
    at, time_s = _times(values, table, plan)
    chosen = _taxels(values, table, plan, at)
    if chosen.dtype.kind == "f" and (bad := ~(np.abs(chosen) <= LARGEST_READING)).any():
        index = np.argwhere(bad)[0]
        value, taxel = chosen[tuple(index)], ", ".join(map(str, index[1:] + 1))
        limit = "" if not np.isfinite(value) else f"no skin reads more than {LARGEST_READING:g}: "
        raise FormatError(
            f"frame {index[0] + 1}, taxel {taxel} is {value:g}; {limit}fill it in or cut it away"
        )
    return chosen, time_s, notes


def _turned(table: Table) -> Table:
    """A table of a row for each taxel as one of a column for each, with the name before the row.
    Raises FormatError for a cell that is not a number."""
    numbers = [i for i in range(table.values.shape[1]) if i not in table.texts]
    _check_numbers(table, numbers)
    names = tuple(*table.texts.values()) if len(table.texts) == 1 else ()
    return replace(table, values=table.values[:, numbers].T, columns=names, texts={}, faults={})


def _without_single_axes(values: Array, plan: ImportPlan) -> Array:
    """The array without axes of length 1 that --grid does not have, such as the channel of
    PyTorch."""
    others = tuple(n for n in values.shape if n > 1)
    if plan.order or not plan.shape or 1 in plan.shape or len(others) != len(plan.shape) + 1:
        return values
    return values.reshape(others)


def _time_first(values: Array, table: Table, plan: ImportPlan) -> tuple[Array, list[str]]:
    """The array with its frames along the first axis.

    Time is the first or the last axis if only that fits --grid, the times or the window.
    """
    if plan.order:
        return _ordered(values, plan), []
    if values.ndim == 2:
        wide, want = values.shape[1], int(np.prod(plan.shape))
        if plan.shape and len(values) == wide == want and not table.columns:
            raise FormatError(
                f"holds {list(values.shape)}: both axes could be the {want} taxels; "
                "say which with --axes frame,taxel or --axes taxel,frame"
            )
        return values, []
    first, last = _fits(values, 0, table, plan), _fits(values, values.ndim - 1, table, plan)
    if plan.shape and not (first or last):
        return values, []  # its frames differ from the grid, as _taxels says
    if first == last:
        names = ",".join(("row", "column", "axis")[: values.ndim - 1])
        what = "the first and the last axis could both be" if first else "neither end can be"
        raise FormatError(
            f"holds {list(values.shape)}: {what} the time; "
            f"say with --axes frame,{names} or --axes {names},frame, or give --grid"
        )
    if first:
        square = values.ndim == 3 and values.shape[1] == values.shape[2]
        return values, [SQUARE] if square and table.reversible else []
    moved = np.moveaxis(values, -1, 0)
    return moved, [f"its last axis is the time: frames of {list(moved.shape[1:])}"]


def _fits(values: Array, axis: int, table: Table, plan: ImportPlan) -> bool:
    """Whether the first or last axis can be the time."""
    others = values.shape[1:] if axis == 0 else values.shape[:-1]
    if plan.shape and others != plan.shape:
        return False
    name, _, _ = plan.time.rpartition(":")
    if name in table.vectors and len(table.vectors[name]) != values.shape[axis]:
        return False
    if plan.shape:
        return True
    if values.ndim == 4 and others[-1] > 8:
        return False
    if plan.rate_hz is None:
        return bool(name) or values.shape[axis] == max(values.shape)
    return bool(values.shape[axis] >= plan.window.frames(plan.rate_hz))


def _ordered(values: Array, plan: ImportPlan) -> Array:
    """The array with the axes that --axes names, as [frame, row, column(, axis)] or
    [frame, taxel]."""
    order = plan.order
    if len(order) != values.ndim:
        given = "--transpose" if plan.transpose else f"--axes {plan.axes}"
        raise FormatError(
            f"holds {list(values.shape)}, but {given} names {len(order)} axes; "
            "name each axis with --axes"
        )
    wanted = [name for name in ("frame", "row", "column", "taxel", "axis") if name in order]
    turned = np.transpose(values, [order.index(name) for name in wanted])
    if "taxel" in order and "axis" in order:
        return turned.reshape(len(turned), -1)
    return turned


def _times(values: Array, table: Table, plan: ImportPlan) -> tuple[int | None, Array | None]:
    """The number of the time column, None if `values` has no such column, and the times [n] in
    seconds."""
    if not plan.time:
        return None, None
    name, _, unit = plan.time.rpartition(":")
    name = normal(name)
    if name in table.vectors and unit != DATE:
        time_s = table.vectors[name] * sampling.UNITS_S[unit]
        if len(time_s) != len(values):
            raise FormatError(f"{name} holds {len(time_s)} times, there are {len(values)} frames")
        return None, time_s
    if name in table.labels and unit == DATE:
        return None, _dates(name, table.labels[name])
    if values.ndim != 2 or (not table.columns and table.beside and not RANGE.fullmatch(name)):
        raise FormatError(
            f"has no times {name!r}; next to the frames it has "
            f"{', '.join(table.beside) or 'nothing'}"
        )
    (at,) = column_numbers(name, table.columns, values.shape[1], "--time", 1)
    if unit == DATE:
        return at, _dates(name, table.texts.get(at, ()))
    if at in table.texts:
        found = [WITH_UNIT.fullmatch(text.strip()) for text in table.texts[at]]
        units = {_unit(one["unit"].lower()) if one else "" for one in found}
        if units == {unit}:
            numbers = [float(one[1].replace(",", ".")) for one in found if one]
            return at, np.array(numbers) * sampling.UNITS_S[unit]
        if len(units) == 1 and (other := units.pop()):
            raise FormatError(f"column {name} holds times in {other}; write --time {name}:{other}")
        raise FormatError(
            f"column {name} holds text, such as {excerpt(table.texts[at][0])}; "
            f"for dates with a clock time write --time {name}:{DATE}"
        )
    _check_numbers(table, [at])
    return at, values[:, at] * sampling.UNITS_S[unit]


def _unit(word: str) -> str:
    """The unit that a word means, "" for none: sec or seconds, hrs."""
    return WORDS.get(word) or WORDS.get(word.removesuffix("s"), "")


def _dates(name: str, given: Sequence[str]) -> Array:
    """The times [n] in seconds of a column of dates or of times of the day, from its first on.
    Raises FormatError."""
    if not given:
        raise FormatError(f"column {name} holds numbers, not dates; name their unit")
    texts = [COMPACT.sub(_apart, text.strip(" '")) for text in given]
    texts = [f"0:{text}" if MINUTES.fullmatch(text) else text for text in texts]
    found = [MOMENT.fullmatch(text) for text in texts]
    if None in found:
        k = found.index(None)
        raise FormatError(
            f"frame {k + 1}: {given[k]!r} in column {name} is not a date such as "
            "2026-01-31 12:00:00.5"
        )
    parts = [one.groupdict("") for one in found if one]
    if len(places := sorted({one["place"] for one in parts if not one["zone"]})) > 1:
        raise FormatError(
            f"column {name} has times in {' and '.join(places)}; write the zone as +01:00"
        )
    clock = np.array([_clock_s(one) + DAY_S * int(one["since"] or 0) for one in parts])
    days = _days(name, [one["day"] + one["year"] for one in parts], clock)
    times: Array = (days - days[0]) * DAY_S + clock - clock[0]
    return times


def _apart(found: re.Match[str]) -> str:
    """A time of COMPACT with the usual signs between its parts."""
    year, month, day, hour, minute, second, fraction, zone = found.groups("")
    return f"{year}-{month}-{day} {hour}:{minute}:{second}.{fraction or 0}{zone}"


def _days(name: str, texts: Sequence[str], clock: Array) -> Array:
    """The days [n] as numbers. A day in any form is the next one if the clock begins again with it.
    Raises FormatError."""
    if len({*texts}) == 1 and texts[0]:
        return np.zeros(len(texts))
    iso = [re.sub(r"^(\d{1,2})\.(\d{1,2})\.(\d{4})$", r"\3-\2-\1", text) for text in texts]
    iso = [re.sub(r"-(\d)(?!\d)", r"-0\1", text.replace("/", "-")) for text in iso]
    midnights = np.diff(clock, prepend=clock[0]) < -DAY_S / 2
    try:
        days: Array = np.array(iso, "datetime64[D]").astype(np.int64)
    except ValueError as e:
        changes = [False, *(a != b for a, b in pairwise(texts))]
        if changes != midnights.tolist():
            day = next(text for text in texts if text != texts[0])
            raise FormatError(
                f"the day changes from {texts[0]!r} to {day!r} in column {name}, and not at "
                "midnight; write days as 2026-01-31"
            ) from e
        return np.cumsum(midnights)
    return days if any(texts) else np.cumsum(midnights)


def _clock_s(parts: Mapping[str, str]) -> float:
    """The time of the day in seconds, in the zone of its date."""
    hours, noon = int(parts["hour"]), parts["noon"].lower().replace(".", "")
    hours = hours % 12 + 12 * (noon == "pm") if noon else hours
    zone = re.fullmatch(r"([+-])(\d\d):?(\d\d)?", parts["zone"])
    minutes = 60 * int(zone[2]) + int(zone[3] or 0) if zone else 0
    offset = 60 * minutes * (-1 if zone and zone[1] == "-" else 1)
    seconds = float(re.sub("[,:]", ".", parts["second"]) or 0)
    return 3600 * hours + 60 * int(parts["minute"]) + seconds - offset


def _taxels(values: Array, table: Table, plan: ImportPlan, time_column: int | None) -> Array:
    """The counts of the taxels, [n, R, C] or [n, R, C, A]."""
    shape = plan.shape
    if values.ndim > 2:
        if plan.columns or (shape and values.shape[1:] != shape):
            raise FormatError(
                f"holds frames of shape {list(values.shape[1:])}; "
                "leave --columns out, and leave --grid out or give that shape, "
                "or name the axes with --axes"
            )
        return values
    if not shape:
        count = values.shape[1] - len(table.texts)
        raise GridMissing(
            f"has {count} columns; give their layout with --grid, e.g. 4x4 for 16 taxels"
        )
    wide, want = values.shape[1], int(np.prod(shape))
    if plan.columns:
        numbers = column_numbers(plan.columns, table.columns, wide, "--columns")
        numbers = _by_number(numbers, table.columns) if "*" in plan.columns else numbers
    else:
        asked = plan.fields.values() if table.columns else ()
        fields = [one for one in asked if not _is_fact(table, one)]
        others = [column_numbers(one, table.columns, wide, "--field", 1)[0] for one in fields]
        others += [*table.texts, -1 if time_column is None else time_column]
        numbers = [i for i in range(wide) if i not in others]
        numbers = _by_number(numbers, table.columns)
    _check_numbers(table, numbers)
    if time_column is not None:
        _check_own_times(values, table, time_column, numbers)
    if len(numbers) != want:
        why = _mismatch(len(numbers), len(values), plan, time_column)
        if table.texts and not plan.columns:
            at, texts = next(iter(table.texts.items()))
            why += f"; column {at + 1} is text, such as {excerpt(texts[0])}"
        why += "".join(f"; {note}" for note in table.notes if "left out: it" in note)
        raise FormatError(why)
    return values[:, numbers].reshape(len(values), *shape)


def _by_number(numbers: list[int], names: Sequence[str]) -> list[int]:
    """Columns in the order of the numbers in their names, if they stand in the order of letters, as
    s0, s1, s10, s2: programs sort names so, but no skin its taxels."""
    given = [names[i] for i in numbers] if names else []
    if not given or len({*given}) < len(given) or given != sorted(given):
        return numbers
    key = {name: re.sub(r"\d+", lambda found: f"{int(found[0]):09d}", name) for name in given}
    return sorted(numbers, key=lambda i: key[names[i]])


def _check_own_times(values: Array, table: Table, at: int, taxels: Sequence[int]) -> None:
    """Raise FormatError if a taxel has a time of its own, under the name of the time column `at`,
    which differs from it by more than half a frame."""
    if not table.columns or not table.columns[at] or at in table.texts:
        return
    time = values[:, at]
    for i in taxels:
        if i and i - 1 != at and table.columns[i - 1] == table.columns[at]:
            apart = np.abs(values[:, i - 1] - time).max()
            if not apart <= np.median(np.abs(np.diff(time))) / 2:
                raise FormatError(
                    f"column {i} holds other times than column {at + 1}, by up to {apart:g}; "
                    "export all channels at the same times"
                )


def _mismatch(count: int, rows: int, plan: ImportPlan, time_column: int | None) -> str:
    """The message about a number of columns that does not fill the grid."""
    which = "it has" if time_column is None else "without the time it has"
    which = "--columns gives" if plan.columns else which
    want = int(np.prod(plan.shape))
    turned = f"it has {want} rows, so add --transpose"
    advice = turned if rows == want else "see --columns and --grid"
    return f"{which} {count} columns, but a grid of {plan.grid} needs {want}; {advice}"


def _check_numbers(table: Table, numbers: Sequence[int]) -> None:
    """Raise FormatError if one of the columns has a cell that is not a number."""
    for i in numbers:
        if i in table.texts:
            name = f" {table.columns[i]!r}" if table.columns else ""
            raise FormatError(
                f"column {i + 1}{name} holds text, such as {excerpt(table.texts[i][0])}; "
                "name the columns of the taxels with --columns"
            )
    if found := [table.faults[i] for i in sorted(table.faults) if i in numbers]:
        raise FormatError(found[0])


def column_numbers(
    text: str, names: Sequence[str], wide: int, option: str, most: int = 1 << 20
) -> list[int]:
    """Column numbers, from 0, for a comma-separated list `text`.

    Each entry is a name, a name with *, a number from 1, or a range such as 2-17.
    """
    text = normal(text)
    found: list[int] = []
    for part in (text,) if text in names else text.split(","):
        if part in names:
            found.append(_named(part, names, option))
        elif (bare := part.lstrip("#% ")) in names:  # the sign of a comment before the first name
            found.append(_named(bare, names, option))
        elif number := RANGE.fullmatch(part):
            first, last = int(number[1]), int(number[2] or number[1])
            if not first <= last <= wide:
                raise FormatError(f"{option} {part}: it has {wide} columns")
            found += range(first - 1, last)
        elif matching := [
            i for i, name in enumerate(names) if "*" in part and fnmatchcase(name, part)
        ]:
            for i in matching:
                _named(names[i], names, option)
            found += matching
        else:
            known = f"its {wide} columns have no names: use numbers"
            if names:
                more = len(names) - 2 * MOST_LISTED
                known = f"its columns are {', '.join(names[: 2 * MOST_LISTED])}"
                known += f" and {more} more" * (more > 0)
            raise FormatError(f"{option}: there is no column {part!r}; {known}")
    if len(set(found)) < len(found) or len(found) > most:
        raise FormatError(
            f"{option} {text} names {'a column twice' if len(found) <= most else 'several columns'}"
        )
    return found


def _named(name: str, names: Sequence[str], option: str) -> int:
    """The number of the column `name`, from 0. Raises FormatError if several have the name, or if
    the name is the number of another column."""
    where = [i for i, other in enumerate(names) if other == name]
    if len(where) > 1:
        listed = " and ".join(str(i + 1) for i in where)
        raise FormatError(
            f"{option}: columns {listed} are all called {name!r}; use their numbers, "
            f"such as {where[0] + 1}"
        )
    if (
        RANGE.fullmatch(name)
        and name != str(where[0] + 1)
        and int(name.split("-")[0]) <= len(names)
    ):
        raise FormatError(
            f"{option}: {name!r} is the name of column {where[0] + 1} and the number of another; "
            f"write {where[0] + 1}-{where[0] + 1} for the first, {name}-{name} for the other"
        )
    return where[0]


def _is_fact(table: Table, name: str) -> bool:
    """Whether --field means a fact or texts next to the frames. A column of the name is first."""
    known = {*table.facts, *table.labels}
    return normal(name) in known and normal(name) not in table.columns


def fields(
    table: Table, given: Mapping[str, str], count: int
) -> list[tuple[slice, dict[str, str]]]:
    """The parts of a table within which the columns `given` by field do not change and no recording
    ends, and the fields of each part. A fact holds for all frames. Of a date with a clock time, the
    day counts. Raises FormatError for an empty cell."""
    columns: dict[str, list[str]] = {}
    for name, column in given.items():
        if _is_fact(table, column):
            known = normal(column)
            columns[name] = list(table.labels.get(known, ())) or [table.facts[known]] * count
            continue
        if table.values.ndim > 2 or (not table.columns and not RANGE.fullmatch(column)):
            listed = ", ".join(map(printable, table.facts)) or "none"
            raise FormatError(f"--field: there is no fact {column!r}; it has {listed}")
        (at,) = column_numbers(column, table.columns, table.values.shape[1], "--field", 1)
        _check_numbers(table, [] if at in table.texts else [at])
        texts = (
            [DAY.sub(r"\1", text.strip()) for text in table.texts[at]]
            if at in table.texts
            else [f"{value:g}" for value in table.values[:, at]]
        )
        if "" in texts:
            raise FormatError(f"frame {texts.index('') + 1} has no {name} in column {column}")
        columns[name] = texts
    rows = list(zip(*columns.values(), strict=True)) if columns else [()] * count
    ends = {*table.ends}
    starts = [0, *(k for k in range(1, count) if rows[k] != rows[k - 1] or k in ends)]
    return [
        (slice(a, b), dict(zip(columns, rows[a], strict=True)))
        for a, b in zip(starts, [*starts[1:], count], strict=True)
    ]


def check_order(
    table: Table, orders: dict[tuple[str, ...], tuple[str, ...]], plan: ImportPlan
) -> None:
    """Raise FormatError if the columns of the taxels stood in another order in an earlier file:
    taxels would change places. --columns with their names gives one order to all files. orders: of
    the files so far, by the sorted names."""
    others = (plan.time.rpartition(":")[0], *plan.fields.values())
    names = enumerate(table.columns)
    columns = tuple(name for i, name in names if name not in others and i not in table.texts)
    before = orders.setdefault(tuple(sorted(columns)), columns)
    named = bool(plan.columns) and all(part in columns for part in plan.columns.split(","))
    if before != columns and not named:
        here, there = next((a, b) for a, b in zip(columns, before, strict=True) if a != b)
        raise FormatError(
            f"has the column {here!r} where another file has {there!r}; "
            "give the order of the taxels with --columns and their names"
        )
