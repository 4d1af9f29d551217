"""Reads Parquet and Feather files with pyarrow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.extras import library
from palpate_train.data.files.table import Array, Column, ReadPlan, Table, from_columns, parted

SUFFIXES = (".parquet", ".pq", ".feather", ".arrow", ".arrows", ".ipc")


def read(path: Path, wanted: ReadPlan) -> Table:
    """The columns of a file; a column of lists becomes one column for each element. Raises
    FormatError with the row and the column."""
    return table(arrow(path))


def arrow(path: Path, columns: Sequence[str] | None = None) -> Any:
    """pyarrow's table. columns: the names of those to read, None for all."""
    library("pyarrow", "a Parquet or Feather file")
    if path.suffix.lower() in (".feather", ".arrow", ".arrows", ".ipc"):
        with path.open("rb") as file:
            if file.read(4) not in (b"ARRO", b"FEA1"):
                file.seek(0)
                return library("pyarrow", "a stream of Arrow").ipc.open_stream(file).read_all()
        feather = library("pyarrow.feather", "a Feather file")
        return feather.read_table(str(path), columns=columns)
    parquet = library("pyarrow.parquet", "a Parquet file")
    return parquet.ParquetFile(str(path)).read(columns=columns)


def table(content: Any) -> Table:
    """The numbers and texts of pyarrow's table. Columns of other types are passed over."""
    columns: list[Column] = []
    faults: dict[int, str] = {}
    left: list[str] = []
    while any(str(kind).startswith("struct") for kind in content.schema.types):
        content = content.flatten()
    for name in content.column_names:
        values, kind = content.column(name), str(content.column(name).type)
        if kind.startswith(("string", "large_string", "dictionary", "date", "time", "duration")):
            columns.append((name, [str(v) for v in values.to_pylist()]))
            continue
        try:
            found = numbers(values, name)
        except FormatError as e:  # another column may hold the skin
            found, faults[len(columns)] = np.full(len(values), np.nan), str(e)
        if found is None:
            left.append(name)
            continue
        several = parted(name, found)
        if values.null_count:
            row = values.to_pylist().index(None) + 1
            numbered = range(len(columns), len(columns) + len(several))
            faults |= dict.fromkeys(numbered, f"row {row} of {name} is empty")
        columns += several
    return from_columns(columns, [f"column {n} is passed over" for n in left], faults)


def numbers(values: Any, name: str) -> Array | None:
    """The numbers of a column in their type, [n] or [n, ...] for lists of equal length; None for
    another type. An empty row becomes NaN.

    Raises FormatError if lists differ in length.
    """
    flat, shape, there = _flat(values, name)
    kind = str(flat.type)
    if kind.startswith("decimal"):
        flat = flat.cast("float64")
    if flat.null_count and ("int" in kind or "bool" in kind):
        flat = flat.cast("float64")
    found = np.asarray(flat.to_numpy(zero_copy_only=False))
    if found.dtype.kind not in "biuf":
        return None
    found = found.reshape(-1, *shape)
    if there.all():
        return found
    whole = np.full((len(there), *shape), np.nan)
    whole[there] = found
    return whole


def _flat(values: Any, name: str) -> tuple[Any, tuple[int, ...], Array]:
    """The innermost elements of a column of lists, the shape of a row, and which rows are not empty
    lists, bool [n]. Raises FormatError."""
    arrow, compute = library("pyarrow", ""), library("pyarrow.compute", "")
    array = values.combine_chunks()
    if isinstance(array, arrow.ChunkedArray):  # of no or of many gigabytes
        array = arrow.concat_arrays(array.chunks) if array.num_chunks else arrow.array([])
    shape: list[int] = []
    there = np.ones(len(array), bool)
    while True:
        if isinstance(array, arrow.ExtensionArray):
            array = array.storage
        if "list" not in str(array.type).split("<")[0]:
            return array, tuple(shape), there
        if not shape:
            there = np.asarray(array.is_valid().to_numpy(zero_copy_only=False))
            array = array.drop_null()
        lengths = compute.unique(compute.list_value_length(array)).to_pylist()
        if len(lengths) != 1 or lengths == [None]:
            raise FormatError(f"column {name} holds lists of different lengths")
        shape.append(lengths[0])
        array = array.flatten()
