"""Reads Zarr, versions 2 and 3, as a folder or packed as .zip. A replay buffer with `episode_ends`
is one recording for each episode."""

from __future__ import annotations

import zipfile
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.extras import library
from palpate_train.data.files.table import Array, Entry, ReadPlan, Table, chosen, facts_of, unpacked

SUFFIXES = (".zarr",)
ROOTS = (".zgroup", ".zarray", "zarr.json")
"""Names of the files that describe a store or an array; a store has one of them in its folder."""
ENDS = "episode_ends"
"""The frames before each episode's end (real-stanford/diffusion_policy, replay_buffer.py)."""


def is_store(path: Path) -> bool:
    """Whether a folder or a zip archive is a Zarr store."""
    if path.suffix.lower() == ".zip" and path.is_file():
        try:
            with zipfile.ZipFile(path) as archive:
                return any(name in ROOTS for name in archive.namelist())
        except (OSError, zipfile.BadZipFile):
            return False
    return any((path / name).is_file() for name in ROOTS)


def read(path: Path, wanted: ReadPlan) -> Table:
    """The only array of frames, or `wanted.variable`. Raises FormatError that lists the arrays."""
    zarr = library("zarr", "a Zarr store")
    if not is_store(path):
        raise FormatError(f"holds none of {', '.join(ROOTS)}, as a Zarr store does; copy it again")
    if path.is_dir():
        return _read(zarr.open(str(path), mode="r"), wanted)
    with closing(zarr.storage.ZipStore(path, mode="r")) as store:
        return _read(zarr.open(store, mode="r"), wanted)


def _read(root: Any, wanted: ReadPlan) -> Table:
    inside = dict(root.members(max_depth=None)) if hasattr(root, "members") else {"array": root}
    arrays = {name: one for name, one in inside.items() if hasattr(one, "shape")}
    name = next((name for name in arrays if name.rpartition("/")[2] == ENDS), "")
    ends = np.asarray(arrays.pop(name)[...], np.int64).tolist() if name else []
    entries = {
        name: Entry.of(one.shape, np.dtype(one.dtype), partial(_all, one))
        for name, one in sorted(arrays.items())
    }
    table = chosen(entries, wanted, ends)
    count = len(table.values)
    if ends and (ends != sorted(ends) or ends[-1] != count):
        raise FormatError(
            f"{name} ends at {ends[-1]}, but there are {count} frames; name their array with"
            " --variable"
        )
    at = table.array
    groups = [root]
    groups += [
        one
        for path, one in sorted(inside.items())
        if path not in arrays and path != name and (not at or f"{at}/".startswith(f"{path}/"))
    ]
    said = {k: v for group in groups for k, v in dict(group.attrs).items()}
    return replace(table, facts=facts_of(said))


def _all(array: Any) -> Array:
    return unpacked(np.asarray(array[...]), dict(array.attrs))
