"""Reads .npy and .npz. Nothing is unpickled, and of an .npz only the wanted arrays are read."""

from __future__ import annotations

import zipfile
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data import mapped
from palpate_train.data.files.table import Array, Entry, ReadPlan, Table, chosen, records


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
            with archive.open(member) as file, suppress(ValueError):
                shape, _, dtype = mapped.header(file)
                if not dtype.hasobject:
                    read = partial(_member, archive, member)
                    entries[member.removesuffix(".npy")] = Entry.of(shape, dtype, read)
        return chosen(entries, wanted)


def _member(archive: zipfile.ZipFile, member: str) -> Array:
    try:
        with archive.open(member) as file:
            values: Array = mapped.FORMAT.read_array(file, allow_pickle=False)
            return values
    except zipfile.BadZipFile as e:
        raise FormatError(f"{member} is damaged: {e}") from e
