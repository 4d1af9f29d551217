"""Reads the labels of recordings from a table next to them: a row for each file, the file in the
first column, its material and other fields in the others, whose names stand in the first row."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from palpate.core.errors import FormatError
from palpate_train.data.file_names import GROUP
from palpate_train.data.files.table import excerpt, normal
from palpate_train.data.files.text import decoded, lines_of

LabelTable = Mapping[str, Mapping[str, str]]
"""The fields of each file, by its path below the folder or by its name."""


def read(path: Path) -> LabelTable:
    """The table in a text whose columns are separated by tabs, semicolons or commas. Raises
    FormatError if it cannot be read, or if a file or a field stands there twice or is empty."""
    try:
        content, _ = decoded(path.read_bytes())
    except OSError as e:
        raise FormatError(f"--labels {path} cannot be read: {e.strerror}; name a table") from e
    lines = [line for line in lines_of(normal(content)) if line.strip()]
    delimiter = max("\t;,", key=lines[0].count) if lines else ","
    first, *rows = list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True)) or [[]]
    names = [name.strip() for name in first[1:]]
    if not names or len(set(names)) < len(names) or not all(map(GROUP.fullmatch, names)):
        raise FormatError(
            f"--labels {path.name}: its first line is {excerpt(','.join(first))}; write file, "
            "material and other names of lower-case letters there, each once"
        )
    found: dict[str, dict[str, str]] = {}
    for number, row in enumerate(rows, 2):
        cells = [cell.strip() for cell in row]
        if len(cells) != len(first) or "" in cells or cells[0] in found:
            raise FormatError(
                f"--labels {path.name}: row {number} is {excerpt(','.join(row))}; write each file "
                f"once, with {', '.join(names)}"
            )
        found[cells[0]] = dict(zip(names, cells[1:], strict=True))
    return found
