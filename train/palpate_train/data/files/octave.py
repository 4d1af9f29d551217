"""Reads GNU Octave's text format, which `save FILE NAMES` writes, whatever the file is called.

Each variable has a head of comments with its name, type and shape. Whole numbers, logical ones and
arrays of more than two axes stand one on a line, the first axis running fastest. A range is stored
as base, limit and increment. Seen in Octave 7.3.0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.files.table import Array, Entry, ReadPlan, Table, chosen

CREATED = "# Created by Octave"
TYPE = re.compile(
    r"(?:(?P<bool>bool)|(?P<float>float)|(?P<int>u?int(?:8|16|32|64))|(?P<range>(?:double_)?range))?"
    r" ?(?:matrix|scalar)?"
)
"""Types of real numbers; structures, cells and texts have others, and sparse and complex ones."""
HEAD = re.compile(r"# ([a-z]+): (.*)")
MOST = 100_000_000
"""Largest number of frames of a recording: a damaged range would fill the memory."""
RANGE_STEPS = 1e-6
"""Part of a step by which the limit of a range may be missed: it is stored rounded."""


def wrote(lines: Sequence[str]) -> bool:
    """Whether Octave wrote a text."""
    return bool(lines) and lines[0].startswith(CREATED)


def read(lines: Sequence[str], wanted: ReadPlan) -> Table:
    """The wanted array of the lines of a text. Raises FormatError."""
    return chosen(dict(_entries(lines)), wanted)


def ascending(base: float, increment: float, count: int) -> Array:
    """The numbers of a range, float64 [count]. Raises FormatError if it is longer than a
    recording."""
    if not 0 <= count <= MOST:
        raise FormatError(f"holds a range of {count} numbers")
    return base + increment * np.arange(count)


def _entries(lines: Sequence[str]) -> Iterator[tuple[str, Entry]]:
    """Name and array of each variable of real numbers; fields of a structure are variables too."""
    starts = [i for i, line in enumerate(lines) if line.startswith("# name: ")]
    seen: dict[str, int] = {}
    for start, stop in zip(starts, [*starts[1:], len(lines)], strict=True):
        name = lines[start].removeprefix("# name: ").strip()
        seen[name] = seen.get(name, 0) + 1
        name += f" ({seen[name]})" * (seen[name] > 1)
        end = start + 1
        while end < stop and lines[end].startswith("#"):
            end += 1
        about = filter(None, map(HEAD.fullmatch, lines[start:end]))
        head = {found[1]: found[2] for found in about}
        kind = TYPE.fullmatch(head.get("type", "").strip())
        if kind and kind[0] and "global" not in head:
            values = _values(name, kind, head, " ".join(lines[end:stop]).split())
            yield name, Entry.of(values.shape, values.dtype, values.copy)


def _values(name: str, kind: re.Match[str], head: dict[str, str], texts: list[str]) -> Array:
    """The numbers of one variable in their type and shape."""
    try:
        numbers: Array = np.array([x.replace("NA", "nan") for x in texts], np.float64)
        if kind["range"]:
            base, limit, increment = numbers.tolist()
            steps = (limit - base) / increment
            return ascending(base, increment, math.floor(steps + RANGE_STEPS) + 1)
        if "rows" in head:
            numbers = numbers.reshape(int(head["rows"]), int(head["columns"]))
        elif axes := int(head.get("ndims", 0)):
            numbers = numbers[axes:].reshape(numbers[:axes].astype(int), order="F")
        else:
            numbers = numbers.reshape(())
    except (ValueError, ArithmeticError, KeyError) as e:
        raise FormatError(f"{name}: its numbers do not fit its head: {e}") from e
    dtype = np.bool_ if kind["bool"] else np.float32 if kind["float"] else kind["int"] or np.float64
    return numbers.astype(dtype)
