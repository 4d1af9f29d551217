"""The room of sweep sets. In: a file of the user's, or the name of a simulated set. Out: a checked SweepSet.

A set knows which sweeps belong together (`groups`), can be narrowed to some of them and split so that no recording is
on both sides. A broken file is refused by name: no later room looks at shapes again.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from appliance.errors import FormatError
from appliance.sim import skin
from appliance.sweep import DIGITS, SweepFormat

Array = NDArray[Any]
SIMULATED = re.compile(r"sim:(?P<name>[^:]+)(:(?P<seed>\d+)(-(?P<last>\d+))?)?(:(?P<each>[1-9]\d*))?")
CONDITION = re.compile(r"\s*(\w+)\s*(<=|>=|=)\s*(-?\d+)\s*")
OWN_NUMBERS = ("recording", "position", "session")
"""Groups whose numbers mean something within their set only."""
COMPARE: dict[str, Callable[[Array, int], Array]] = {"=": np.equal, "<=": np.less_equal, ">=": np.greater_equal}


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
            raise self._error(f"samples are {x.dtype}; use one of {', '.join(DIGITS)}")
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

    def of_several(self) -> SweepSet:
        """The set itself. Raises FormatError where all its sweeps are of one material."""
        if len(present := np.unique(self.labels)) < 2:
            raise self._error(f"only one class, {self.materials[present[0]]!r}; a classifier needs two")
        return self

    def take(self, index: Array) -> SweepSet:
        """The sweeps `index` (mask or numbers) with all materials, so that labels keep their meaning."""
        groups = {k: v[index] for k, v in self.groups.items()}
        return replace(self, samples=self.samples[index], labels=self.labels[index], groups=groups)

    def select(self, conditions: Sequence[str]) -> SweepSet:
        """The sweeps for which all conditions hold ("direction=0", "force<=180"), without materials left over.

        Raises FormatError where a condition cannot be read, its group is unknown, or less than two classes remain.
        """
        keep = np.ones(len(self), bool)
        for text in conditions:
            if not (found := CONDITION.fullmatch(text)):
                raise self._error(f"condition {text!r} cannot be read; write a group, one of = <= >=, a whole number")
            name, how, value = found.groups()
            keep &= COMPARE[how](self.group(name), int(value))
        if not keep.any():
            raise self._error(f"no sweep fulfils {' and '.join(conditions)}; it has {', '.join(sorted(self.groups))}")
        part = self.take(keep).of_several()
        present, labels = np.unique(part.labels, return_inverse=True)
        return replace(part, labels=labels, materials=tuple(self.materials[k] for k in present))

    def split(self, by: str, share: float, seed: int) -> tuple[SweepSet, SweepSet]:
        """Two parts, of which the first has about `share` of each material's groups `by`; no group is on both sides.

        Raises FormatError where a recording or the lack of groups forbids it, or the first part would lack a material.
        """
        if not 0 < share < 1:
            raise self._error(f"a share of {share} splits nothing; use more than 0 and less than 1")
        rng, group = np.random.default_rng(seed), self.group(by)
        names, member = np.unique(group, return_inverse=True)
        counts = np.zeros((len(names), len(self.materials)), int)
        np.add.at(counts, (member, self.labels), 1)
        first = np.zeros(len(names), bool)
        for label in np.unique(main := counts.argmax(axis=1)):
            those = rng.permutation(np.flatnonzero(main == label))
            n = round(share * len(those))
            first[those[: min(max(n, 1), max(len(those) - 1, 1))]] = True
        inside = first[member]
        if set(self.group("recording")[inside]) & set(self.group("recording")[~inside]):
            raise self._error(f"groups {by!r} cut recordings in two; split by recording instead")
        if inside.all() or len(missing := np.setdiff1d(self.labels, self.labels[inside])):
            lacks = "is everything" if inside.all() else f"lacks {self.materials[missing[0]]!r}"
            raise self._error(f"split by {by!r}: the first part {lacks}; it has {len(names)} groups, use a finer one")
        return self.take(inside), self.take(~inside)

    def save(self, path: Path) -> None:
        """Write the set as a compressed .npz, which `load` reads."""
        groups = {f"group_{k}": v for k, v in self.groups.items()}
        arrays = {"samples": self.samples, "labels": self.labels, "materials": np.array(self.materials)} | groups
        with path.open("wb") as f:
            np.savez_compressed(f, rate_hz=np.float64(self.rate_hz), **arrays)


def load(spec: str, seed: int = 0) -> SweepSet:
    """The set that `spec` names: a file PATH.npz, or sim:NAME[:SEED[-LAST][:SWEEPS]].

    SWEEPS: per material and position. SEED-LAST: one set of several worlds, whose positions differ. seed: of a
    simulated set that names none. Raises FormatError where the set is missing, broken or unknown.
    """
    return _simulated(spec, seed) if spec.startswith("sim:") else _file(Path(spec))


def join(sets: Sequence[SweepSet]) -> SweepSet:
    """One set of several with the same format and materials, and the groups that all have.

    Recordings, positions and sessions are numbered on, since number 0 of two sets is not the same thing; a force or a
    speed is. Raises FormatError where the sets do not fit.
    """
    head, *others = sets
    for s in others:
        if (s.format, s.materials) != (head.format, head.materials):
            raise FormatError(
                f"{s.source} ({s.format}) and {head.source} ({head.format}) differ; join sets of one kind"
            )
    names = set.intersection(*(set(s.groups) for s in sets))
    if any("recording" in s.groups for s in sets):
        names.add("recording")
    groups = {}
    for name in sorted(names):
        parts = [s.group(name).astype(np.int64) for s in sets]
        if name in OWN_NUMBERS:
            starts = np.cumsum([0] + [int(np.ptp(part)) + 1 for part in parts])
            parts = [part - part.min() + start for part, start in zip(parts, starts, strict=False)]
        groups[name] = np.concatenate(parts)
    samples, labels = (np.concatenate([getattr(s, name) for s in sets]) for name in ("samples", "labels"))
    return SweepSet(samples, labels, head.materials, head.rate_hz, groups, " + ".join(s.source for s in sets))


def _simulated(spec: str, seed: int) -> SweepSet:
    found, known = SIMULATED.fullmatch(spec), get_args(skin.SetName)
    if not found or found["name"] not in known:
        raise FormatError(
            f"set {spec!r} is unknown; use sim:NAME[:SEED[-LAST][:SWEEPS]], NAME one of {', '.join(known)}"
        )
    first = int(found["seed"] or seed)
    each = int(found["each"]) if found["each"] else None
    worlds = []
    for world in range(first, int(found["last"] or first) + 1):
        samples, labels, position = skin.sweep_set(found["name"], world, each)
        worlds.append(SweepSet(samples, labels, skin.MATERIALS, skin.FORMAT.rate_hz, {"position": position}, spec))
    if not worlds:
        raise FormatError(f"set {spec!r} is empty: its last seed comes before its first")
    return replace(join(worlds), source=spec)


def read(path: Path, what: str) -> dict[str, Array]:
    """All arrays of an .npz, nothing unpickled. Raises FormatError saying that it is not `what`."""
    try:
        with np.load(path, allow_pickle=False) as z:
            return {k: z[k] for k in z.files}
    except (OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as e:
        raise FormatError(f"{path.name}: not {what}: {e}") from e


def _file(path: Path) -> SweepSet:
    held = read(path, "a sweep set (an .npz of samples, labels, materials, rate_hz)")
    missing = {"samples", "labels", "materials", "rate_hz"} - set(held)
    if missing:
        raise FormatError(
            f"{path.name}: lacks {', '.join(sorted(missing))}; a sweep set holds samples, labels, materials, rate_hz"
        )
    if held["materials"].ndim != 1 or held["materials"].dtype.kind != "U":
        raise FormatError(f"{path.name}: materials hold {held['materials'].dtype}; give a list of names")
    if held["rate_hz"].size != 1 or held["rate_hz"].dtype.kind not in "iuf":
        raise FormatError(f"{path.name}: rate_hz holds {held['rate_hz']!r}; give one number, frames per second")
    groups = {k.removeprefix("group_"): v for k, v in held.items() if k.startswith("group_")}
    materials = tuple(str(m) for m in held["materials"])
    whole = SweepSet(held["samples"], held["labels"], materials, held["rate_hz"].item(), groups, path.name)
    return whole.of_several()
