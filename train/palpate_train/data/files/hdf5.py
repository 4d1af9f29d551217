"""Reads HDF5, MATLAB's version 7.3 and what Octave's `save -hdf5` writes, which are HDF5. Only the
wanted arrays are read."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.files import octave
from palpate_train.data.files.table import Array, Entry, ReadPlan, Table, chosen, normal, unpacked
from palpate_train.data.readers import array_in

CLASS = "MATLAB_class"
OCTAVE = "OCTAVE_NEW_FORMAT"
OCTAVE_RANGE = "OCTAVE_RANGE_NELEM"
OCTAVE_REAL = re.compile(rb"(?!.*(complex|sparse|string)).*(matrix|scalar|bool|range)")
"""Types of Octave's arrays of real numbers; seen in Octave 7.3.0."""
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

    Arrays that MATLAB saved with -v7.3 get MATLAB's order of axes, and Octave's theirs; what
    MATLAB's `h5write` wrote carries no sign of MATLAB. Raises FormatError.
    """
    with h5py.File(path, "r") as file:
        table = chosen(entries(file), wanted)
        saved = file.visititems(lambda name, one: {CLASS, OCTAVE} & set(one.attrs) or None)
        facts = _facts(file, table.array, wanted.fields) if wanted.fields else {}
        return replace(table, reversible=not saved, facts=facts)


def _facts(file: h5py.File, name: str, asked: Sequence[str]) -> dict[str, str]:
    """The attributes and single values of the file, of the groups around the array `name` and of
    that array; the nearest counts. asked: paths of others."""
    found: dict[str, str] = {}
    at: Any = file
    for part in ("", *filter(None, name.split("/"))):
        if part and not _holds(at, part):
            break
        at = at[part] if part else at
        inside = [k for k in at if _holds(at, k)] if isinstance(at, h5py.Group) else []
        single = {k: array_in(at, k) for k in inside if _is_single(at[k])}
        said = {**single, **at.attrs}
        found |= {normal(k): _said(v) for k, v in said.items() if np.size(v) == 1}
    for path in asked:
        at, rest = file, path.split("/")
        while rest and _holds(at, rest[0]):
            at = at[rest.pop(0)]
        if not rest and _is_single(at):
            found[path] = _said(array_in(file, path))
    return found


def _holds(group: Any, name: str) -> bool:
    """Whether a group holds this member itself: a link may lead to another file."""
    link = group.get(name, getlink=True) if isinstance(group, h5py.Group) else None
    return isinstance(link, h5py.HardLink)


def _is_single(one: Any) -> bool:
    return isinstance(one, h5py.Dataset) and one.shape == ()


def _said(value: Any) -> str:
    """A single value as a text."""
    value = value.item() if isinstance(value, np.generic | np.ndarray) else value
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return f"{value:g}" if isinstance(value, float) else str(value)


def entries(file: h5py.File, matlab: bool = False) -> Mapping[str, Entry]:
    """The arrays of a file by their paths in it. Texts, cells and objects of MATLAB are left
    out. matlab: arrays without a class are MATLAB's too."""
    if any(OCTAVE in one.attrs for one in file.values() if isinstance(one, h5py.Group)):
        return _octave(file)
    found: dict[str, Entry] = {}

    def keep(name: str, one: Any) -> None:
        if not isinstance(one, h5py.Dataset) or one.shape is None or name.startswith(INTERNAL):
            return
        kind = one.attrs.get(CLASS)
        kind = kind.decode("ascii", "replace") if isinstance(kind, bytes) else kind
        kind = kind if isinstance(kind, str) else None
        if kind is None and not (matlab and one.dtype.kind in "biuf"):
            found[name] = Entry.of(one.shape, one.dtype, partial(_read, file, name))
        elif kind in (None, *NUMERIC) and "MATLAB_empty" not in one.attrs:
            # MATLAB stores by columns, with its own order of axes
            found[name] = Entry.of(one.shape[::-1], one.dtype, partial(_reversed, file, name))

    file.visititems(keep)
    return found


def _read(file: h5py.File, name: str) -> Array:
    return unpacked(array_in(file, name), file[name].attrs)


def _octave(file: h5py.File) -> Mapping[str, Entry]:
    """The arrays of a file of Octave: each variable is a group of its type and its value, whose
    axes are reversed; a range is its base, limit and increment."""
    found: dict[str, Entry] = {}

    def keep(name: str, one: Any) -> None:
        if not (isinstance(one, h5py.Group) and OCTAVE in one.attrs):
            return
        kind, value = one.get("type"), one.get("value")
        if not all(isinstance(part, h5py.Dataset) for part in (kind, value)):
            return  # a structure or a cell, whose parts are such groups
        at, short = f"{name}/value", "/".join(name.split("/")[::2])
        if OCTAVE_RANGE in value.attrs:
            count = _count(at, value)
            read = partial(_range, file, at, count)
            found[short] = Entry.of((count,), np.dtype(np.float64), read)
        elif OCTAVE_REAL.match(kind[()]) and "OCTAVE_EMPTY_MATRIX" not in one.attrs:
            read = partial(_reversed, file, at)
            found[short] = Entry.of(value.shape[::-1], value.dtype, read)

    file.visititems(keep)
    return found


def _count(name: str, value: h5py.Dataset) -> int:
    """How many numbers a range of Octave has. Raises FormatError."""
    stated = value.attrs[OCTAVE_RANGE]
    known = {"base", "increment"} <= set(value.dtype.names or ())
    if not known or not isinstance(stated, np.integer):
        raise FormatError(
            f"{name} is a range of {value.dtype} with {OCTAVE_RANGE} {stated!r}; save it again "
            "with Octave"
        )
    return int(stated)


def _reversed(file: h5py.File, name: str) -> Array:
    """A stored array in the order of axes of the program that wrote it by columns."""
    return array_in(file, name).T


def _range(file: h5py.File, name: str, count: int) -> Array:
    """The numbers of a range of Octave."""
    stored = array_in(file, name)
    return octave.ascending(float(stored["base"]), float(stored["increment"]), count)
