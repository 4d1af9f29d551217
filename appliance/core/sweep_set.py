"""The form of a sweep set, for whoever plays it or trains on it. In: an .npz of a user's. Out: a checked SweepSet.

A broken file is refused by name: no later room looks at shapes again.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.core.types import DIGITS, SweepFormat

Array = NDArray[Any]
Set = TypeVar("Set", bound="SweepSet")


@dataclass(frozen=True)
class SweepSet:
    """N sweeps with what is known of them.

    samples: digits [N, T, R, C] of one of DIGITS. labels: int [N], index into `materials`.
    groups: int [N] each; sweeps with the same number of `recording` are pieces of one recording.
    Raises FormatError naming `source` and what is wrong.
    """

    samples: Array
    labels: Array
    materials: tuple[str, ...]
    rate_hz: float
    groups: dict[str, Array] = field(default_factory=dict)
    source: str = "sweep set"

    def __post_init__(self) -> None:
        x, n = self.samples, len(self.materials)
        if x.ndim != 4 or 0 in x.shape:
            raise self._error(
                f"samples have the shape {list(x.shape)}; give [sweeps, frames, rows, columns], none empty"
            )
        if x.dtype.name not in DIGITS:
            raise self._error(f"samples are {x.dtype}; use one of {', '.join(DIGITS)}{_conversion(x)}")
        if x.dtype.kind == "f" and not np.isfinite(x).all():
            at = tuple(int(i) for i in np.argwhere(~np.isfinite(x))[0])
            raise self._error(f"samples{list(at)} is {x[at]}; drop sweep {at[0]} or fill it in")
        for name, values in {"labels": self.labels, **{f"group_{k}": v for k, v in self.groups.items()}}.items():
            if values.shape != (len(x),) or values.dtype.kind not in "iu":
                what = f"{values.dtype} {list(values.shape)}"
                raise self._error(f"{name} holds {what}; give one whole number for each of {len(x)} sweeps")
        outside = np.flatnonzero((self.labels < 0) | (self.labels >= n))
        if len(outside):
            i = outside[0]
            raise self._error(
                f"label {self.labels[i]} of sweep {i} is out of range; there are {n} materials, from 0 on"
            )
        if len(set(self.materials)) < n:
            raise self._error(f"materials {list(self.materials)} name one twice; give each its own name")
        if not 0 < self.rate_hz < np.inf:
            raise self._error(f"rate_hz is {self.rate_hz}; give frames per second")
        try:
            _ = self.format
        except FormatError as e:
            raise self._error(str(e)) from e

    def _error(self, why: str) -> FormatError:
        return FormatError(f"{self.source}: {why}")

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def format(self) -> SweepFormat:
        """The form of each sweep."""
        _, window, rows, cols = self.samples.shape
        return SweepFormat(rows, cols, self.rate_hz, window, self.samples.dtype.name)

    def group(self, name: str) -> Array:
        """Group `name`, int [N]; where nothing is known of recordings each sweep is one. Raises FormatError."""
        if name in self.groups:
            return self.groups[name]
        if name == "recording":
            return np.arange(len(self))
        raise self._error(f"no group {name!r}; it has {', '.join(sorted(self.groups)) or 'none'}")


def read(path: Path, what: str) -> dict[str, Array]:
    """All arrays of an .npz, nothing unpickled. Raises FormatError saying that it is not `what`."""
    try:
        with np.load(path, allow_pickle=False) as z:
            return {k: z[k] for k in z.files}
    except (OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as e:
        raise FormatError(f"{path.name}: not {what}: {e}") from e


def load_file(path: Path, kind: type[Set]) -> Set:
    """The set in the .npz `path`. Raises FormatError naming what is missing or of the wrong form, and where."""
    return build(read(path, "a sweep set (an .npz of samples, labels, materials, rate_hz)"), path.name, kind)


def build(held: dict[str, Array], source: str, kind: type[Set]) -> Set:
    """The set of the arrays `held`, named as in a file. Raises FormatError naming `source` and what is wrong."""
    missing = {"samples", "labels", "materials", "rate_hz"} - set(held)
    if missing:
        raise FormatError(
            f"{source}: lacks {', '.join(sorted(missing))}; a sweep set holds samples, labels, materials, rate_hz"
        )
    if held["materials"].ndim != 1 or held["materials"].dtype.kind != "U":
        raise FormatError(f"{source}: materials hold {held['materials'].dtype}; give a list of names")
    if held["rate_hz"].size != 1 or held["rate_hz"].dtype.kind not in "iuf":
        raise FormatError(f"{source}: rate_hz holds {held['rate_hz']!r}; give one number, frames per second")
    # torch and onnxruntime take this machine's byte order only
    native = {k: v.astype(v.dtype.newbyteorder("="), copy=False) for k, v in held.items()}
    groups = {k.removeprefix("group_"): v for k, v in native.items() if k.startswith("group_")}
    materials = tuple(str(m) for m in held["materials"])
    return kind(native["samples"], native["labels"], materials, held["rate_hz"].item(), groups, source)


def _conversion(x: Array) -> str:
    """What to do with samples of another type: the first digit type that holds the same values, float32 for broken ones."""
    if x.dtype.kind not in "biuf":
        return ""
    fits = (d for d in DIGITS if x.dtype.kind != "f" and (x.astype(d) == x).all())
    return f", e.g. samples.astype({next(fits, 'float32')!r})"
