"""Sweep sets, which the simulator plays and `train` learns from: a user's .npz as a checked
SweepSet. All shapes and types are checked here, so that no other module has to."""

from __future__ import annotations

import unicodedata
import zipfile
import zlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.names import MOST_SHOWN, can_be_shown
from palpate.core.types import DATA_TYPES, LARGEST_READING, SweepFormat, native

Array = NDArray[Any]
Set = TypeVar("Set", bound="SweepSet")


@dataclass(frozen=True, eq=False)
class SweepSet:
    """N sweeps with their labels and groups.

    samples: raw counts [N, T, R, C] or [N, T, R, C, A] of one of DATA_TYPES. labels: int [N],
    indices into `materials`. rate_hz: frames per second. groups: numbers or names [N] each; sweeps
    with the same whole number in `recording` are parts of one recording. source: the name used in
    messages. unloaded: float [N, 2, R, C] or [N, 2, R, C, A], mean and standard deviation of the
    skin without contact when each sweep was recorded, NaN for a sweep where it is unknown; None if
    it is unknown for all. units: of the groups of numbers that have one. displays: names of
    materials for people, in any language, by the names that the box sends. Raises FormatError
    naming `source` and the fault.
    """

    samples: Array
    labels: Array
    materials: tuple[str, ...]
    rate_hz: float
    groups: dict[str, Array] = field(default_factory=dict)
    source: str = "sweep set"
    unloaded: Array | None = None
    units: dict[str, str] = field(default_factory=dict)
    displays: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # torch and onnxruntime take only this machine's byte order, or read other numbers
        for name in ("samples", "labels", "unloaded"):
            if (values := getattr(self, name)) is not None:
                object.__setattr__(self, name, native(values))
        groups = {name: native(values) for name, values in self.groups.items()}
        object.__setattr__(self, "groups", groups)
        self._check_samples()
        self._check_numbers()
        self._check_materials()
        if not 0 < self.rate_hz < np.inf:
            raise self._error(f"rate_hz is {self.rate_hz}; give frames per second")
        try:
            _ = self.format
        except FormatError as e:
            raise self._error(str(e)) from e

    def _check_samples(self) -> None:
        x = self.samples
        if x.ndim not in (4, 5) or 0 in x.shape or x.shape[4:] == (1,):
            form = "[sweeps, frames, rows, columns] and perhaps several axes, none empty"
            raise self._error(f"samples have the shape {list(x.shape)}; give {form}")
        if x.dtype.name not in DATA_TYPES:
            types = f"{', '.join(DATA_TYPES)}{_conversion(x)}"
            raise self._error(f"samples are {x.dtype}; use one of {types}")
        if x.dtype.kind != "f":
            return
        least, most = x.min(), x.max()  # without an array of the size of a mapped set
        if not (np.isfinite(least) and np.isfinite(most)):
            at = tuple(int(i) for i in np.argwhere(~np.isfinite(x))[0])
            raise self._error(f"samples{list(at)} is {x[at]}; drop sweep {at[0]} or fill it in")
        if max(most, -least) > LARGEST_READING:
            sweep, frame, *taxel = (int(i) for i in np.argwhere(np.abs(x) > LARGEST_READING)[0])
            place = f"sweep {sweep}, frame {frame}, taxel {', '.join(map(str, taxel))}"
            reads = f"{place} reads {x[(sweep, frame, *taxel)]:g} (counted from 0)"
            raise self._error(
                f"{reads}, and no skin more than {LARGEST_READING:g}; drop sweep {sweep} or fill "
                "it in"
            )

    def _check_numbers(self) -> None:
        """Check the arrays with an entry for each sweep."""
        x = self.samples
        self._check_values("labels", self.labels, "iu", "whole number")
        for name, values in self.groups.items():
            whole = name == "recording"
            kinds, what = ("iu", "whole number") if whole else ("iufU", "number or name")
            self._check_values(f"group_{name}", values, kinds, what)
        level, wanted = self.unloaded, (len(x), 2, *x.shape[2:])
        if level is not None and (level.shape != wanted or level.dtype.kind != "f"):
            given = f"unloaded holds {level.dtype} {list(level.shape)}; give floats {list(wanted)}"
            raise self._error(f"{given}, mean and deviation of the unloaded skin, or leave it out")

    def _check_values(self, name: str, values: Array, kinds: str, wanted: str) -> None:
        """Check an array with a value for each sweep."""
        n = len(self.samples)
        if values.shape != (n,) or values.dtype.kind not in kinds:
            what = f"{values.dtype} {list(values.shape)}"
            raise self._error(f"{name} holds {what}; give one {wanted} for each of {n} sweeps")
        bad = ~np.isfinite(values) if values.dtype.kind == "f" else values == ""
        if np.any(bad):
            i = int(np.flatnonzero(bad)[0])
            given = f"{name} of sweep {i} is {values[i].item()!r}"
            raise self._error(f"{given}; give a value, or leave the group out")

    def _check_materials(self) -> None:
        n = len(self.materials)
        outside = np.flatnonzero((self.labels < 0) | (self.labels >= n))
        if len(outside):
            given = f"label {self.labels[outside[0]]} of sweep {outside[0]} is out of range"
            raise self._error(f"{given}; there are {n} materials, from 0 on")
        if len(set(self.materials)) < n:
            raise self._error(f"materials {list(self.materials)} name one twice; rename one")

    def _error(self, why: str) -> FormatError:
        return FormatError(f"{self.source}: {why}")

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def format(self) -> SweepFormat:
        """The format of each sweep."""
        _, window, rows, cols, *axes = self.samples.shape
        return SweepFormat(rows, cols, self.rate_hz, window, self.samples.dtype.name, *axes)

    def group(self, name: str) -> Array:
        """Values [N] of the group `name`; without `recording` each sweep is its own."""
        if name in self.groups:
            return self.groups[name]
        if name == "recording":
            return np.arange(len(self))
        raise self._error(f"no group {name!r}; it has {', '.join(sorted(self.groups)) or 'none'}")


