"""The room of files that hold sweep sets. In: an .npz, an HDF5 file, a folder of the box's recordings. Out: a SweepSet.

What the arrays are named stands in appliance/sim/sets.py, which checks them whatever they were read from. Nothing is
unpickled, and nothing outside the named file or folder is read.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from appliance.errors import FormatError
from appliance.sim.sets import Array, Set, build, load_file
from appliance.sweep import Status, Sweep, SweepFormat
from appliance.sweep import load as load_recording

HDF5 = (".h5", ".hdf5")
TACTMAT_HZ = 750.0
"""Rate of the TactMat data, which neither the file nor the page it is published on names: that of the same laboratory's
skin in the paper (sec. II.A). A `rate_hz` in the file goes before it."""


def read(path: Path, kind: type[Set]) -> Set:
    """The set at `path`, by what is there. Raises FormatError naming what is missing or of the wrong form, and where."""
    if not path.exists():
        raise FormatError(
            f"{path.name}: not a sweep set: there is no such file; name an .npz, an HDF5 file or a folder of recordings"
        )
    if path.is_dir():
        return recordings(path, kind)
    return hdf5(path, kind) if path.suffix in HDF5 or h5py.is_hdf5(path) else load_file(path, kind)


def hdf5(path: Path, kind: type[Set]) -> Set:
    """The set in an HDF5 file with the keys of an .npz, or in the TactMat layout. Raises FormatError."""
    try:
        with h5py.File(path, "r") as file:
            names = [k for k in file if k in ("samples", "labels", "materials", "rate_hz") or k.startswith("group_")]
            held = {name: _array(file, name) for name in names}
            if "rate_hz" in file.attrs:
                held.setdefault("rate_hz", np.asarray(file.attrs["rate_hz"]))
    except (OSError, KeyError, RuntimeError, ValueError, TypeError) as e:
        raise FormatError(f"{path.name}: not a sweep set (HDF5 with samples, materials …) that can be read: {e}") from e
    except FormatError as e:
        raise FormatError(f"{path.name}: {e}") from e
    source = path.name
    if "samples" in held and held["samples"].ndim == 5 and "labels" not in held:
        if "rate_hz" not in held:
            held["rate_hz"], source = np.array(TACTMAT_HZ), f"{path.name} (names no rate, taken for {TACTMAT_HZ:g} Hz)"
        held = _tactmat(held, source)
    return build(held, source, kind)


def _array(file: h5py.File, name: str) -> Array:
    """One array as it stands in the file itself: what a link or a virtual array shows may not be there, or be zeros."""
    link = file.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        raise FormatError(f"{name} is a link to {getattr(link, 'path', None)!r}; put the data itself into the file")
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.shape is None:
        raise FormatError(f"{name} is no array but {data!r}; give one")
    if data.is_virtual or data.external:
        raise FormatError(f"{name} lies in other files; put the data itself into the file")
    if not _written(data):
        raise FormatError(f"{name} {list(data.shape)} was not written to its end; record or copy it again")
    if h5py.check_string_dtype(data.dtype):
        return np.array(data.asstr("utf-8")[()], dtype=str)
    return np.asarray(data[()])


def _written(data: h5py.Dataset) -> bool:
    """Whether each of its chunks is there: HDF5 reads zeros where none is, as a recording that broke off leaves them."""
    if not data.chunks:
        return not data.size or data.id.get_storage_size() > 0
    wanted = math.prod(-(-n // size) for n, size in zip(data.shape, data.chunks, strict=True))
    return data.id.get_num_chunks() == wanted


def _tactmat(held: dict[str, Array], source: str) -> dict[str, Array]:
    """TactMat (Tulbure and Baeuml, Humanoids 2018): samples [materials, repetitions, T, R, C], names -> a set's arrays.

    Its digits are 0 to 255 (paper, sec. II.B) whatever type they are kept in. Raises FormatError.
    """
    x, materials = held["samples"], held.get("materials", np.empty(0, str))
    if len(materials) != len(x):
        raise FormatError(f"{source}: samples {list(x.shape)} are of {len(x)} materials, {len(materials)} are named")
    if x.dtype.kind in "iuf":
        with np.errstate(invalid="ignore"):
            digits = x.astype(np.uint8)
        x = digits if np.array_equal(digits, x) else x
    label, repetition = np.indices(x.shape[:2]).reshape(2, -1)
    return held | {"samples": x.reshape(-1, *x.shape[2:]), "labels": label, "group_repetition": repetition}


def write_hdf5(path: Path, arrays: dict[str, Any]) -> None:
    """The arrays, named as in an .npz, as an HDF5 file that `hdf5` reads; samples are compressed."""
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, compression="gzip" if name == "samples" else None)


def recordings(folder: Path, kind: type[Set]) -> Set:
    """The set of all sweeps that the box kept in `folder` (.npy with .json) and below; each is a recording.

    Its label is its material; groups are position and session, numbered in the order of their names, and the object
    where NEW OBJECT was ever signalled. Sweeps whose status is not ok are left out and counted in `source`.
    Raises FormatError naming the file that is broken, lacks a name or is of another format.
    """
    held = [(path, *load_recording(path)) for path in sorted(folder.rglob("*.npy"))]
    kept = [(path, sweep) for path, sweep, _ in held if sweep.status is Status.OK]
    left = Counter(str(sweep.status) for _, sweep, _ in held if sweep.status is not Status.OK)
    source = f"{folder}" + (
        f" (left out: {', '.join(f'{n} {name}' for name, n in sorted(left.items()))})" if left else ""
    )
    if not kept:
        raise FormatError(f"{source}: not a sweep set: no recorded sweep is ok; record some with `palpate run --keep`")
    fmt = next(fmt for _, sweep, fmt in held if sweep.status is Status.OK)
    for path, sweep, its in held:
        if sweep.status is Status.OK:
            _check(path, sweep, its, fmt)
    groups = {"group_recording": np.arange(len(kept))}
    for name in ("position", "session"):
        texts = [getattr(sweep, name) for _, sweep in kept]
        if any(texts):
            if "" in texts:
                raise FormatError(f"{kept[texts.index('')][0]}: has no {name} though others have; name it in its .json")
            groups[f"group_{name}"] = _numbered(texts)
    if any(sweep.object for _, sweep in kept):  # counted anew in each run, and each run has its folder
        groups["group_object"] = _numbered([(str(path.parent), sweep.object) for path, sweep in kept])
    materials = [sweep.material for _, sweep in kept]
    samples = np.stack([sweep.frames.taxels for _, sweep in kept])
    about = {"labels": _numbered(materials), "materials": np.unique(materials), "rate_hz": np.array(fmt.rate_hz)}
    return build({"samples": samples} | about | groups, source, kind)


def _check(path: Path, sweep: Sweep, fmt: SweepFormat, wanted: SweepFormat) -> None:
    if fmt != wanted or len(sweep.frames) != fmt.window:
        raise FormatError(f"{path}: {len(sweep.frames)} frames of {fmt}; others have {wanted}: give each its folder")
    if not sweep.material:
        raise FormatError(f'{path}: has no material; write it into {path.with_suffix(".json").name}, "material": "…"')


def _numbered(values: Sequence[Any]) -> Array:
    """Each value as its place among the different ones, in their order."""
    place = {value: i for i, value in enumerate(sorted(set(values)))}
    return np.array([place[value] for value in values])
