"""Proposes a profile for lines of numbers, for `palpate skin detect`."""

from __future__ import annotations

import json
import re
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.io.skin_codecs.text import as_float, closes, split

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
LEAST_CYCLES = 3
"""A number that begins again so often counts the lines of a frame."""
_NUMBERED = re.compile(rb"\s*([^0-9+\-.\[(]*?)\s*([0-9]{1,6})([^0-9.+\-\w]+)(?=[0-9.+\-])")
"""Text, a number, and what parts it from the numbers of a line."""
_WORD = re.compile(rb"\s*([A-Za-z_$!>][^0-9+\-.\s:=,;]*[\s:=,;]+)")
"""The word that a line begins with."""

_CONTROL = re.compile(rb"[^\t\n\r\x1b\x20-\x7e\x80-\xff]")
_COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
"""What log lines begin and end with on a terminal."""

Line = tuple[list[bytes], str]
"""Numbers of a line, and the text around them."""


def proposed(data: bytes, seconds: float, grid: tuple[int, int] | None = None) -> str:
    """The text of a profile for lines of numbers, to be checked by a person; "" for bytes
    of another kind or grid. seconds: the time in which they came. The number of
    values in a frame shows in the lines, the grid does not: without one, it is the squarest."""
    if not is_text(data):
        return ""
    if numbered := _numbered(data, grid):
        return _written(numbered | {"rate_hz": round(numbered["rate_hz"] / seconds, 1)})
    if not (prefix := _prefix(data, grid)):
        return _of_lines(data, seconds, grid)
    begins = prefix.encode()
    chosen = [line.strip()[len(begins) :] for line in data.split(b"\n") if begins in line[:80]]
    if text := _of_lines(b"\n".join([b"", *chosen, b""]), seconds, grid):
        return text + _written({"prefix": prefix})
    return ""


def _written(keys: dict[str, Any]) -> str:
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in keys.items())


def _numbered(data: bytes, grid: tuple[int, int] | None) -> dict[str, Any]:
    """The description of lines that hold their numbers, {} for other lines. Its rate is the number
    of frames."""
    lines = data.replace(b"\r", b"\n").split(b"\n")[1:-1]
    begins, one, lines = _counted(lines)
    inner, other, rest = _counted(lines) if one else ("", 0, [])
    widths = Counter(len(split(line)[0]) for line in rest or lines)
    width = widths.most_common(1)[0][0] if one else 0
    shape = (one, other) if other else (one, width)
    if width == 1 and not other:
        shape = grid or _grid(one)
    counted = one * (other or 1)
    if not width or shape[0] > 255 or (grid or shape) != shape:
        return {}
    if shape[0] * shape[1] != counted * (width if (one, width) == shape else 1):
        return {}
    return {
        "about": f"{shape[0]} x {shape[1]} taxels",
        "source": "lines that the skin sent",
        "codec": "text",
        "lines": "rows" if width > 1 and not other else "taxels",
        "index": begins + inner,
        "line_end": "\n" if b"\n" in data else "\r",
        "number": "float32",
        "rows": shape[0],
        "cols": shape[1],
        "rate_hz": len(rest or lines) / counted,
    }


def _counted(lines: list[bytes]) -> tuple[str, int, list[bytes]]:
    """The beginning of counted lines, their number in a frame, and their further text; ("", 0, [])
    for other lines."""
    matches = [match for line in lines if (match := _NUMBERED.match(line))]
    forms = Counter((match[1], match[3]) for match in matches)
    if not forms:
        return "", 0, []
    (text, sign), _ = forms.most_common(1)[0]
    counted = [match for match in matches if (match[1], match[3]) == (text, sign)]
    numbers = np.array([int(match[2]) for match in counted])
    low, high = int(numbers.min()), int(numbers.max())
    steps = np.diff(numbers)
    begun = numbers[1:] == low
    good = (steps == 0) | (steps == 1) | (begun & (numbers[:-1] == high))
    again = np.count_nonzero(begun & (steps < 0))
    if low > 1 or high == low or again < LEAST_CYCLES or good.mean() < LEAST_SHARE:
        return "", 0, []
    begins = f"{text.decode('utf-8', 'replace')}#{sign.decode('utf-8', 'replace').strip()}"
    return begins, high - low + 1, [match.string[match.end() :] for match in counted]


