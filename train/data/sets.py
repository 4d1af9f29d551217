"""The room of sweep sets. In: a file of the user's, or the name of a simulated set. Out: a checked Dataset.

A set knows which sweeps belong together (`groups`), can be narrowed to some of them and split so that no recording is
on both sides. What a file must hold stands in appliance/sim/sets.py, which the box plays sets with; files.py reads it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from appliance.core import sweep_set
from appliance.core.errors import FormatError
from appliance.core.sweep_set import Array
from appliance.sim import skin
from train.data import readers

SIMULATED = re.compile(r"sim:(?P<name>[^:]+)(:(?P<seed>\d+)(-(?P<last>\d+))?)?(:(?P<each>[1-9]\d*))?")
CONDITION = re.compile(r"\s*(\w+)\s*(<=|>=|=)(.*)")
OWN_NUMBERS = ("recording", "position", "session", "object")
"""Groups whose numbers mean something within their set only."""
LIMITS: dict[str, Callable[[Array, int], Array]] = {"<=": np.less_equal, ">=": np.greater_equal}


@dataclass(frozen=True)
class Dataset(sweep_set.SweepSet):
    """A set to train on: it can be narrowed and split."""

    def require_materials(self) -> Dataset:
        """The set itself. Raises FormatError where all its sweeps are of one material."""
        if len(present := np.unique(self.labels)) < 2:
            raise self._error(f"only one class, {self.materials[present[0]]!r}; a classifier needs two")
        return self

    def require_pure_recordings(self) -> Dataset:
        """The set itself. Raises FormatError where a recording is of several materials: no verdict on it could be right."""
        values, _, counts = self.tally("recording")
        if len(several := values[(counts > 0).sum(axis=1) > 1]):
            raise self._error(
                f"recording {several[0]} holds sweeps of several materials, as {len(several)} do; "
                "give each recording its own number"
            )
        return self

    def take(self, index: Array) -> Dataset:
        """The sweeps `index` (mask or numbers) with all materials, so that labels keep their meaning."""
        groups = {k: v[index] for k, v in self.groups.items()}
        return replace(self, samples=self.samples[index], labels=self.labels[index], groups=groups)

    def select(self, conditions: Sequence[str]) -> Dataset:
        """The sweeps for which all conditions hold, without materials left over.

        A condition is a group and a limit ("force<=180") or any of several values ("force=100,150"); `material` goes
        by name ("material=Canvas,Linen"). Raises FormatError where a condition cannot be read, its group or a value of
        it does not occur, or less than two classes remain.
        """
        keep = np.ones(len(self), bool)
        for text in conditions:
            keep &= self._fulfils(text)
        if not keep.any():
            raise self._error(f"no sweep fulfils {' and '.join(conditions)}; ask for less at once")
        part = self.take(keep).require_materials()
        present, labels = np.unique(part.labels, return_inverse=True)
        return replace(part, labels=labels, materials=tuple(self.materials[k] for k in present))

    def _fulfils(self, condition: str) -> Array:
        """bool [N], the sweeps for which one condition holds."""
        if not (found := CONDITION.fullmatch(condition)):
            raise self._error(f"condition {condition!r} cannot be read; write a group, one of = <= >=, whole numbers")
        name, how, text = found.groups()
        by_name = name == "material"
        of_each = np.array(self.materials)[self.labels] if by_name else self.group(name)
        try:
            values = [value.strip() if by_name else int(value) for value in text.split(",")]
        except ValueError:
            raise self._error(f"condition {condition!r} cannot be read; {text.strip()!r} is no whole number") from None
        if how in LIMITS:
            if by_name or len(values) > 1:
                raise self._error(f"condition {condition!r} cannot be read; {how} takes a group and one whole number")
            return LIMITS[how](of_each, values[0])
        for value in values:
            if not (of_each == value).any():
                raise self._error(f"no sweep fulfils {name}={value}; it has {shortened(np.unique(of_each))}")
        return np.isin(of_each, values)

    def without_means(self) -> Dataset:
        """The set with each window's mean over time taken from each taxel: samples float32, zero where one is constant.

        What is left is texture: the mean alone often tells the session in which a material was recorded.
        """
        means = self.samples.mean(axis=1, keepdims=True, dtype=np.float64)  # exact where a taxel is constant
        samples = np.subtract(self.samples, means, out=np.empty(self.samples.shape, np.float32), casting="same_kind")
        return replace(self, samples=samples)

    def tally(self, by: str) -> tuple[Array, Array, Array]:
        """The values [V] of group `by`, the place of each sweep's among them [N], and sweeps [V, K] of each material."""
        values, member = np.unique(self.group(by), return_inverse=True)
        counts = np.zeros((len(values), len(self.materials)), int)
        np.add.at(counts, (member, self.labels), 1)
        return values, member, counts

    def split(self, by: str, share: float, seed: int) -> tuple[Dataset, Dataset]:
        """Two parts, of which the first has about `share` of each material's groups `by`; no group is on both sides.

        Raises FormatError where a recording or the lack of groups forbids it, or the first part would lack a material.
        """
        if not 0 < share < 1:
            raise self._error(f"a share of {share} splits nothing; use more than 0 and less than 1")
        rng = np.random.default_rng(seed)
        names, member, counts = self.tally(by)
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
        """Write the set where `load` reads it: HDF5 where the name ends so, else a compressed .npz."""
        groups = {f"group_{k}": v for k, v in self.groups.items()}
        arrays = {"samples": self.samples, "labels": self.labels, "rate_hz": np.float64(self.rate_hz)} | groups
        if path.suffix in readers.HDF5:
            readers.write_hdf5(path, arrays | {"materials": list(self.materials)})
        else:
            with path.open("wb") as f:
                np.savez_compressed(f, materials=np.array(self.materials), **arrays)


