"""Reads .npy and .npz. Nothing is unpickled, and of an .npz only the wanted arrays are read."""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.files.table import Array, Entry, ReadPlan, Table, chosen, records

FORMAT: Any = np.lib.format
"""NumPy's reader of headers; it has no types."""


def read_npy(path: Path, wanted: ReadPlan) -> Table:
    """The array of an .npy file. Raises FormatError or what NumPy raises for a damaged file."""
    try:
        values = np.load(path, allow_pickle=False)
    except ValueError as e:
        if "pickle" not in str(e):
            raise
        raise FormatError(
            "holds objects of Python, which are not read; save numbers with numpy.save"
        ) from e
    return records(values) if values.dtype.names else Table(values)


def read_npz(path: Path, wanted: ReadPlan) -> Table:
    """The wanted array of an .npz. Members that are not arrays, such as dictionaries, are passed
    over."""
    with zipfile.ZipFile(path) as archive:
        entries: dict[str, Entry] = {}
        for member in archive.namelist():
            with archive.open(member) as file:
                if (found := _header(file)) is not None:
                    name = member.removesuffix(".npy")
                    entries[name] = Entry.of(*found, partial(_member, archive, member))
        return chosen(entries, wanted)


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
    """Shape and type of an array, None for a member that is not an array of numbers or text."""
    try:
        version = FORMAT.read_magic(file)
        reader = FORMAT.read_array_header_1_0 if version == (1, 0) else FORMAT.read_array_header_2_0
        shape, _, dtype = reader(file)
    except ValueError:
        return None
    return None if dtype.hasobject else (shape, dtype)


def _member(archive: zipfile.ZipFile, member: str) -> Array:
    try:
        with archive.open(member) as file:
            values: Array = FORMAT.read_array(file, allow_pickle=False)
            return values
    except zipfile.BadZipFile as e:
        raise FormatError(f"{member} is damaged: {e}") from e
