"""Reads spreadsheets (.xlsx, .xlsm, .xlsb, .xls, .ods) with python-calamine."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from appliance.core.errors import FormatError
from train.data.files import text
from train.data.files.optional import library
from train.data.files.table import ReadPlan, Table, normal

SUFFIXES = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods")


def read(path: Path, wanted: ReadPlan) -> Table:
    """The sheet with frames, or the sheet `wanted.variable`; its rows are read as the lines of a
    text. Raises FormatError that names the line."""
    calamine = library("python_calamine", "a spreadsheet")
    book = calamine.CalamineWorkbook.from_path(str(path))
    sheets = {normal(name): name for name in book.sheet_names}
    variable = normal(wanted.variable)
    if variable and variable not in sheets:
        raise FormatError(f"has no sheet {variable!r}; it holds {', '.join(sheets)}")
    tables: dict[str, Table] = {}
    why = "holds no line of numbers"
    for name in [variable] if variable else sheets:
        rows = book.get_sheet_by_name(sheets[name]).to_python(skip_empty_area=False)
        try:
            tables[name] = text.table(_lines(rows), wanted, delimiter=",", decimal=".")
        except FormatError as e:
            if str(e) != why:
                raise FormatError(f"sheet {name}: {e}") from e
    if len(tables) > 1:
        raise FormatError(
            f"holds {len(tables)} sheets of frames, {', '.join(tables)}; name one with --variable"
        )
    if not tables:
        raise FormatError(why)
    return next(iter(tables.values()))


def _lines(rows: Sequence[Sequence[Any]]) -> list[str]:
    """The rows of a sheet as lines of CSV."""
    lines = []
    for row in rows:
        line = io.StringIO()
        csv.writer(line, lineterminator="").writerow([_cell(value) for value in row])
        lines.append(line.getvalue() if any(value != "" for value in row) else "")
    return lines


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1 << 53 else repr(value)
    return " ".join(str(value).split())
