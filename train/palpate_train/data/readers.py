"""Reads sweep sets from an .npz, an HDF5 file or a folder of the box's recordings.

palpate.core.sweep_set lists the arrays and checks them, whatever file they come from. Nothing is
unpickled, and nothing outside the named file or folder is read.
"""

from __future__ import annotations

import io
import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from palpate.answer.unloaded import UnloadedSkin
from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array, Set, build, load_file
from palpate.core.types import LARGEST_READING, SweepFormat
from palpate.sweeps.sweep_folder import RecordedSweep
from palpate_train.data import mapped
from palpate_train.data.files import zarr_store
from palpate_train.data.group_values import typed

if TYPE_CHECKING:
    import h5py

HDF5 = (".h5", ".hdf5")
TACTMAT_HZ = 750.0
"""Frame rate of the TactMat data. Neither the file nor its page states it, so we use the rate of
the same laboratory's skin in the paper (sec. II.A). A `rate_hz` in the file takes precedence."""
SET_ARRAYS = ("samples", "labels", "materials", "displays", "rate_hz", "unloaded")
NAMED_GROUPS = ("position", "session")
"""Names that a recording can have next to its material. Each becomes a group."""
SLIDE_GROUPS = {"speed": "speed_mm_s", "force": "force_n"}
"""Groups of the speed and the force of the slide, in thousandths: um/s and mN."""
SLIDE_UNITS = {"speed": "um/s", "force": "mN"}
FRAMES = (
    ".csv", ".tsv", ".txt", ".dat", ".mat", ".npy", ".asf", ".lvm", ".tdms", ".jsonl", ".xlsx",
    ".parquet", ".bag", ".mcap", ".db3",
)  # fmt: skip
"""Suffixes of files that hold the frames of one recording. importing.py makes a set of a folder of
such files."""
JUNK = ("__MACOSX", "Thumbs.db", "desktop.ini", "Icon\r", "metadata.yaml")
"""Names of files and folders that systems and recorders leave next to recordings. Names that begin
with . or ~$ are passed over too."""
IMPORT = "palpate-train import {} makes a set of such files"


def read(path: Path, kind: type[Set]) -> Set:
    """The set at `path`, in any format. Raises FormatError that says which array is missing or has
    a wrong shape, and in which file."""
    if not path.exists():
        raise FormatError(
            f"{path.name}: not a sweep set: there is no such file; "
            "name an .npz, an HDF5 file or a folder of recordings"
        )
    if path.is_dir():
        return from_recorded(read_recorded(path), path, kind)
    try:
        path.open("rb").close()
    except OSError as e:
        raise FormatError(
            f"{path.name}: not a sweep set: the file cannot be read: {e.strerror}; "
            "make it readable for you"
        ) from e
    import h5py  # here, and below: the box, which reads folders alone, does not have it

    if path.suffix in HDF5 or h5py.is_hdf5(path):
        return read_hdf5(path, kind)
    if path.suffix.lower() in FRAMES:
        raise FormatError(
            f"{path.name}: not a sweep set, but a file of frames; {IMPORT.format(path.parent)}"
        )
    return load_file(path, kind, mapped.of_npz(path))


