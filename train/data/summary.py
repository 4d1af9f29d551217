"""The room of what is in sweep sets. In: what a set is called. Out: its counts, gaps and faults in lines.

A folder of recordings is told while it still grows too: what has no name yet, or only one material, is counted, and what
keeps the folder from being trained on is said.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from appliance.core.errors import FormatError
from appliance.core.sweep_set import Array
from appliance.sim import skin
from train.data import readers, sets
from train.data.readers import RecordedSweep
from train.data.sets import Dataset, shortened

Names = Mapping[str, Mapping[int, str]]
"""Of a group, and in it of a number: what it is called."""
WIDEST = 12
"""Columns that a table has at most; a group of more values is told by its line alone."""
NAMELESS = "(none)"


def describe(spec: str) -> str:
    """What the set that `spec` names holds, in lines. Raises FormatError where it is missing, broken or unknown."""
    folder = Path(spec)
    if spec.startswith("sim:") or not folder.is_dir():
        return "\n".join(described(sets.load(spec, 1), {}))
    held = readers.recorded(folder)
    named, names = _named(held)
    lines = described(readers.joined(named, folder, Dataset), names)
    kept = [one.sweep for one in readers.ok(held)]
    if lost := [sweep.lost for sweep in kept if sweep.lost]:
        frames = sum(len(sweep.frames) for sweep in kept)
        lines.append(f"  frames lost: {sum(lost)} of {frames}, in {len(lost)} sweeps, filled in from their neighbours")
    try:
        readers.joined(held, folder, Dataset).require_materials()
    except FormatError as e:
        lines.append(f"  cannot be trained on yet: {e}")
    return "\n".join(lines)


def _named(held: Sequence[RecordedSweep]) -> tuple[list[RecordedSweep], Names]:
    """The recordings with NAMELESS where some have a name and others none, and what the groups' numbers are called."""
    kept, names = [one.sweep for one in readers.ok(held)], {}
    filled = {"material": NAMELESS} | {by: NAMELESS for by in readers.NAMED if any(getattr(s, by) for s in kept)}

    def name(one: RecordedSweep) -> RecordedSweep:
        lacking = {by: text for by, text in filled.items() if not getattr(one.sweep, by)}
        return replace(one, sweep=replace(one.sweep, **lacking))

    named = [name(one) for one in held]
    for by in filled.keys() - {"material"}:
        texts = [getattr(one.sweep, by) for one in readers.ok(named)]
        names[by] = dict(zip(readers.numbered(texts).tolist(), texts, strict=True))
    return named, names


def described(sweeps: Dataset, names: Names) -> list[str]:
    """What a set holds: sweeps and their form, materials, recordings, groups and what is confounded."""
    fmt = sweeps.format
    _, _, held = sweeps.tally("recording")
    least, most = (windows := held.sum(axis=1)).min(), windows.max()
    lines = [
        f"{sweeps.source}: {len(sweeps)} sweeps of {fmt.window / fmt.rate_hz:.3g} s; {fmt}; digest {sets.digest(sweeps)}",
        f"  recordings: {len(windows)}, of {least if least == most else f'{least} to {most}'} each",
    ]
    if several := np.count_nonzero((held > 0).sum(axis=1) > 1):
        lines.append(f"    {several} of them hold sweeps of several materials: number recordings within one material")
    each = zip(sweeps.materials, held.sum(axis=0), strict=True)
    lines.append(f"  materials: {len(sweeps.materials)}: {', '.join(f'{name} {n}' for name, n in each)}")
    for by in sorted(set(sweeps.groups) - {"recording"}):
        values, _, counts = sweeps.tally(by)
        called = names.get(by, {})
        shown = [called.get(value, str(value)) for value in values.tolist()]
        both = [f"{v} {text}" if text != str(v) else text for v, text in zip(values, shown, strict=True)]
        lines.append(f"  {by}: {len(values)}: {shortened(both)}")
        lines += [f"    confounded: {why}" for why in _confounded(shown, counts > 0, sweeps.materials)]
        if by in readers.NAMED and len(values) <= WIDEST:
            lines += [f"    {line}" for line in table(sweeps.materials, shown, counts)]
    return lines


def table(materials: Sequence[str], columns: Sequence[str], counts: Array) -> list[str]:
    """Lines: sweeps of each material in each column, with totals; a dot where there is none. counts: [columns, K]."""
    held = np.vstack([counts, counts.sum(axis=0)]).T
    held = np.vstack([held, held.sum(axis=0)])
    rows = [["", *columns, "all"]]
    rows += [[name, *(str(n or "·") for n in row)] for name, row in zip([*materials, "all"], held, strict=True)]
    first, *wide = (max(map(len, column)) for column in zip(*rows, strict=True))
    return ["  ".join([row[0].ljust(first), *map(str.rjust, row[1:], wide)]) for row in rows]


def _confounded(values: Sequence[str], holds: Array, materials: Sequence[str]) -> Iterator[str]:
    """How a group of several values tells the material, or takes one with it when left out. holds: bool [V, K]."""
    if len(values) < 2:
        return
    if len(single := np.flatnonzero(holds.sum(axis=1) == 1)):
        yield f"one material only at {shortened([values[v] for v in single])}"
    for k in np.flatnonzero(holds.sum(axis=0) == 1):
        yield f"{materials[k]!r} only at {values[holds[:, k].argmax()]}; leaving that out leaves none to train on"


def known() -> str:
    """What can be named, in lines."""
    tubes = len(skin.MATERIALS)
    lines = [
        "FILE.npz, .h5, .hdf5   samples [N, T, R, C], labels [N], materials [K], rate_hz, group_NAME [N]",
        "FILE.h5, .hdf5         TactMat: samples [materials, repetitions, T, R, C], materials",
        "FOLDER                 what palpate record wrote and palpate-train pull fetched, and the folders in it",
        "sim:NAME[:SEED[-LAST][:SWEEPS]]  simulated; SWEEPS of a tube at each position, SEED to LAST joined",
    ]
    for name, (positions, each) in skin.SETS.items():
        total = positions * each * tubes
        lines.append(f"  sim:{name:<12}{total:>5} sweeps, {each} of each of {tubes} tubes at {positions} position(s)")
    lines.append(f"  sim:{'T-HARD:1-20':<12}{20 * total:>5} sweeps, twenty worlds joined, for tight intervals")
    return "\n".join(lines)
