"""Reads HDF5 and MATLAB's version 7.3, which is HDF5. Only the wanted arrays are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py

from palpate_train.data.files.table import Entry, ReadPlan, Table, chosen
from palpate_train.data.readers import array_in

CLASS = "MATLAB_class"
INTERNAL = ("#refs#", "#subsystem#")
"""Groups in which MATLAB keeps the contents of cells and objects."""
NUMERIC = (
    "double",
    "single",
    "logical",
    *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)),
)
"""MATLAB's classes of numeric arrays."""


def read(path: Path, wanted: ReadPlan) -> Table:
    """The wanted array of an HDF5 file, in whatever group it stands.

    Arrays that MATLAB saved with -v7.3 get MATLAB's order of axes; those of its `h5write` carry no
    sign of MATLAB. Raises FormatError.
    """
    with h5py.File(path, "r") as file:
        table = chosen(entries(file), wanted)
        saved = file.visititems(lambda name, one: True if CLASS in one.attrs else None)
        return replace(table, reversible=not saved)


def entries(file: h5py.File, matlab: bool = False) -> Mapping[str, Entry]:
    """The arrays of a file by their paths in it. Texts, cells and objects of MATLAB are left
    out. matlab: arrays without a class are MATLAB's too."""
    found: dict[str, Entry] = {}

    def keep(name: str, one: Any) -> None:
        if not isinstance(one, h5py.Dataset) or one.shape is None or name.startswith(INTERNAL):
            return
        kind = one.attrs.get(CLASS)
        kind = kind.decode("ascii", "replace") if isinstance(kind, bytes) else kind
        if kind is None and not (matlab and one.dtype.kind in "biuf"):
            found[name] = Entry.of(one.shape, one.dtype, partial(array_in, file, name))
        elif kind in (None, *NUMERIC) and "MATLAB_empty" not in one.attrs:
            # MATLAB stores by columns, with its own order of axes
            read = partial(lambda name: array_in(file, name).T, name)
            found[name] = Entry.of(one.shape[::-1], one.dtype, read)

    file.visititems(keep)
    return found
