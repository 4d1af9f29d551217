"""Sweep sets for training and testing, from a user's file or by the name of a simulated
set.

The groups of a set say which sweeps belong together. A set can be narrowed to some sweeps, and
split so that no recording is on both sides. palpate.core.sweep_set defines the contents of a
file; readers.py reads it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from palpate.core import storage, sweep_set
from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.sim import skin
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.data import group_values, mapped, readers
from palpate_train.data.files.table import normal
from palpate_train.data.group_values import text_of

SIMULATED = re.compile(
    r"sim:(?P<name>[^:/]+?)(?P<shear>x3)?(/(?P<world>[^:]+))?"
    r"(:(?P<seed>\d+)(-(?P<last>\d+))?)?(:(?P<each>[1-9]\d*))?"
)
SIMULATED_FORM = "sim:NAME[x3][/WORLD][:SEED[-LAST][:SWEEPS]]"
CONDITION = re.compile(r"\s*(\w+)\s*(<=|>=|=)(.*)")
OWN_NUMBERS = ("recording", "position", "session", "object")
"""Groups whose numbers only have a meaning within their set; their names have one everywhere."""
LIMITS: dict[str, Callable[[Array, Any], Array]] = {"<=": np.less_equal, ">=": np.greater_equal}


@dataclass(frozen=True, eq=False)
class Dataset(sweep_set.SweepSet):
    """A SweepSet that can be narrowed, split and saved."""

    def require_materials(self) -> Dataset:
        """The set itself. Raises FormatError if all its sweeps have the same material."""
        if len(present := np.unique(self.labels)) < 2:
            raise self._error(
                f"only one class, {self.materials[present[0]]!r}; a classifier needs two"
            )
        return self

    def require_pure_recordings(self) -> Dataset:
        """The set itself. Raises FormatError if a recording has several materials: no answer to it
        could be right."""
        values, _, counts = self.counts_by("recording")
        if len(several := values[(counts > 0).sum(axis=1) > 1]):
            raise self._error(
                f"recording {several[0]} holds sweeps of several materials, as {len(several)} do; "
                "give each recording its own number"
            )
        return self

    def take(self, index: Array) -> Dataset:
        """The sweeps at `index` (mask or numbers). All materials stay, so labels keep their
        meaning."""
        groups = {k: v[index] for k, v in self.groups.items()}
        unloaded = None if self.unloaded is None else self.unloaded[index]
        return replace(
            self,
            samples=mapped.taken(self.samples, index),
            labels=self.labels[index],
            groups=groups,
            unloaded=unloaded,
        )

    def select(self, conditions: Sequence[str]) -> Dataset:
        """The sweeps that meet all conditions, without materials that no longer occur.

        A condition is a group with a limit ("force<=180") or with alternative values
        ("force=100,150", "speed=slow"). Materials are given by name ("material=Canvas,Linen").
        Raises FormatError if a condition cannot be read, if its group or a value does not occur, or
        if fewer than two classes remain.
        """
        keep = np.ones(len(self), bool)
        for text in conditions:
            keep &= self._matches(text)
        if not keep.any():
            raise self._error(f"no sweep fulfils {' and '.join(conditions)}; use fewer conditions")
        return self._only(keep)

    def taught(self) -> tuple[Dataset, Array | None]:
        """The sweeps of materials that an answer may name, and the samples of the others, which are
        of NOT_THIS; None without any. Raises FormatError if fewer than two materials remain."""
        named = np.array(self.materials)[self.labels] != NOT_THIS
        if named.all():
            return self, None
        return self._only(named), mapped.taken(self.samples, ~named)

    def _only(self, keep: Array) -> Dataset:
        """The sweeps `keep` (bool [N]), without materials that no longer occur."""
        part = (self if keep.all() else self.take(keep)).require_materials()
        present, labels = np.unique(part.labels, return_inverse=True)
        return replace(part, labels=labels, materials=tuple(self.materials[k] for k in present))

    def listed(self, name: str, text: str) -> list[Any]:
        """The values of the group `name`, or the materials, that `text` lists with commas; see
        group_values.listed. Raises FormatError, also for an unknown group."""
        if name == "material":
            return group_values.listed(np.array(self.materials), "", text)
        return group_values.listed(self.group(name), self.units.get(name, ""), text)

    def _matches(self, condition: str) -> Array:
        """The sweeps that meet one condition, bool [N]."""
        condition = normal(condition)
        if not (found := CONDITION.fullmatch(condition)):
            raise self._error(
                f"condition {condition!r} cannot be read; write a group, one of = <= >=, and values"
            )
        name, operator, text = found.groups()
        material = name == "material"
        column = np.array(self.materials)[self.labels] if material else self.group(name)
        try:
            values = self.listed(name, text)
        except FormatError as e:
            raise self._error(f"condition {condition!r} cannot be read; {e}") from None
        if operator in LIMITS:
            if column.dtype.kind == "U" or len(values) > 1:
                holds = f"; {name} holds names" if column.dtype.kind == "U" else ""
                raise self._error(
                    f"condition {condition!r} cannot be read; "
                    f"{operator} takes a group of numbers and one number{holds}"
                )
            return LIMITS[operator](column, values[0])
        for value in values:
            if not np.any(column == value):
                raise self._error(
                    f"no sweep fulfils {name}={text_of(value)}; "
                    f"it has {shortened(np.unique(column).tolist())}"
                )
        return np.isin(column, values)

    def without_means(self) -> Dataset:
        """The set without each taxel's mean over the window: samples float32, zero if a taxel is
        constant.

        Only texture remains. The mean alone often reveals the session in which a material was
        recorded.
        """
        means = self.samples.mean(
            axis=1, keepdims=True, dtype=np.float64
        )  # exact if a taxel is constant
        samples = np.subtract(
            self.samples, means, out=np.empty(self.samples.shape, np.float32), casting="same_kind"
        )
        return replace(self, samples=samples, unloaded=None)

    def counts_by(self, by: str) -> tuple[Array, Array, Array]:
        """The values [V] of group `by`, the index of each sweep's value [N], and the sweeps of each
        material [V, K]."""
        values, member = np.unique(self.group(by), return_inverse=True)
        counts = np.zeros((len(values), len(self.materials)), int)
        np.add.at(counts, (member, self.labels), 1)
        return values, member, counts

    def split(self, by: str, share: float, seed: int) -> tuple[Dataset, Dataset]:
        """Two parts; the first has about `share` of each material's groups `by`. No group is in
        both.

        Raises FormatError if a recording would be in both parts, if there are too few groups, or if
        the first part would lack a material.
        """
        if not 0 < share < 1:
            raise self._error(f"a share of {share} splits nothing; use more than 0 and less than 1")
        rng = np.random.default_rng(seed)
        names, member, counts = self.counts_by(by)
        first = np.zeros(len(names), bool)
        for label in np.unique(main := counts.argmax(axis=1)):
            groups = rng.permutation(np.flatnonzero(main == label))
            n = round(share * len(groups))
            first[groups[: min(max(n, 1), max(len(groups) - 1, 1))]] = True
        inside = first[member]
        if set(self.group("recording")[inside]) & set(self.group("recording")[~inside]):
            raise self._error(f"groups {by!r} cut recordings in two; split by recording instead")
        if inside.all() or len(missing := np.setdiff1d(self.labels, self.labels[inside])):
            lacks = "is everything" if inside.all() else f"lacks {self.materials[missing[0]]!r}"
            raise self._error(
                f"split by {by!r}: the first part {lacks}; "
                f"it has {len(names)} groups, use a finer one"
            )
        return self.take(inside), self.take(~inside)

    def save(self, path: Path) -> None:
        """Write the set as HDF5 if the name ends in .h5 or .hdf5, else as an .npz; `load`
        reads both. Both are compressed unless the samples are so large that they are mapped."""
        arrays: dict[str, Array] = {
            "samples": self.samples,
            "labels": self.labels,
            "rate_hz": np.array(self.rate_hz),
        }
        arrays |= {f"group_{k}": v for k, v in self.groups.items()}
        arrays |= {f"unit_{k}": np.array(v) for k, v in self.units.items() if k in self.groups}
        if self.displays:
            names = [self.displays.get(name, "") for name in self.materials]
            arrays["displays"] = np.array(names, dtype=str)
        if self.unloaded is not None:
            arrays["unloaded"] = self.unloaded
        with storage.file(path) as f:
            if path.suffix in readers.HDF5:
                readers.write_hdf5(f, arrays | {"materials": list(self.materials)})
            else:
                large = self.samples.nbytes >= mapped.LEAST
                write = np.savez if large else np.savez_compressed
                write(f, allow_pickle=False, materials=np.array(self.materials), **arrays)


def load(spec: str, seed: int = 0) -> Dataset:
    """The set that `spec` names: an .npz, an HDF5 file, a folder of recordings
    or sim:NAME[x3][/WORLD][:SEED[-LAST][:SWEEPS]].

    x3: a skin with three axes. WORLD: of skin.WORLDS. SWEEPS: number of sweeps for each material
    and position. SEED-LAST: several simulated scenes joined, each with positions of its own. seed:
    for a simulated set whose name holds none. Raises FormatError if the set is missing, broken or
    unknown.
    """
    if spec.startswith("sim:"):
        return _simulated(spec, seed)
    return readers.read(Path(spec), Dataset).require_materials()


def join(sets: Sequence[Dataset]) -> Dataset:
    """Join sets that have the same format, with the materials of all. Groups are all that the sets
    share, and `set`, the index of the set.

    The numbers of recordings, positions, sessions and objects are changed, because number 0 means
    another position in another set. All other values stay, in the unit of the first set. If the
    skin was tared between the sets, they are brought to one level, as in a folder. A single set is
    not changed. Raises FormatError if formats or kinds of units differ.
    """
    if len(sets) == 1:
        return sets[0]
    return _joined(
        [replace(s, groups=s.groups | {"set": np.full(len(s), i)}) for i, s in enumerate(sets)]
    )


def _joined(sets: Sequence[Dataset]) -> Dataset:
    head, *others = sets
    for s in others:
        if s.format != head.format:
            raise FormatError(
                f"{s.source} ({s.format}) and {head.source} ({head.format}) differ; "
                "join sets of one kind"
            )
    names = set.intersection(*(set(s.groups) for s in sets))
    if any("recording" in s.groups for s in sets):
        names.add("recording")
    groups: dict[str, Array] = {}
    units: dict[str, str] = {}
    for name in sorted(names):
        parts = [s.group(name) for s in sets]
        if name in OWN_NUMBERS:
            parts = _apart(parts)
        groups[name], unit = group_values.joined(name, parts, [s.units.get(name, "") for s in sets])
        units |= {name: unit} if unit else {}
    samples = mapped.joined([s.samples for s in sets])
    materials = tuple(dict.fromkeys(name for s in sets for name in s.materials))
    labels = np.concatenate(
        [np.array([materials.index(name) for name in s.materials])[s.labels] for s in sets]
    )
    source, unloaded = " + ".join(s.source for s in sets), _unloaded(sets)
    if unloaded is not None:  # each set is consistent, but levels may differ between sets
        samples, unloaded, remark = readers.align_tare(samples, unloaded)
        source += remark
    made = Dataset(samples, labels, materials, head.rate_hz, groups, source, unloaded, units)
    return replace(made, displays={k: v for s in reversed(sets) for k, v in s.displays.items()})


def _apart(parts: Sequence[Array]) -> list[Array]:
    """The values of a group of OWN_NUMBERS in each set, whole numbers changed so that no two sets
    have the same."""
    whole = [part.dtype.kind in "iu" for part in parts]
    starts = np.cumsum(
        [0] + [int(np.ptp(p)) + 1 if w else 0 for p, w in zip(parts, whole, strict=True)]
    )
    return [
        p.astype(np.int64) - int(p.min()) + start if w else p
        for p, w, start in zip(parts, whole, starts, strict=False)
    ]


def _unloaded(sets: Sequence[Dataset]) -> Array | None:
    """The unloaded skin of all sets, one after the other; None if no set has it."""
    if all(s.unloaded is None for s in sets):
        return None
    known: Array = np.concatenate(
        [
            np.full((len(s), 2, *s.format.shape), np.nan) if s.unloaded is None else s.unloaded
            for s in sets
        ]
    )
    return known


def simulated_world(found: re.Match[str]) -> skin.World:
    """The world of a name that SIMULATED matches. Raises FormatError for an unknown one."""
    name = found["world"] or ""
    if name not in skin.WORLDS:
        named = ", ".join(world for world in skin.WORLDS if world)
        raise FormatError(f"set {found[0]!r} is of an unknown world, {name!r}; use {named} or none")
    return replace(skin.WORLDS[name], shear=bool(found["shear"]))


def _simulated(spec: str, seed: int) -> Dataset:
    found, known = SIMULATED.fullmatch(spec), get_args(skin.SetName)
    if not found or found["name"] not in known:
        raise FormatError(
            f"set {spec!r} is unknown; use {SIMULATED_FORM}, NAME one of {', '.join(known)}"
        )
    name: skin.SetName = found["name"]  # type: ignore[assignment]  # was just checked
    first = int(found["seed"] or seed)
    each = int(found["each"]) if found["each"] else None
    physics, scenes = simulated_world(found), []
    for world in range(first, int(found["last"] or first) + 1):
        samples, labels, position = skin.sweep_set(name, world, each, physics)
        groups = {"position": position, "world": np.full(len(labels), world)}
        scenes.append(Dataset(samples, labels, skin.MATERIALS, skin.FORMAT.rate_hz, groups, spec))
    if not scenes:
        raise FormatError(f"set {spec!r} is empty: its last seed comes before its first; swap them")
    return replace(_joined(scenes), source=spec)


def thinned(sweeps: Dataset, most: int) -> Dataset:
    """At most `most` sweeps in their order; the set itself if it has no more.

    Each material gets the same number, or all of its sweeps if it has fewer. Within a material the
    same holds for recordings, because their windows resemble each other. The windows of a recording
    are evenly spaced. A set with at least as
    many materials as `most` keeps one sweep of each.
    """
    if len(sweeps) <= most:
        return sweeps
    recording, kept = sweeps.group("recording"), []
    materials = np.unique(sweeps.labels)
    for label, quota in zip(materials, _quotas(_counts(sweeps.labels), most), strict=True):
        own = np.flatnonzero(sweeps.labels == label)
        numbers = np.unique(recording[own], return_inverse=True)[1]
        quotas = _quotas(_counts(numbers), max(int(quota), 1))
        order = np.argsort(numbers, kind="stable")
        starts = np.cumsum(_counts(numbers)) - _counts(numbers)
        for start, n, few in zip(starts, _counts(numbers), quotas, strict=True):
            kept.append(own[order[start + (np.arange(few) * n) // max(few, 1)]])
    return sweeps.take(np.sort(np.concatenate(kept)))


def evenly(n: int, most: int) -> Array:
    """Numbers below `n`, at most `most` of them, at equal distances."""
    return np.linspace(0, n - 1, min(n, most)).round().astype(int)


def _counts(values: Array) -> Array:
    return np.unique(values, return_counts=True)[1]


def _quotas(counts: Array, total: int) -> Array:
    """The share of each of `counts` [k] in `total`: the same level, or its count if that is
    smaller. The rest goes to some of the larger ones, evenly spaced."""
    if counts.sum() <= total:
        return counts
    ascending, k = np.sort(counts), len(counts)
    whole = np.append(0, np.cumsum(ascending)[:-1])  # of all smaller ones
    levels = (total - whole) // (k - np.arange(k))
    level = int(levels[np.argmax(levels < ascending)])
    quotas = np.minimum(counts, level)
    larger, left = np.flatnonzero(counts > level), total - int(quotas.sum())
    quotas[larger[np.arange(left) * len(larger) // max(left, 1)]] += 1
    return quotas


def digest(sweeps: Dataset) -> str:
    """The first 16 hex digits of the SHA-256 of all arrays: equal for equal data, in whatever file.
    The source does not count."""
    x, names = sweeps.samples, sorted(sweeps.groups)
    total = hashlib.sha256(
        repr((sweeps.materials, float(sweeps.rate_hz), x.dtype.name, x.shape, names)).encode()
    )
    for values in (sweeps.labels, *(sweeps.groups[name] for name in names)):
        if values.dtype.kind == "U":
            total.update(repr(values.tolist()).encode())
        else:
            total.update(values.astype("<f8" if values.dtype.kind == "f" else "<i8").tobytes())
    if sweeps.unloaded is not None:
        total.update(np.ascontiguousarray(sweeps.unloaded, "<f8").data)
    total.update(np.ascontiguousarray(x, x.dtype.newbyteorder("<")).data)
    return total.hexdigest()[:16]


def shortened(values: Sequence[object]) -> str:
    """Values as text; of more than nine, those in the middle are left out."""
    texts = [text_of(value) for value in values]
    return ", ".join(texts if len(texts) <= 9 else [*texts[:8], "…", texts[-1]])