def read(path: Path, what: str, known: Collection[str] = ()) -> dict[str, Array]:
    """All arrays of an .npz by name, but those in `known`; pickled objects are refused. Raises
    FormatError saying that it is not `what`."""
    try:
        with np.load(path, allow_pickle=False) as z:
            return {k: _typed(z, k) for k in z.files if k not in known}
    except OSError as e:
        why = f": {str(e.strerror).lower()}" if e.strerror else ""
        raise FormatError(f"{path.name}: not {what}{why}; copy or write it again") from e
    except (ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as e:
        # numpy takes any other file for a pickle, and explains how to load one
        why = "" if "pickle" in str(e) else f": {e}"
        raise FormatError(f"{path.name}: not {what}{why}; copy or write it again") from e


def _typed(z: Any, name: str) -> Array:
    """One array of an open .npz. Raises ValueError with the remedy for Python objects."""
    try:
        return np.asarray(z[name])
    except ValueError as e:
        if "allow_pickle" not in str(e):
            raise
        raise ValueError(
            f"{name} holds objects, which are not read; save np.array({name}, dtype=str), or "
            "numbers"
        ) from e


def load_file(
    path: Path, kind: type[Set], known: Mapping[str, Array] = MappingProxyType({})
) -> Set:
    """The set in the .npz `path`. known: arrays of the file that need not be read. Raises
    FormatError naming the file and the missing or invalid array."""
    what = "a sweep set (an .npz of samples, labels, materials, rate_hz)"
    return build({**read(path, what, known), **known}, path.name, kind)


def build(arrays: dict[str, Array], source: str, kind: type[Set]) -> Set:
    """A set of `arrays`, named as in a file. Raises FormatError naming `source` and the fault."""
    arrays = _numbered(arrays, source)
    missing = {"samples", "labels", "materials", "rate_hz"} - set(arrays)
    if missing:
        raise FormatError(
            f"{source}: lacks {', '.join(sorted(missing))}; a sweep set holds samples, labels, "
            "materials, rate_hz"
        )
    if arrays["materials"].ndim != 1 or arrays["materials"].dtype.kind != "U":
        raise FormatError(
            f"{source}: materials hold {arrays['materials'].dtype}; give a list of names, dtype=str"
        )
    if arrays["rate_hz"].size != 1 or arrays["rate_hz"].dtype.kind not in "iuf":
        raise FormatError(
            f"{source}: rate_hz holds {arrays['rate_hz']!r}; give one number, frames per second"
        )
    groups, units = (
        {k.removeprefix(part): v for k, v in arrays.items() if k.startswith(part)}
        for part in ("group_", "unit_")
    )
    materials = tuple(unicodedata.normalize("NFC", str(m)) for m in arrays["materials"])
    return kind(
        arrays["samples"],
        arrays["labels"],
        materials,
        arrays["rate_hz"].item(),
        {name: _group(name, values) for name, values in groups.items()},
        source,
        arrays.get("unloaded"),
        {name: str(unit) for name, unit in units.items() if name in groups},
        _displays(materials, arrays.get("displays"), source),
    )


def _displays(materials: tuple[str, ...], given: Array | None, source: str) -> dict[str, str]:
    """Display names by material; an empty text, or the name itself, is none."""
    if given is None:
        return {}
    if given.dtype.kind != "U" or given.shape != (len(materials),):
        raise FormatError(
            f"{source}: displays hold {given.dtype} {list(given.shape)}; give one text for each of "
            f"{len(materials)} materials, or leave them out"
        )
    pairs = zip(materials, map(str, given), strict=True)
    found = {name: text for name, text in pairs if text not in ("", name)}
    for name, text in found.items():
        if not can_be_shown(text):
            raise FormatError(
                f"{source}: display name {text!r} of {name!r} cannot be shown; use 1 to "
                f"{MOST_SHOWN} characters that are printed"
            )
    return found


def _group(name: str, values: Array) -> Array:
    """The values of a group: recordings as whole numbers, short floats as the decimals written."""
    if name == "recording" and values.dtype.kind in "fU" and values.ndim == 1:
        return np.unique(values, return_inverse=True)[1]
    if values.dtype.kind == "f" and values.itemsize < 8:
        return np.array([float(str(value)) for value in values.ravel()]).reshape(values.shape)
    return values


def _numbered(arrays: dict[str, Array], source: str) -> dict[str, Array]:
    """The arrays, with labels that are names as indices into `materials`. Raises FormatError."""
    if "labels" not in arrays or (given := arrays["labels"]).dtype.kind != "U":
        return arrays
    materials = arrays.get("materials", np.unique(given))
    number = {name: i for i, name in enumerate(materials.tolist())}
    if unknown := sorted(set(given.ravel().tolist()) - number.keys()):
        raise FormatError(
            f"{source}: label {unknown[0]!r} is not among the materials {materials.tolist()}; add "
            "it there"
        )
    return arrays | {
        "materials": materials,
        "labels": np.vectorize(number.get, otypes=[np.int64])(given),
    }


def _conversion(x: Array) -> str:
    """Advice for samples of another type: the first data type that holds the same values."""
    if x.dtype.kind not in "biuf":
        return ""
    fits = (d for d in DATA_TYPES if x.dtype.kind != "f" and (x.astype(d) == x).all())
    return f", e.g. samples.astype({next(fits, 'float32')!r})"
