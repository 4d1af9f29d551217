"""Reads MAT files of all versions and MATLAB's figures.

mat_v4.py reads version 4, mat_v5.py versions 5 to 7; version 7.3 is HDF5. Arrays are found in
structures and cells too, by a path such as data.skin or runs{2}.skin. Texts, dates, tables and
other objects are passed over.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.files import hdf5, mat_v4, mat_v5
from palpate_train.data.files.mat_v5 import Struct
from palpate_train.data.files.table import Array, Entry, ReadPlan, Table, chosen, from_columns

FIGURE = "hgS_070000"
"""The structure in which a .fig keeps its axes and lines."""
REMEDY = (
    "in MATLAB: l = findobj(gca, 'Type', 'line'); "
    "skin = vertcat(l.YData)'; save('skin.mat', 'skin', '-v7')"
)


def read(path: Path, wanted: ReadPlan) -> Table:
    """The wanted array of a MAT file, or the lines of a figure. Raises FormatError."""
    if h5py.is_hdf5(path):
        with h5py.File(path, "r") as file:
            if FIGURE in file:
                raise FormatError(f"is a figure of version 7.3; {REMEDY}")
            dotted = {name.replace("/", "."): e for name, e in hdf5.entries(file, True).items()}
            return chosen(dotted, wanted)
    data = path.read_bytes()
    content = mat_v4.variables(data) if mat_v4.is_version_4(data) else mat_v5.variables(data)
    if FIGURE in content:
        return _figure(content[FIGURE])
    found = mat_v5.arrays_of(content)
    return chosen(
        {n: Entry.of(v.shape, v.dtype, partial(np.asarray, v)) for n, v in found.items()}, wanted
    )


def _figure(tree: Any) -> Table:
    """The lines of a figure as columns, in the order in which they were drawn; their common x
    values are the vector `x`."""
    lines = [(x, y) for x, y in _lines(tree) if y.size > 1]
    if not lines:
        raise FormatError(f"is a figure without lines; {REMEDY}")
    x = lines[0][0]
    if any(not np.array_equal(x, other) for other, _ in lines):
        raise FormatError(f"is a figure whose lines differ in their x values; {REMEDY}")
    names = [f"line {k}" for k in range(1, len(lines) + 1)]
    table = from_columns(names, [y for _, y in lines], {})
    note = f"is a figure: its {len(lines)} lines are the columns"
    return Table(table.values, table.columns, {"x": x}, ("x",), notes=(note,))


def _lines(node: Any) -> Iterator[tuple[Array, Array]]:
    """x and y of all lines in a tree of graphics objects."""
    for one in node.records if isinstance(node, Struct) else ():
        properties = one.get("properties")
        values = properties.records[0] if isinstance(properties, Struct) else {}
        y = values.get("YData")
        if str(one.get("type")).endswith(("line", "lineseries")) and isinstance(y, np.ndarray):
            x = values.get("XData")
            given = isinstance(x, np.ndarray) and x.size == y.size
            at = np.asarray(x).ravel() if given else np.arange(1.0, y.size + 1)
            yield at, y.ravel()
        if values.get("Tag") != "legend":
            yield from _lines(one.get("children"))