def _prefix(data: bytes, grid: tuple[int, int] | None) -> str:
    """The word that begins the lines of a frame, if other lines come as often; "" if not."""
    lines = data.split(b"\n")[1:-1]
    words = Counter(match[1] for line in lines if (match := _WORD.match(line)))
    wide = {
        word: Counter(len(split(line.split(word, 1)[1])[0]) for line in lines if word in line)
        for word, n in words.items()
        if n >= LEAST_LINES and n < LEAST_SHARE * len(lines)
    }
    fitting = {
        word: widths.most_common(1)[0]
        for word, widths in wide.items()
        if not grid or widths.most_common(1)[0][0] == grid[0] * grid[1]
    }
    word = max(fitting, key=lambda word: fitting[word], default=b"")
    good = word and fitting[word][0] > 1 and fitting[word][1] >= LEAST_SHARE * words[word]
    return word.decode("utf-8", "replace").strip() if good else ""


def _of_lines(data: bytes, seconds: float, grid: tuple[int, int] | None) -> str:
    """The description of lines of one form."""
    lines, decimal, end = _divided(data)
    forms = Counter((len(words), around) for words, around in lines if words)
    if forms.total() < LEAST_LINES:
        return ""
    (width, around), often = forms.most_common(1)[0]
    if often < LEAST_SHARE * forms.total():
        return ""
    alike = [words if (len(words), text) == (width, around) else None for words, text in lines]
    table = np.array([[as_float(word) for word in words] for words in alike if words is not None])
    height, skipped = _height(alike), _rising(table)
    # a text that comes after every few frames parts them as it would part rows
    if grid != (height, width) if grid else often / height / seconds < LEAST_HZ:
        height = 1
    skipped = skipped if height == 1 else []
    rows, cols = (height, width) if height > 1 else grid or _grid(width - len(skipped))
    if rows * cols != (width - len(skipped)) * height:
        return ""
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
    return _written(keys)


def is_text(data: bytes) -> bool:
    """Whether bytes are text: another speed, or a binary skin, gives others."""
    cut = 4  # at both ends, within a character
    return not _CONTROL.search(data) and data.decode("utf-8", "replace").count("\ufffd") <= cut


def _divided(data: bytes) -> tuple[list[Line], str, str]:
    """The whole lines of a text, its decimal sign and the sign between its lines. A line without
    words comes after each list of lists."""
    end = "\n" if b"\n" in data else "\r"
    sent = data.split(end.encode())[1:-1]
    parted = sum(b"," in line and (b";" in line or b"\t" in line) for line in sent)
    decimal = "," if 2 * parted > len(sent) else "."
    lines: list[Line] = []
    for line in sent:
        lines.append(split(line, decimal))
        if closes(line):
            lines.append(([], ""))
    return lines, decimal, end


def odd_line(data: bytes) -> str:
    """A line of a text that is not of the commonest form; empty for other bytes."""
    lines = [_COLOUR.sub(b"", line).strip() for line in data.splitlines() if line.strip()]
    lines = lines[1:-1] or lines
    if not is_text(data) or not lines:
        return ""
    forms = [(len(words), around) for words, around in map(split, lines)]
    usual = Counter(forms).most_common(1)[0][0]
    odd = [line for line, form in zip(lines, forms, strict=True) if form != usual]
    return (odd or lines)[0][:SHOWN].decode("utf-8", "replace")


def _height(alike: list[list[bytes] | None]) -> int:
    """Lines of a frame: the usual distance of the lines that part frames; 1 if there are none."""
    parting = [i for i, words in enumerate(alike) if words is None]
    steps = Counter(np.diff(parting).tolist())
    step, often = steps.most_common(1)[0] if steps else (0, 0)
    return step - 1 if step > 2 and often * step >= LEAST_SHARE * len(alike) else 1


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
