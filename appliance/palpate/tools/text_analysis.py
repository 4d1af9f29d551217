"""Finds the numbers of a skin in lines of text, for `palpate skin new`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.io.skin_codecs.text import SEPARATORS, closes, split

LEAST_FRAMES = 8
SHARE = 0.8
"""As in `stream_analysis`."""
FEW_STEPS = 0.85
"""Share of the variance of a rising column that a straight line explains. Whole seconds over a
sample of three seconds reach 0.89."""
JUMPS = 0.2
"""Mean step of a column that jumps, as a part of its range; a third is expected of chance."""
_TEXT = frozenset(range(32, 127)) | frozenset(b"\t\r\n")
_COMMA_NUMBER = re.compile(rb"[+-]?[0-9]+(?:,[0-9]+)?")
_SHOWN = 60


@dataclass(frozen=True, slots=True)
class TextForm:
    """Lines of numbers that are frames. lines: of a frame. values: numbers of a line that are used.
    frames: their number. share: of the lines that they explain. keys: of the profile, where they
    differ from its defaults."""

    lines: int
    values: int
    frames: int
    share: float
    keys: dict[str, Any]


def is_text(data: bytes) -> bool:
    """Whether the bytes are text, except for a few that were damaged or come from a start."""
    others = data.count(b"\x00") + sum(byte not in _TEXT and byte < 128 for byte in data)
    high = sum(byte >= 128 for byte in data)  # a degree sign, or a name in another language
    return others <= 0.02 * len(data) and high <= 0.1 * len(data)


def forms(data: bytes, wanted: int = 0) -> list[TextForm]:
    """Possible forms of the lines, the most likely first. wanted: numbers of a frame that are used,
    beside others on their lines; 0 for any."""
    found = []
    for decimal in _decimals(data):
        end = "\n" if b"\n" in data else "\r"
        lines: list[tuple[list[bytes], str]] = []
        for line in data.split(end.encode())[1:-1]:
            lines.append(split(line, decimal))
            if closes(line):
                lines.append(([], ""))
        keys: dict[str, Any] = {"decimal": decimal} if decimal != "." else {}
        found += list(_forms(lines, keys | ({"line_end": end} if end != "\n" else {}), wanted))
    return found


def obstacle(data: bytes) -> str:
    """Why lines of text have no form, in words; "" if they have no numbers."""
    lines = [line.strip() for line in re.split(rb"[\r\n]+", data)[1:-1] if line.strip()]
    if not lines:
        return ""
    counts, arounds = zip(
        *[(len(words), around) for words, around in map(split, lines)], strict=True
    )
    shown = lines[len(lines) // 2][:_SHOWN].decode("utf-8", "replace")
    if len(set(arounds)) > 1 or not any(counts):
        text = Counter(around for around in arounds if around).most_common(1)[0][0][:_SHOWN]
        return f"text, but {text!r} stands between the numbers: {shown!r}"
    usual = ", ".join(str(count) for count, _ in Counter(counts).most_common(3))
    return f"text, but its lines have {usual} numbers: {shown!r}"


def _decimals(data: bytes) -> tuple[str, ...]:
    """Possible decimal marks, the most likely first."""
    words = re.split(rb"[" + re.escape(SEPARATORS[1:]) + rb"\n]+", data)[1:-1]
    fits = [bool(_COMMA_NUMBER.fullmatch(word)) for word in words if word]
    commas = sum(b"," in word for word in words)
    if b"," not in data or not fits or sum(fits) < 0.98 * len(fits) or commas < 0.5 * len(fits):
        return (".",)
    return (",", ".") if b";" in data or b"\t" in data else (".", ",")


def _forms(
    lines: list[tuple[list[bytes], str]], keys: dict[str, Any], wanted: int
) -> Iterator[TextForm]:
    """Forms of lines: a line is a frame, or several lines that end with another line."""
    counted = Counter((len(words), around) for words, around in lines if words)
    if len(lines) < LEAST_FRAMES or not counted:
        return
    (usual, around), often = counted.most_common(1)[0]
    rows = [(len(words), text) == (usual, around) for words, text in lines]
    ends = [i for i, row in enumerate(rows) if not row]
    spans = Counter(np.diff(ends).tolist())
    rows_between = spans.most_common(1)[0][0] - 1 if spans else 0
    height = rows_between
    if height < 1 or spans[height + 1] * (height + 1) < SHARE * len(rows):
        height = 1
    alike = len(rows) if height == 1 else max(1, len(rows) - len(ends))
    frames = spans[height + 1] if height > 1 else often
    if often / alike < SHARE or frames < LEAST_FRAMES:
        return
    keys = keys | ({"around": around} if around else {})
    begin = ends[0] if height > 1 else 0  # where a frame begins
    table = np.array(
        [_floats(words) for (words, _), row in list(zip(lines, rows, strict=True))[begin:] if row]
    )
    skips = _skipped(table, height)
    ways = [skips, ()] if skips and len(skips) < usual else [()]
    if wanted % height == 0 and 0 < wanted // height < usual:
        ways = [_beside(table, wanted // height)]
    for skip in ways:
        more = {"skip_columns": list(skip)} if skip else {}
        yield TextForm(height, usual - len(skip), frames, often / alike, keys | more)


def _floats(words: list[bytes]) -> list[float]:
    return [float("nan") if word.lower() == b"null" else float(word) for word in words]


def _skipped(table: NDArray[np.float64], height: int) -> tuple[int, ...]:
    """Columns [lines, columns] that are no taxels: the time, a count, and constant columns between
    them and the side; the number of a row, if several lines are a frame."""
    columns = table.shape[1]
    time = [_rises(table[:, i]) for i in range(columns)]
    if height > 1 and len(table) >= height:
        whole = table[: len(table) // height * height].reshape(-1, height, columns)
        for i in range(columns):
            number = whole[:, :, i] - whole[:, :1, i]
            time[i] = time[i] or bool(
                (number == np.arange(height)).mean() > SHARE and np.ptp(whole[:, 0, i]) == 0
            )
    if sum(time) > max(2, columns // 4):
        return ()  # a test pattern: all taxels rise
    still = np.ptp(table, axis=0) == 0
    first = next((i for i in range(columns) if not (time[i] or still[i])), columns)
    last = next((i for i in reversed(range(columns)) if not (time[i] or still[i])), -1)
    ahead = max((i + 1 for i in range(first) if time[i]), default=0)
    behind = min((i for i in range(last + 1, columns) if time[i]), default=columns)
    return tuple(i for i in range(columns) if i < ahead or i >= behind or time[i])


def _beside(table: NDArray[np.float64], count: int) -> tuple[int, ...]:
    """The columns beside `count` neighbours that are the taxels: those that rest, rise as time
    does or jump as a checksum does, as far as they fit."""
    columns = table.shape[1]
    strange = np.array([_is_strange(column) for column in table.T])
    inside = [int(strange[at : at + count].sum()) for at in range(columns - count + 1)]
    first = int(np.argmin(inside))
    return tuple(i for i in range(columns) if not first <= i < first + count)


def _is_strange(column: NDArray[np.float64]) -> bool:
    """Whether a column is not like the load of a taxel, which changes a little at a time."""
    steps = np.abs(np.diff(column)).mean()
    return bool(_rises(column) or np.ptp(column) == 0 or steps > JUMPS * np.ptp(column))


def _rises(column: NDArray[np.float64]) -> bool:
    """Whether a column grows evenly, as time does; it may begin again once."""
    steps = np.diff(column)
    falls = np.flatnonzero(~(steps >= 0))
    if len(falls) > 1 or not (steps > 0).any():
        return False
    parts = np.split(column, falls + 1)
    longest = max(parts, key=len)
    if len(longest) < LEAST_FRAMES or np.ptp(longest) == 0:
        return False
    at = np.arange(len(longest))
    return bool(np.corrcoef(at, longest)[0, 1] ** 2 >= FEW_STEPS)
