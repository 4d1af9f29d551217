"""The room of sweep sets. In: a file of the user's, or the name of a simulated set. Out: a checked SweepSet.

A set knows which sweeps belong together (`groups`), can be narrowed to some of them and split so that no recording is
on both sides. What a file must hold stands in appliance/sim/sets.py, which the box plays sets with.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from appliance.errors import FormatError
from appliance.sim import sets, skin
from appliance.sim.sets import Array, load_file

SIMULATED = re.compile(r"sim:(?P<name>[^:]+)(:(?P<seed>\d+)(-(?P<last>\d+))?)?(:(?P<each>[1-9]\d*))?")
CONDITION = re.compile(r"\s*(\w+)\s*(<=|>=|=)\s*(-?\d+)\s*")
OWN_NUMBERS = ("recording", "position", "session")
"""Groups whose numbers mean something within their set only."""
COMPARE: dict[str, Callable[[Array, int], Array]] = {"=": np.equal, "<=": np.less_equal, ">=": np.greater_equal}


@dataclass(frozen=True)
class SweepSet(sets.SweepSet):
    """A set to train on: it can be narrowed and split."""

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
    return _simulated(spec, seed) if spec.startswith("sim:") else load_file(Path(spec), SweepSet).of_several()


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