def load(spec: str, seed: int = 0) -> Dataset:
    """The set that `spec` names: an .npz, an HDF5 file, a folder of recordings, or sim:NAME[:SEED[-LAST][:SWEEPS]].

    SWEEPS: per material and position. SEED-LAST: one set of several worlds, whose positions differ. seed: of a
    simulated set that names none. Raises FormatError where the set is missing, broken or unknown.
    """
    return _simulated(spec, seed) if spec.startswith("sim:") else readers.read(Path(spec), Dataset).require_materials()


def join(sets: Sequence[Dataset]) -> Dataset:
    """One set of several with the same format and materials, the groups that all have, and `set`: the place of each.

    Recordings, positions, sessions and objects are numbered on, since number 0 of two sets is not the same thing; a
    force or a speed is. One set alone stays as it is. Raises FormatError where the sets do not fit.
    """
    if len(sets) == 1:
        return sets[0]
    return _one([replace(s, groups=s.groups | {"set": np.full(len(s), i)}) for i, s in enumerate(sets)])


def _one(sets: Sequence[Dataset]) -> Dataset:
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
    return Dataset(samples, labels, head.materials, head.rate_hz, groups, " + ".join(s.source for s in sets))


def _simulated(spec: str, seed: int) -> Dataset:
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
        groups = {"position": position, "world": np.full(len(labels), world)}
        worlds.append(Dataset(samples, labels, skin.MATERIALS, skin.FORMAT.rate_hz, groups, spec))
    if not worlds:
        raise FormatError(f"set {spec!r} is empty: its last seed comes before its first")
    return replace(_one(worlds), source=spec)


def digest(sweeps: Dataset) -> str:
    """16 hex digits (SHA-256) of everything but the source: the same for the same data, from whatever file it came."""
    x, names = sweeps.samples, sorted(sweeps.groups)
    total = hashlib.sha256(repr((sweeps.materials, float(sweeps.rate_hz), x.dtype.name, x.shape, names)).encode())
    for numbers in (sweeps.labels, *(sweeps.groups[name] for name in names)):
        total.update(numbers.astype("<i8").tobytes())
    total.update(np.ascontiguousarray(x, x.dtype.newbyteorder("<")).data)
    return total.hexdigest()[:16]


def shortened(values: Sequence[object]) -> str:
    """Values in a line, those in the middle left out where they are many."""
    texts = [str(value) for value in values]
    return ", ".join(texts if len(texts) <= 9 else [*texts[:8], "…", texts[-1]])
