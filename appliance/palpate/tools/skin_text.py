"""Proposes a profile for lines of numbers, for `palpate skin detect`."""

from __future__ import annotations

import json
import re
from collections import Counter
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.io.skin_codecs.text import COLOUR, as_float, closes, split

LEAST_LINES = 8
LEAST_SHARE = 0.8
"""Share of the lines with numbers that must have the same form."""
LEAST_STRAIGHT = 0.85
"""Share of the variance of a column that a straight line explains if it is a time or a count."""

LEAST_HZ = 5.0
"""A skin sends more frames a second than this."""
SHOWN = 60
"""Characters of a line that are shown in a message."""

LEAST_COUNT = 99
"""A count that begins again goes at least so far."""
LEAST_RISING = 0.75
"""Share of steps upwards from which a number that begins again is that of a taxel."""
LEAST_CYCLES = 3
"""A number that begins again so often counts the lines of a frame."""
_FIRST = re.compile(rb"[^-+.0-9]*([0-9]{1,6})(?=[^0-9.])")
"""The first whole number of a line, which may be its own."""
_CONTROL = re.compile(rb"[^\t\n\r\x1b\x20-\x7e\x80-\xff]")
Line = tuple[list[bytes], str]
"""Numbers of a line, and the text around them."""


def proposed(data: bytes, seconds: float, grid: tuple[int, int] | None = None) -> str:
    """The text of a profile for lines of numbers, each a frame, to be checked by a person; "" for
    bytes of another kind or grid. seconds: the time in which they came. The number of values in a
    frame shows in the lines, the grid does not: without one, it is the squarest."""
    if not is_text(data):
        return ""
    data = COLOUR.sub(b"", data)
    lines, decimal, end = _divided(data)
    forms = Counter((len(words), around) for words, around in lines if words)
    if forms.total() < LEAST_LINES:
        return ""
    (width, around), often = forms.most_common(1)[0]
    if often < LEAST_SHARE * forms.total() or _counted(data.split(end.encode())[1:-1]):
        return ""
    alike = [words if (len(words), text) == (width, around) else None for words, text in lines]
    # a text that comes after every few lines parts frames of as many rows
    height = _height(alike)
    parts = height > 1 and often / height / seconds >= LEAST_HZ
    if parts and grid is None:
        return ""  # or a text between frames
    skipped = _rising(np.array([[as_float(word) for word in words] for words in alike if words]))
    if width == len(skipped):
        return ""  # a count alone
    rows, cols = grid or _grid(width - len(skipped))
    of_rows = parts and (rows, cols) == (height, width - len(skipped))
    if not of_rows and rows * cols != width - len(skipped):
        return ""
    keys: dict[str, Any] = {
        "about": f"{rows} x {cols} taxels",
        "source": "lines that the skin sent",
        "codec": "text",
        "lines": "rows" if of_rows else "frames",
        "skip_columns": skipped,
        "around": around,
        "decimal": decimal,
        "line_end": end,
        "number": "float32",
        "rows": rows,
        "cols": cols,
        "rate_hz": round(often / (rows if of_rows else 1) / seconds, 1),
    }
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in keys.items())


def _counted(lines: list[bytes]) -> bool:
    """Whether each line holds a row or a taxel with its number, so that `index` describes them, or
    a taxel that has changed. Taxels that change by little and at any time are no number."""
    found = [int(match[1]) for line in lines if (match := _FIRST.match(line))]
    runs = [(number, len(list(run))) for number, run in groupby(found)][1:-1]
    steps = np.diff([number for number, _ in runs])
    if np.count_nonzero(steps < 0) < LEAST_CYCLES:
        return False
    least, often = min(runs)[0], Counter(length for _, length in runs).most_common(1)[0][1]
    begins = np.array([number == least for number, _ in runs[1:]])
    cycles = ((steps == 1) | begins).mean() >= LEAST_SHARE or (steps > 0).mean() >= LEAST_RISING
    return bool(least <= 1 and often >= LEAST_SHARE * len(runs) and cycles)


def is_text(data: bytes) -> bool:
    """Whether bytes are text: another speed, or a binary skin, gives others."""
    cut = 4  # at both ends, within a character
    return not _CONTROL.search(data) and data.decode("utf-8", "replace").count("\ufffd") <= cut


def _divided(data: bytes) -> tuple[list[Line], str, str]:
    """The whole lines of a text, its decimal sign and the sign between its lines. A line without
    words comes after each list of lists."""
    end = "\n" if b"\n" in data else "\r"
    sent = data.split(end.encode())[1:-1]
    inner = [line.strip(b"; \t\r") for line in sent]
    parted = sum(b"," in line and (b";" in line or b"\t" in line) for line in inner)
    decimal = "," if 2 * parted > len(sent) else "."
    lines: list[Line] = []
    for line in sent:
        lines.append(split(line, decimal))
        if closes(line):
            lines.append(([], ""))
    return lines, decimal, end


def odd_line(data: bytes) -> str:
    """A line of a text that is not of the commonest form; empty for other bytes."""
    lines = [COLOUR.sub(b"", line).strip() for line in data.splitlines() if line.strip()]
    lines = lines[1:-1] or lines
    if not is_text(data) or not lines:
        return ""
    forms = [(len(words), around) for words, around in map(split, lines)]
    usual = Counter(forms).most_common(1)[0][0]
    odd = [line for line, form in zip(lines, forms, strict=True) if form != usual]
    return (odd or lines)[0][:SHOWN].decode("utf-8", "replace")


def _height(alike: list[list[bytes] | None]) -> int:
    """Lines of a frame: the usual number of lines between others; 1 if there are none."""
    runs = Counter(len(list(run)) for whole, run in groupby(alike, bool) if whole)
    height, often = runs.most_common(1)[0]
    return height if often * height >= LEAST_SHARE * sum(map(bool, alike)) and often > 1 else 1


def _rising(table: NDArray[np.float64]) -> list[int]:
    """Columns [lines, columns] that rise as a time or a count does, which may begin again; none if
    many do."""
    at = np.arange(len(table))
    rising = [
        i
        for i, column in enumerate(table.T)
        if ((np.diff(column) == 1).mean() >= LEAST_STRAIGHT and np.ptp(column) >= LEAST_COUNT)
        or (
            (np.diff(column) >= 0).all()
            and np.ptp(column) > 0
            and np.corrcoef(at, column)[0, 1] ** 2 >= LEAST_STRAIGHT
        )
    ]
    return rising if len(rising) < max(2, table.shape[1] // 4) else []


def _grid(values: int) -> tuple[int, int]:
    """Rows and columns of the squarest grid."""
    rows = max(n for n in range(1, int(values**0.5) + 1) if values % n == 0)
    return rows, values // rows
