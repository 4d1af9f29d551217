"""The room of files that hold sweep sets. In: an .npz, an HDF5 file, a folder of the box's recordings. Out: a SweepSet.

What the arrays are named stands in appliance/sim/sets.py, which checks them whatever they were read from. Nothing is
unpickled, and nothing outside the named file or folder is read.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from appliance.core.errors import FormatError
from appliance.core.sweep_set import Array, Set, build, load_file
from appliance.core.types import Status, Sweep, SweepFormat, sidecar
from appliance.core.types import load as load_recording

HDF5 = (".h5", ".hdf5")
TACTMAT_HZ = 750.0
"""Rate of the TactMat data, which neither the file nor the page it is published on names: that of the same laboratory's
skin in the paper (sec. II.A). A `rate_hz` in the file goes before it."""
NAMED = ("position", "session")
"""What a recording may have a name for, beside its material."""
REFUSED = (Status.NO_CONTACT, Status.SATURATED, Status.STUCK_TAXEL, Status.DEAD_TAXEL)
"""What the box says of a window that it does not judge."""
NUMBER = re.compile(r"0|[1-9][0-9]{0,8}")
"""A name that is a whole number; 07 is none, or it would be the same as 7."""


@dataclass(frozen=True, slots=True)
class RecordedSweep:
    """One sweep as the box recorded it, where, and what else its sidecar says."""

    path: Path
    sweep: Sweep
    format: SweepFormat
    about: Mapping[str, Any]

    @classmethod
    def load(cls, path: Path) -> RecordedSweep:
        """Read an .npy with its sidecar. Raises FormatError where it is broken."""
        return cls(path, *load_recording(path), sidecar(path))

    @property
    def why_not(self) -> str:
        """Why it is not trained on, in a word; "" where it is: not a whole window, or a skin that the box refused.

        A material that the box did not know, or was not sure of, is what it was recorded for.
        """
        verdict = self.about.get("verdict")
        said = verdict.get("status") if isinstance(verdict, dict) else ""
        if self.sweep.status is not Status.OK:
            return str(self.sweep.status)
        return str(said) if said in REFUSED else "early" if self.sweep.share < 1 else ""


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


def recorded(folder: Path) -> list[RecordedSweep]:
    """All sweeps that the box recorded in `folder` (.npy with .json) and below, in the order of their names.

    Raises FormatError naming the file that is broken.
    """
    return [RecordedSweep.load(path) for path in sorted(folder.rglob("*.npy"))]


def ok(held: Sequence[RecordedSweep]) -> list[RecordedSweep]:
    """Those that are trained on."""
    return [one for one in held if not one.why_not]


def recordings(folder: Path, kind: type[Set]) -> Set:
    """The set of all sweeps that the box recorded in `folder` and below; each is a recording.

    Its label is its material; groups are position and session, by their numbers where each has one for its name, else
    numbered in the order of their names; and the object where NEW OBJECT was ever signalled. Sweeps that are not
    trained on are counted in `source`. Raises FormatError naming the file that is broken, lacks a name or is of
    another format.
    """
    return joined(recorded(folder), folder, kind)


def joined(held: Sequence[RecordedSweep], folder: Path, kind: type[Set]) -> Set:
    """What `recordings` gives, of sweeps that were read already."""
    kept = ok(held)
    left = Counter(one.why_not for one in held if one.why_not)
    source = f"{folder} (left out: {counted(left)})" if left else str(folder)
    if not kept:
        raise FormatError(f"{source}: not a sweep set: no recorded sweep is ok; record some with `palpate record`")
    for one in kept:
        _check(one, kept[0].format)
    groups = {"group_recording": np.arange(len(kept))}
    for name in NAMED:
        texts = [getattr(one.sweep, name) for one in kept]
        if any(texts):
            if "" in texts:
                raise FormatError(
                    f"{kept[texts.index('')].path}: has no {name} though others have; name it in its .json"
                )
            groups[f"group_{name}"] = numbered(texts)
    if any(one.sweep.object for one in kept):  # counted anew in each run
        groups["group_object"] = _places(
            [(str(one.path.parent), str(one.about.get("run", "")), one.sweep.object) for one in kept]
        )
    materials = [one.sweep.material for one in kept]
    samples = np.stack([one.sweep.frames.taxels for one in kept])
    rate = np.array(kept[0].format.rate_hz)
    about = {"labels": _places(materials), "materials": np.unique(materials), "rate_hz": rate}
    return build({"samples": samples} | about | groups, source, kind)


def counted(those: Counter[str]) -> str:
    """How many of what, in a line."""
    return ", ".join(f"{n} {what}" for what, n in sorted(those.items()))


def _check(one: RecordedSweep, wanted: SweepFormat) -> None:
    """Raises FormatError where it is not what the first one is, or nobody said what was touched."""
    path, n = one.path, len(one.sweep.frames)
    if one.format != wanted or n != wanted.window:
        raise FormatError(f"{path}: {n} frames of {one.format}; others have {wanted}: give each its folder")
    if not one.sweep.material:
        raise FormatError(f'{path}: has no material; write it into {path.with_suffix(".json").name}, "material": "…"')


def numbered(names: Sequence[str]) -> Array:
    """A number for each name: the one that it is, where all are whole numbers, else its place among the different ones."""
    return np.array([int(name) for name in names]) if all(map(NUMBER.fullmatch, names)) else _places(names)


def _places(values: Sequence[Any]) -> Array:
    """Each value as its place among the different ones, in their order."""
    place = {value: i for i, value in enumerate(sorted(set(values)))}
    return np.array([place[value] for value in values])
