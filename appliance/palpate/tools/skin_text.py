"""Proposes a profile for lines of numbers, for `palpate skin detect`."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.io.skin_codecs.text import closes, split

LEAST_LINES = 8
LEAST_SHARE = 0.8
"""Share of the lines with numbers that must have the same form."""
LEAST_STRAIGHT = 0.85
"""Share of the variance of a column that a straight line explains if it is a time or a count."""

Line = tuple[list[bytes], str]
"""Numbers of a line, and the text around them."""


def proposed(data: bytes, seconds: float) -> str:
    """The text of a profile for lines of numbers, to be checked by a person; "" if the bytes are no
    such lines. seconds: the time in which they came. The number of values in a frame shows in the
    lines, the grid does not: it is the squarest."""
    if not data.isascii() or b"\0" in data:
        return ""
    end = "\n" if b"\n" in data else "\r"
    decimal = "," if b"," in data and (b";" in data or b"\t" in data) else "."
    lines: list[Line] = []
    for line in data.split(end.encode())[1:-1]:
        lines.append(split(line, decimal))
        if closes(line):
            lines.append(([], ""))
    forms = Counter((len(words), around) for words, around in lines if words)
    if forms.total() < LEAST_LINES:
        return ""
    (width, around), often = forms.most_common(1)[0]
    if often < LEAST_SHARE * forms.total():
        return ""
    alike = [words if (len(words), text) == (width, around) else None for words, text in lines]
    height = _height(alike)
    table = np.array([[_number(word) for word in words] for words in alike if words is not None])
    skipped = [] if height > 1 else _rising(table)
    rows, cols = (height, width) if height > 1 else _grid(width - len(skipped))
    keys: dict[str, Any] = {
        "about": f"{rows} x {cols} taxels",
        "source": "lines that the skin sent",
        "codec": "text",
        "lines": "rows" if height > 1 else "frames",
        "skip_columns": skipped,
        "around": around,
        "decimal": decimal,
        "line_end": end,
        "number": "float32",
        "rows": rows,
        "cols": cols,
        "rate_hz": round(often / height / seconds, 1),
    }
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in keys.items())


def _height(alike: list[list[bytes] | None]) -> int:
    """Lines of a frame: the usual distance of the lines that part frames; 1 if there are none."""
    parting = [i for i, words in enumerate(alike) if words is None]
    steps = Counter(np.diff(parting).tolist())
    step, often = steps.most_common(1)[0] if steps else (0, 0)
    return step - 1 if step > 2 and often * step >= LEAST_SHARE * len(alike) else 1


def _rising(table: NDArray[np.float64]) -> list[int]:
    """Columns [lines, columns] that rise as a time or a count does; none if many do."""
    at = np.arange(len(table))
    rising = [
        i
        for i, column in enumerate(table.T)
        if (np.diff(column) >= 0).all()
        and np.ptp(column) > 0
        and np.corrcoef(at, column)[0, 1] ** 2 >= LEAST_STRAIGHT
    ]
    return rising if len(rising) < max(2, table.shape[1] // 4) else []


def _grid(values: int) -> tuple[int, int]:
    """Rows and columns of the squarest grid."""
    rows = max(n for n in range(1, int(values**0.5) + 1) if values % n == 0)
    return rows, values // rows


def _number(word: bytes) -> float:
    return float("nan") if word.lower() == b"null" else float(word)
