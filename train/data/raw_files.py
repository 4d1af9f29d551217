"""Reads files with one recording: CSV and other text, .npy, .npz, MAT, HDF5.

Nothing is unpickled. An ambiguous file is refused, and the message names the option that decides.
"""

from __future__ import annotations

import csv
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.core.types import UNREADABLE
from train.data import mat_files
from train.data.readers import HDF5, array_in

Array = NDArray[Any]
COMMENTS = ("#", "%")
DELIMITERS = ("\t", ";", ",")
"""The first of these that occurs in a line separates its columns; without any, blanks do."""
DAMAGED = (*UNREADABLE, OSError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""Exceptions that the libraries raise for damaged files."""


@dataclass(frozen=True)
class Table:
    """One recording.

    values: [n, ...] numbers in the file's data type, float64 from text. columns: names of the
    columns, () if unnamed. vectors: one-dimensional arrays beside the values, such as times, by
    name.
    """

    values: Array
    columns: tuple[str, ...] = ()
    vectors: Mapping[str, Array] = field(default_factory=dict)


def read(path: Path, variable: str = "") -> Table:
    """The recording in a file. variable: the array to read from a file that holds several.

    Raises FormatError whose message does not repeat the file's name.
    """
    suffix = path.suffix.lower()
    try:
        if suffix == ".npy":
            return _plain(np.load(path, allow_pickle=False))
        if suffix == ".npz":
            with np.load(path, allow_pickle=False) as z:
                return _chosen({name: _array(name, z[name]) for name in z.files}, variable)
        if suffix == ".mat":
            return _chosen(_mat(path), variable)
        if suffix in HDF5 or h5py.is_hdf5(path):
            return _chosen(_hdf5(path), variable)
        return _text(path.read_bytes())
    except DAMAGED as e:
        raise FormatError(f"cannot be read: {' '.join(str(e).split())}") from e


def _array(name: str, values: Array | bytes) -> Array:
    """Member `name` of an .npz. numpy returns bytes for a member that is not an array."""
    if isinstance(values, bytes):
        raise ValueError(f"{name!r} is not an array")
    return values


def _plain(values: Array) -> Table:
    if values.dtype.names:
        return Table(structured_to_unstructured(values), values.dtype.names)
    return Table(values)


def _mat(path: Path) -> dict[str, Array]:
    """Arrays of a MAT file of any version. Version 7.3 is HDF5 with the axes reversed."""
    if h5py.is_hdf5(path):
        return {name: values.T for name, values in _hdf5(path).items()}
    return mat_files.arrays(path.read_bytes())


def _hdf5(path: Path) -> dict[str, Array]:
    """All numeric arrays of an HDF5 file, those in groups too, by their paths in it."""
    names: list[str] = []

    def keep(name: str, found: Any) -> None:
        if (
            isinstance(found, h5py.Dataset)
            and found.shape is not None
            and found.dtype.kind in "biuf"
        ):
            names.append(name)

    with h5py.File(path, "r") as file:
        file.visititems(keep)
        return {name: array_in(file, name) for name in names}


def _printable(name: str) -> str:
    """A name from a file, safe for a terminal: names in a damaged file may hold any bytes."""
    return name if name.isprintable() else repr(name)


def _chosen(arrays: Mapping[str, Array], variable: str) -> Table:
    """The only array of frames, or the array `variable`, with the vectors beside it."""
    numbers = {name: values for name, values in arrays.items() if values.dtype.kind in "biuf"}
    tables = {
        name: values
        for name, values in numbers.items()
        if values.ndim > 1 and min(values.shape) > 1
    }
    listed = (
        ", ".join(f"{_printable(name)} {list(values.shape)}" for name, values in numbers.items())
        or "nothing"
    )
    if variable:
        if variable not in numbers:
            raise FormatError(f"has no array {variable!r}; it holds {listed}")
        tables = {variable: numbers[variable]}
    if len(tables) != 1:
        raise FormatError(
            f"holds {len(tables)} arrays of frames; name one with --variable: it holds {listed}"
        )
    vectors = {
        name: values.ravel()
        for name, values in numbers.items()
        if max(values.shape, default=0) == values.size
    }
    (values,) = tables.values()
    return Table(values, vectors=vectors)


def _text(data: bytes) -> Table:
    """Lines of numbers, possibly after lines of text.

    The first line of text with as many cells as the numbers names the columns.
    """
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise FormatError("is UTF-16; save it as UTF-8")
    lines = data.decode("utf-8-sig", errors="replace").splitlines()
    kept = [
        (i, line)
        for i, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith(COMMENTS)
    ]
    delimiter = next((d for d in DELIMITERS if kept and d in kept[-1][1]), None)
    decimal_comma = delimiter in ("\t", ";")
    rows = [(i, line.replace(",", ".") if decimal_comma else line) for i, line in kept]
    first = next(
        (k for k, (_, line) in enumerate(rows) if _all_numbers(cells(line, delimiter))), len(rows)
    )
    if first == len(rows):
        raise FormatError("holds no line of numbers")
    body = rows[first:]
    if delimiter and all(
        line.rstrip().endswith(delimiter) for _, line in body
    ):  # the last column is empty
        body = [(i, line.rstrip()[: -len(delimiter)]) for i, line in body]
    values = _numbers(body, delimiter)
    heads = [line for _, line in kept[:first]] + [
        line.lstrip("#% ") for line in lines if line.startswith(COMMENTS)
    ]
    return Table(values, _column_names(heads, delimiter, values.shape[1]))


def _numbers(rows: Sequence[tuple[int, str]], delimiter: str | None) -> Array:
    """float64 [rows, columns] of numbered lines. Raises FormatError naming the first bad line."""
    try:
        lines = [line for _, line in rows]
        return np.loadtxt(
            lines, np.float64, comments=None, delimiter=delimiter, ndmin=2, quotechar='"'
        )
    except ValueError as e:
        raise FormatError(_fault(rows, delimiter) or str(e)) from e


def _column_names(heads: Sequence[str], delimiter: str | None, wide: int) -> tuple[str, ...]:
    """The cells of the first of `heads` that has `wide` cells, () if there is none."""
    named = ([cell.strip() for cell in cells(line, delimiter)] for line in heads)
    named = (head[:-1] if head[-1:] == [""] else head for head in named)
    return next((tuple(head) for head in named if len(head) == wide), ())


def cells(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line. delimiter: None separates at blanks."""
    return next(csv.reader([line], delimiter=delimiter)) if delimiter else line.split()


def _all_numbers(texts: Sequence[str]) -> bool:
    given = texts[:-1] if len(texts) > 1 and not texts[-1].strip() else texts
    return all(_is_number(text) for text in given)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _fault(rows: Sequence[tuple[int, str]], delimiter: str | None) -> str:
    """A message about the first line that differs from line 1 or is not numeric; "" if none."""
    wide = len(cells(rows[0][1], delimiter))
    for i, line in rows:
        found = cells(line, delimiter)
        if len(found) != wide:
            return f"line {i} has {len(found)} columns, line {rows[0][0]} has {wide}"
        for column, text in enumerate(found, 1):
            if not _is_number(text):
                return f"line {i}, column {column} is {text!r}, which is not a number"
    return ""
