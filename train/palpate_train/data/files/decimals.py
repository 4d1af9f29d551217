"""Finds out whether a comma in a text of numbers is the decimal sign or separates thousands.

1,012 can be either. Other numbers of the same text may decide: 0,5 and 1,0125 have a decimal comma,
1,012,345 and 1,012.5 have separators. The same holds for the dot in 1.012, 0.5 and 1.012.345.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from palpate.core.errors import FormatError

TOKEN = re.compile(r"(?<![^\s;\"])[+-]?\d[\d.,]*(?:[eE][+-]?\d+)?(?![^\s;\"])")
"""A number in a text whose columns are separated by tabs, semicolons or blanks."""
QUOTED = re.compile(r'"\s*([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*"')
"""A number in quotes. In a text with commas between its columns only these can hold a comma."""
DECISIVE_DOT = re.compile(
    r"(?<![\d.,])(?:0+|[1-9]\d{3,})\.\d|(?<=\d)\.(?:\d{1,2}|\d{4,})(?![\d.,])"
)
"""A dot that can only be a decimal sign."""
GROUPS = r"[+-]?[1-9]\d{{0,2}}(?:\{0}\d{{3}})+"
_FORM = (
    r"[+-]?(?:(?:\d+|\d{{1,3}}(?:\{thousands}\d{{3}})+)(?:\{sign}\d*)?|\{sign}\d+)(?:[eE][+-]?\d+)?"
    r"|[+-]?(?:nan|inf|infinity)"
)
NUMBERS = {
    sign: re.compile(_FORM.format(sign=sign, thousands=other), re.IGNORECASE)
    for sign, other in (".,", ",.")
}
"""A number by the decimal sign of its text. 1.23,5 and 1,01.5 are none."""
Row = tuple[int, str]


def decimal_sign(
    rows: Sequence[Row], delimiter: str | None, split: Callable[[str], list[str]]
) -> str:
    """The decimal sign of numbered lines, "," or ".".

    Raises FormatError with the first ambiguous cell and the option that decides.
    """
    text = "\n".join(line for _, line in rows)
    quoted = delimiter == ","
    if quoted and not ('"' in text and QUOTED.search(text)):
        return "."
    if not quoted and "," not in text and ("." not in text or DECISIVE_DOT.search(text)):
        return "."
    found = {_evidence(token) for token in set((QUOTED if quoted else TOKEN).findall(text))}
    if "," in found and "." in found:
        raise _ambiguous(rows, split, lambda cell: _evidence(cell) == ",", "another cell has a dot")
    if "," in found or "." in found:
        return "," if "," in found else "."
    if "?," in found:
        raise _ambiguous(rows, split, lambda cell: _evidence(cell) == "?,")
    if "?." in found and (column := _mixed_column(rows, split)) is not None:
        raise _ambiguous(rows, split, lambda cell: _evidence(cell) == "?.", "", column)
    return "."


def is_number(text: str, decimal: str = "") -> bool:
    """Whether a cell is a number. decimal: "" for either sign."""
    text = text.strip()
    return any(NUMBERS[sign].fullmatch(text) for sign in decimal or NUMBERS)


def plain(text: str, decimal: str) -> str:
    """A number without separators of thousands and with a decimal dot."""
    return text.replace(".", "").replace(",", ".") if decimal == "," else text.replace(",", "")


def _evidence(cell: str) -> str:
    """The decimal sign that a number shows: "," or ".", with "?" if it could also separate
    thousands, "" if it shows none."""
    cell = cell.strip()
    last = max(cell.rfind(","), cell.rfind("."))
    if last < 0 or not is_number(cell):
        return ""
    sign = cell[last]
    other = "." if sign == "," else ","
    if other in cell:
        whole = cell[:last]
        return sign if re.fullmatch(GROUPS.format(other), whole) else ""
    if cell.count(sign) > 1:
        return other if re.fullmatch(GROUPS.format(sign), cell) else ""
    return f"?{sign}" if re.fullmatch(GROUPS.format(sign), cell) else sign


def _mixed_column(rows: Sequence[Row], split: Callable[[str], list[str]]) -> int | None:
    """The first column, from 0, that holds numbers such as 1.012 next to whole numbers."""
    dotted: set[int] = set()
    whole: set[int] = set()
    for _, line in rows:
        for column, cell in enumerate(split(line)):
            if _evidence(cell) == "?.":
                dotted.add(column)
            elif cell.strip().lstrip("+-").isdecimal() and cell.strip("+-0 "):
                whole.add(column)
    return min(dotted & whole, default=None)


def _ambiguous(
    rows: Sequence[Row],
    split: Callable[[str], list[str]],
    bad: Callable[[str], bool],
    why: str = "",
    only: int | None = None,
) -> FormatError:
    for i, line in rows:
        for column, cell in enumerate(split(line)):
            if bad(cell.strip()) and only in (None, column):
                both = plain(cell, "."), plain(cell, ",")
                return FormatError(
                    f"line {i}, column {column + 1} is {cell.strip()!r}"
                    + (f", and {why}" if why else "")
                    + f"; say with --decimal . that this is {both[0].strip()}, "
                    f"or with --decimal , that it is {both[1].strip()}"
                )
    return FormatError("mixes decimal commas and dots; say which with --decimal . or --decimal ,")