def read_hdf5(path: Path, kind: type[Set]) -> Set:
    """The set in an HDF5 file with the keys of an .npz, or in the TactMat layout. Raises
    FormatError."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            names = [k for k in file if k in SET_ARRAYS or k.startswith(("group_", "unit_"))]
            arrays = {name: array_in(file, name, path) for name in names}
            if "rate_hz" in file.attrs:
                arrays.setdefault("rate_hz", np.asarray(file.attrs["rate_hz"]))
    except (OSError, KeyError, RuntimeError, ValueError, TypeError) as e:
        raise FormatError(
            f"{path.name}: not a sweep set (HDF5 with samples, materials …) that can be read: {e}; "
            "copy or write it again"
        ) from e
    except FormatError as e:
        raise FormatError(f"{path.name}: {e}") from e
    source = path.name
    if "samples" in arrays and arrays["samples"].ndim == 5 and "labels" not in arrays:
        if "rate_hz" not in arrays:
            arrays["rate_hz"] = np.array(TACTMAT_HZ)
            source = f"{path.name} (states no rate; {TACTMAT_HZ:g} Hz assumed)"
        arrays = _tactmat(arrays, source)
    return build(arrays, source, kind)


def array_in(file: h5py.File, name: str, path: Path | None = None) -> Array:
    """An array that is stored in this file; large samples of a set at `path` are mapped.

    Links and virtual arrays are refused, because their data may be missing or read as zeros. Raises
    FormatError.
    """
    import h5py

    link = file.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        raise FormatError(
            f"{name} is a link to {getattr(link, 'path', None)!r}; "
            "put the data itself into the file"
        )
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.shape is None:
        raise FormatError(f"{name} is not an array but {data!r}; store an array")
    if data.is_virtual or data.external:
        raise FormatError(f"{name} lies in other files; put the data itself into the file")
    if not _complete(data):
        raise FormatError(
            f"{name} {list(data.shape)} was not written to its end; record or copy it again"
        )
    if h5py.check_string_dtype(data.dtype):
        return np.array(data.asstr("utf-8")[()], dtype=str)
    known = mapped.of_hdf5(path, data) if path and name == "samples" else {}
    return known["samples"] if known else np.asarray(data[()])


def _complete(data: h5py.Dataset) -> bool:
    """Whether all chunks of an array are present. An interrupted recording leaves some out, and
    HDF5 reads zeros for them."""
    if not data.chunks:
        return not data.size or bool(data.id.get_storage_size() > 0)
    chunks = math.prod(-(-n // size) for n, size in zip(data.shape, data.chunks, strict=True))
    return bool(data.id.get_num_chunks() == chunks)


def _tactmat(arrays: dict[str, Array], source: str) -> dict[str, Array]:
    """The arrays of a set, from TactMat's samples [materials, repetitions, T, R, C] and names
    (Tulbure and Baeuml, Humanoids 2018).

    Raw counts are 0 to 255 (paper, sec. II.B), whatever type they are stored in. Raises
    FormatError.
    """
    x, materials = arrays["samples"], arrays.get("materials", np.empty(0, str))
    if len(materials) != len(x):
        raise FormatError(
            f"{source}: samples {list(x.shape)} hold {len(x)} materials, "
            f"but there are {len(materials)} names; "
            "give as many"
        )
    if x.dtype.kind in "iuf":
        with np.errstate(invalid="ignore"):
            counts = x.astype(np.uint8)
        x = counts if np.array_equal(counts, x) else x
    label, repetition = np.indices(x.shape[:2]).reshape(2, -1)
    return arrays | {
        "samples": x.reshape(-1, *x.shape[2:]),
        "labels": label,
        "group_repetition": repetition,
    }


def write_hdf5(target: BinaryIO, arrays: dict[str, Any]) -> None:
    """Write the arrays of an .npz under the same names as an HDF5 file that `read_hdf5` reads.
    Samples are compressed unless they are so large that they are mapped. target: opened for reading
    and writing. Raises OSError."""
    import h5py

    kept = _UntilAnError(target)
    with h5py.File(kept, "w") as file:
        for name, values in arrays.items():
            if np.asarray(values).dtype.kind == "U":
                values = np.asarray(values).astype(h5py.string_dtype())
            small = name == "samples" and values.nbytes < mapped.LEAST
            file.create_dataset(name, data=values, compression="gzip" if small else None)
    if kept.error:
        raise kept.error


class _UntilAnError:
    """A file for h5py, which dies with SIGSEGV if its file raises an error while it closes.

    error: the first OSError, such as a full disk; what follows it goes to memory, so that h5py can
    close, and is lost.
    """

    def __init__(self, target: BinaryIO) -> None:
        self._file = target
        self.error: OSError | None = None

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            try:
                return getattr(self._file, name)(*args)
            except OSError as e:
                self.error, self._file = self.error or e, io.BytesIO()
                return getattr(self._file, name)(*args)

        return call


def read_recorded(folder: Path) -> list[RecordedSweep]:
    """All sweeps that the box recorded in and below `folder` (.npy with .json), in the order of
    their names.

    Raises FormatError with the name of a broken file, or with the folder if it cannot be read or
    holds no recorded sweep.
    """
    check_folder(folder)
    paths = [path for path in files_below(folder) if path.suffix == ".npy"]
    if not any(path.with_suffix(".json").exists() for path in paths):
        raise FormatError(
            f"{folder}: not a sweep set: no sweep of `palpate record` is in it; {_advice(folder)}"
        )
    return [RecordedSweep.load(path) for path in paths]


def check_folder(folder: Path) -> None:
    """Raise FormatError if the folder cannot be listed: a search in it would silently find
    nothing."""
    try:
        next(folder.iterdir(), None)
    except OSError as e:
        raise FormatError(
            f"{folder}: not a sweep set: the folder cannot be read: {e.strerror}; "
            "make it readable for you"
        ) from e


def files_below(folder: Path) -> list[Path]:
    """All files in and below a folder, in the order of their names, without JUNK. A Zarr
    store counts as a file."""
    found = []
    for at, folders, names in os.walk(folder):
        stores = [name for name in folders if zarr_store.is_store(Path(at) / name)]
        kept = [n for n in (*names, *folders) if n not in JUNK and not n.startswith((".", "~$"))]
        folders[:] = [name for name in folders if name in kept and name not in stores]
        paths = [Path(at) / name for name in kept if name not in folders]
        found += [path for path in paths if path.is_file() or path.name in stores]
    return sorted(found)


def _advice(folder: Path) -> str:
    """The advice for a folder that holds no recordings of the box."""
    others = Counter(
        path.suffix.lower()
        for path in files_below(folder)
        if path.suffix.lower() in (*FRAMES, *HDF5, ".npz")
    )
    if sets := others[".npz"] + sum(others[suffix] for suffix in HDF5):
        return f"it holds {sets} .npz or HDF5 files: name one of them, or {IMPORT.format(folder)}"
    if others:
        return f"it holds {others.total()} {' and '.join(others)} files: {IMPORT.format(folder)}"
    return "record some, or name another folder"


def named(recorded: Sequence[RecordedSweep], missing: str, *more: str) -> list[RecordedSweep]:
    """The sweeps, with the name `missing` where one lacks a name of NAMED_GROUPS that another has,
    or one of `more`."""
    kept = usable(recorded)
    names = [*more, *(by for by in NAMED_GROUPS if any(getattr(one.sweep, by) for one in kept))]

    def completed(one: RecordedSweep) -> RecordedSweep:
        lacks: dict[str, Any] = {by: missing for by in names if not getattr(one.sweep, by)}
        return replace(one, sweep=replace(one.sweep, **lacks))

    return [completed(one) for one in recorded]


def usable(recorded: Sequence[RecordedSweep]) -> list[RecordedSweep]:
    """The sweeps that we train on."""
    return [one for one in recorded if not one.exclusion]


def from_recorded(recorded: Sequence[RecordedSweep], folder: Path, kind: type[Set]) -> Set:
    """The set of the sweeps that the box recorded in and below `folder`; each is a recording.

    Labels are materials. Groups are position and session, numbers if all their names are numbers
    (see group_values.typed). A third group is the object, if NEW OBJECT was ever signalled. Groups
    speed (um/s) and force (mN) exist if every sweep has the value; `source` says if only some have
    it. Sweeps that we do not train on are counted in `source`. Raises FormatError with the name of
    a file that lacks a name or has another format.
    """
    kept = usable(recorded)
    left = Counter(one.exclusion for one in recorded if one.exclusion)
    source = f"{folder} (left out: {counted(left)})" if left else str(folder)
    if not kept:
        raise FormatError(
            f"{source}: not a sweep set: no recorded sweep is ok; record some with `palpate record`"
        )
    for one in kept:
        _check(one, kept[0].format)
    slide, partial = _slide_groups(kept)
    groups = _groups(kept) | slide
    materials = [one.sweep.material for one in kept]
    samples, unloaded, remark = align_tare(
        np.stack([one.sweep.frames.taxels for one in kept]),
        np.stack([one.unloaded for one in kept]),
    )
    source += partial + remark
    rate = np.array(kept[0].format.rate_hz)
    about = {"labels": _ranks(materials), "materials": np.unique(materials), "rate_hz": rate}
    displays = {one.sweep.material: one.about.get("display") for one in reversed(kept)}
    if any(displays.values()):
        about["displays"] = np.array([str(displays[name] or "") for name in sorted(displays)])
    if np.isfinite(unloaded).any():
        about["unloaded"] = unloaded
    return build({"samples": samples} | about | groups, source, kind)


def _groups(kept: Sequence[RecordedSweep]) -> dict[str, Array]:
    """The groups recording, position, session and object. Raises FormatError for a
    recording without the name that others have."""
    groups = {"group_recording": np.arange(len(kept))}
    for name in NAMED_GROUPS:
        texts = [getattr(one.sweep, name) for one in kept]
        if any(texts):
            if "" in texts:
                raise FormatError(
                    f"{kept[texts.index('')].path}: has no {name} though others have; "
                    "name it in its .json"
                )
            groups[f"group_{name}"] = typed(texts)
    if any(one.sweep.object for one in kept):  # each run of the service counts objects from 1 again
        groups["group_object"] = _ranks(
            [
                (str(one.path.parent), str(one.about.get("run", "")), one.sweep.object)
                for one in kept
            ]
        )
    return groups


def _slide_groups(kept: Sequence[RecordedSweep]) -> tuple[dict[str, Array], str]:
    """The groups of SLIDE_GROUPS that every sweep has, and words for the set's source about
    groups that only some have."""
    groups, remark = {}, ""
    for name, member in SLIDE_GROUPS.items():
        values = [getattr(one.sweep, member) for one in kept]
        known = [value for value in values if value is not None]
        if len(known) == len(kept):
            groups[f"group_{name}"] = np.rint(1000 * np.array(known)).astype(np.int64)
            groups[f"unit_{name}"] = np.array(SLIDE_UNITS[name])
        elif known:
            remark += f" ({len(known)} of {len(kept)} have {member}: no group {name})"
    return groups, remark


def align_tare(samples: Array, unloaded: Array) -> tuple[Array, Array, str]:
    """Bring raw counts [n, T, R, C] or [n, T, R, C, A] of skins that were tared at different times
    to a common level.

    The common level is that of the sweep whose unloaded skin is closest to the median. A sweep is
    shifted to it if the difference would count as a load. Smaller differences stay: a skin drifts
    as much in service. Sweeps with an unknown level stay as they are. Whole counts stay whole and
    within the range of their type.

    unloaded: as RecordedSweep.unloaded, for each sweep, [n, 2, R, C] or [n, 2, R, C, A]. Returns
    the shifted samples and levels, and words for the set's source that say how many sweeps were
    shifted, "" if none.
    """
    known = np.isfinite(unloaded).all(axis=tuple(range(1, unloaded.ndim)))
    if not known.any():
        return samples, unloaded, ""
    levels = unloaded[known, 0]
    away = np.abs(levels - np.median(levels, axis=0)).sum(axis=tuple(range(1, levels.ndim)))
    # a level that occurred: the median of two equal halves would be the level of no skin
    usual = levels[away.argmin()]
    samples, unloaded, shifted = samples.copy(), unloaded.copy(), 0
    for i in np.flatnonzero(known):
        level, noise = unloaded[i]
        change = usual - level
        if np.abs(change).max() < UnloadedSkin.of(level, noise, samples.dtype).contact:
            continue
        if samples.dtype.kind == "f":
            samples[i] += change.astype(samples.dtype)
        else:
            change, limits = np.rint(change), np.iinfo(samples.dtype)
            samples[i] = np.clip(samples[i] + change, limits.min, limits.max).astype(samples.dtype)
        unloaded[i, 0] += change
        shifted += 1
    remark = (
        f" ({shifted} of {len(samples)} brought to the unloaded skin of the others: "
        "it was tared between)"
    )
    return samples, unloaded, remark if shifted else ""


def counted(reasons: Counter[str]) -> str:
    """The number of sweeps for each reason, as text."""
    return ", ".join(f"{n} {reason}" for reason, n in sorted(reasons.items()))


def _check(one: RecordedSweep, wanted: SweepFormat) -> None:
    """Raise FormatError if the format differs from `wanted`, or if the recording has no
    material."""
    path, n = one.path, len(one.sweep.frames)
    if one.format != wanted or n != wanted.window:
        raise FormatError(
            f"{path}: {n} frames of {one.format}; others have {wanted}: "
            "keep each format in a folder of its own"
        )
    taxels = one.sweep.frames.taxels
    if taxels.dtype.kind == "f" and (bad := ~(np.abs(taxels) <= LARGEST_READING)).any():
        frame, *taxel = (int(i) + 1 for i in np.argwhere(bad)[0])
        raise FormatError(
            f"{path}: frame {frame}, taxel {', '.join(map(str, taxel))} reads "
            f"{taxels[bad][0]:g}, and no skin reads more than {LARGEST_READING:g}; "
            "move the sweep and its .json away"
        )
    if not one.sweep.material:
        raise FormatError(
            f"{path}: has no material; write it into {path.with_suffix('.json').name}, "
            '"material": "…"'
        )


def _ranks(values: Sequence[Any]) -> Array:
    """The rank of each value among the different values."""
    rank = {value: i for i, value in enumerate(sorted(set(values)))}
    return np.array([rank[value] for value in values])
