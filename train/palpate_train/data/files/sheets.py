"""Reads spreadsheets (.xlsx, .xlsm, .xlsb, .xls, .ods) with python-calamine."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.core.errors import FormatError
from palpate_train.data.extras import library
from palpate_train.data.files import text
from palpate_train.data.files.table import ReadPlan, Table, normal

SUFFIXES = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods")
LEAST_FRAMES = 8
"""With fewer rows, or a single column of numbers, a sheet next to others holds facts."""


def read(path: Path, wanted: ReadPlan) -> Table:
    """The sheet with frames, or the sheet `wanted.variable`; its rows are read as the lines of a
    text. Raises FormatError with the line."""
    calamine = library("python_calamine", "a spreadsheet")
    book = calamine.CalamineWorkbook.from_path(str(path))
    sheets = {normal(name): name for name in book.sheet_names}
    variable = normal(wanted.variable)
    if variable and variable not in sheets:
        raise FormatError(f"has no sheet {variable!r}; it holds {', '.join(sheets)}")
    tables: dict[str, Table] = {}
    without = text.no_numbers(())
    for name in [variable] if variable else sheets:
        rows = book.get_sheet_by_name(sheets[name]).to_python(skip_empty_area=False)
        rows, notes = _filled(rows)
        try:
            tables[name] = text.table(_lines(rows), wanted, notes, delimiter=",", decimal=".")
        except FormatError as e:
            if not str(e).startswith(text.NO_NUMBERS):
                raise FormatError(f"sheet {name}: {e}") from e
            without = e
    sizes = {
        name: (len(one.values), one.values.shape[1] - len(one.texts))
        for name, one in tables.items()
    }
    most = {name for name, (rows, columns) in sizes.items() if rows >= LEAST_FRAMES and columns > 1}
    if most and not variable:
        left = [f"sheet {name} is left out" for name in tables if name not in most]
        tables = {
            n: replace(one, notes=(*one.notes, *left)) for n, one in tables.items() if n in most
        }
    if len(tables) > 1:
        raise FormatError(
            f"holds {len(tables)} sheets of frames, {', '.join(tables)}; name one with --variable"
        )
    if not tables:
        raise without
    return next(iter(tables.values()))


def _filled(rows: Sequence[Sequence[Any]]) -> tuple[list[list[Any]], list[str]]:
    """The rows without columns that are empty before the table, and without columns of remarks:
    those without a number whose cells are empty in most rows. Remarks say so."""
    wide = max(map(len, rows), default=0)
    table = [[*row, *[""] * (wide - len(row))] for row in rows]
    ahead = next((i for i in range(wide) if any(row[i] != "" for row in table)), 0)
    remarks = [
        i
        for i in range(ahead, wide)
        if all(isinstance(row[i], str) for row in table)
        and 2 * sum(row[i] != "" for row in table) < len(table)
    ]
    kept = [[v for i, v in enumerate(row) if i >= ahead and i not in remarks] for row in table]
    notes = [f"its first {ahead} columns are empty and do not count"] if ahead else []
    if any(row[i] != "" for row in table for i in remarks):
        notes.append(f"columns of remarks are left out: {', '.join(str(i + 1) for i in remarks)}")
    return kept, notes


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
