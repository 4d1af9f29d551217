"""Describes the counts, gaps and faults of a sweep set as lines of text.

An incomplete folder of recordings is described too: recordings without a name are counted, with the
reason why the folder cannot be trained on yet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.sweep_set import Array
from palpate.core.text import printable
from palpate.sim import skin
from palpate_train.data import labels, readers, sets
from palpate_train.data.group_values import text_of
from palpate_train.data.sets import Dataset, shortened

Check = Callable[[Dataset], Sequence[str]]
"""A check of a set that can be trained on; its warnings."""
MAX_COLUMNS = 12
"""Largest number of columns of a table. A group with more values has only its line."""
UNNAMED = "(none)"


def describe(spec: str, check: Check = lambda _: ()) -> str:
    """The contents of the set that `spec` names, as lines. check: a further check. Raises
    FormatError if the set is missing, broken or unknown."""
    folder = Path(spec)
    if spec.startswith("sim:") or not folder.is_dir():
        whole = sets.load(spec, 1)
        said = [*description(whole), *(f"  {line}" for line in warnings_of(whole))]
        said += [*(f"  {line}" for line in check(whole)), *_unsendable(whole.materials)]
        return "\n".join(map(printable, said))
    recorded = readers.read_recorded(folder)
    whole = readers.from_recorded(readers.named(recorded, UNNAMED, "material"), folder, Dataset)
    lines = [*description(whole), *(f"  {line}" for line in partly_unknown_tare(whole))]
    kept = [one.sweep for one in readers.usable(recorded)]
    if lost := [sweep.lost for sweep in kept if sweep.lost]:
        frames = sum(len(sweep.frames) for sweep in kept)
        lines.append(
            f"  frames lost: {sum(lost)} of {frames}, in {len(lost)} sweeps, "
            "filled in from their neighbours"
        )
    try:
        trainable = readers.from_recorded(recorded, folder, Dataset).require_materials()
        lines += [f"  {line}" for line in check(trainable)]
    except FormatError as e:
        lines.append(f"  cannot be trained on yet: {e}")
    lines += _unsendable(sorted({one.sweep.material for one in readers.usable(recorded)} - {""}))
    return "\n".join(map(printable, lines))


def warnings_of(sweeps: Dataset) -> list[str]:
    """Warnings about a set that training accepts, a line each."""
    lines = []
    if still := np.argwhere(
        sweeps.samples.min(axis=(0, 1)) == sweeps.samples.max(axis=(0, 1))
    ).tolist():
        listed = shortened([".".join(str(i + 1) for i in place) for place in still])
        lines.append(
            f"warning: taxels that never change in any sweep: {listed}; "
            "check the skin with `palpate skin show`"
        )
    counts = np.bincount(sweeps.labels, minlength=len(sweeps.materials))
    if empty := [name for name, n in zip(sweeps.materials, counts, strict=True) if not n]:
        lines.append(
            f"warning: materials without a sweep: {', '.join(empty)}; "
            "record some, or leave them out with --only"
        )
    return lines + partly_unknown_tare(sweeps)


def partly_unknown_tare(sweeps: Dataset) -> list[str]:
    """A warning if only some sweeps know the unloaded skin: the others cannot be brought to the
    same level."""
    if sweeps.unloaded is None:
        return []
    known = int(np.isfinite(sweeps.unloaded).all(axis=tuple(range(1, sweeps.unloaded.ndim))).sum())
    if known == len(sweeps):
        return []
    return [
        f"warning: {known} sweeps know the unloaded skin and {len(sweeps) - known} do not; these "
        "are taken as they are, and do not compare with the others if the skin was tared between; "
        "record with palpate record, and send TARE first"
    ]


def _unsendable(materials: Iterable[str]) -> list[str]:
    """A line if the box cannot send a material's name; `fit` refuses it."""
    return (
        [f"  cannot be trained on yet: {why}; {labels.REMEDY}"]
        if (why := labels.unsendable(materials))
        else []
    )


def description(sweeps: Dataset) -> list[str]:
    """The contents of a set as lines: sweeps and their format, materials, recordings, groups, and
    groups that are confounded with the material."""
    format = sweeps.format
    _, _, per_recording = sweeps.counts_by("recording")
    least, most = (windows := per_recording.sum(axis=1)).min(), windows.max()
    lines = [
        f"{sweeps.source}: {len(sweeps)} sweeps of {format.window / format.rate_hz:.3g} s; "
        f"{format}; digest {sets.digest(sweeps)}",
        f"  recordings: {len(windows)}, of {least if least == most else f'{least} to {most}'} each",
    ]
    if several := np.count_nonzero((per_recording > 0).sum(axis=1) > 1):
        lines.append(
            f"    {several} of them hold sweeps of several materials: "
            "number recordings within one material"
        )
    each = zip(sweeps.materials, per_recording.sum(axis=0), strict=True)
    lines.append(
        f"  materials: {len(sweeps.materials)}: {', '.join(f'{name} {n}' for name, n in each)}"
    )
    if sweeps.displays:
        shown = [f"{name}: {text}" for name, text in sweeps.displays.items()]
        lines.append(f"  display names: {'; '.join(shown)}")
    for by in sorted(set(sweeps.groups) - {"recording"}):
        values, _, counts = sweeps.counts_by(by)
        shown = [text_of(value) for value in values.tolist()]
        unit = sweeps.units.get(by, "")
        lines.append(f"  {by}: {len(values)}: {shortened(shown)}{f' {unit}' if unit else ''}")
        lines += [
            f"    confounded: {why}" for why in _confounded(shown, counts > 0, sweeps.materials)
        ]
        if by in readers.NAMED_GROUPS and len(values) <= MAX_COLUMNS:
            lines += [f"    {line}" for line in table(sweeps.materials, shown, counts)]
    return lines


def table(materials: Sequence[str], columns: Sequence[str], counts: Array) -> list[str]:
    """Lines of a table: sweeps of each material (row) in each column, with totals, and a dot for
    none. counts: [columns, K]."""
    totals = np.vstack([counts, counts.sum(axis=0)]).T
    totals = np.vstack([totals, totals.sum(axis=0)])
    rows = [["", *columns, "all"]]
    rows += [
        [name, *(str(n or "·") for n in row)]
        for name, row in zip([*materials, "all"], totals, strict=True)
    ]
    first, *wide = (max(map(len, column)) for column in zip(*rows, strict=True))
    return ["  ".join([row[0].ljust(first), *map(str.rjust, row[1:], wide)]) for row in rows]


def _confounded(values: Sequence[str], holds: Array, materials: Sequence[str]) -> Iterator[str]:
    """Each way in which a group reveals the material, or removes a material when a value is left
    out. holds: bool [V, K]."""
    if len(values) < 2:
        return
    if len(single := np.flatnonzero(holds.sum(axis=1) == 1)):
        yield f"one material only at {shortened([values[v] for v in single])}"
    for k in np.flatnonzero(holds.sum(axis=0) == 1).tolist():
        place = values[int(holds[:, k].argmax())]
        yield f"{materials[k]!r} only at {place}; without it the material cannot be trained on"


def known() -> str:
    """The names of sets, with their meaning, as lines."""
    tubes = len(skin.MATERIALS)
    lines = [
        "FILE.npz, .h5, .hdf5   samples [N, T, R, C] or [N, T, R, C, A], labels [N], "
        "materials [K], rate_hz, group_NAME [N]",
        "FILE.h5, .hdf5         TactMat: samples [materials, repetitions, T, R, C], materials",
        "                       palpate-train import makes a set of CSV, text, MAT, HDF5 and "
        ".npy files",
        "FOLDER                 recordings of palpate record or palpate-train pull, in all "
        "folders below",
        f"{sets.SIMULATED_FORM}  simulated; x3: three axes, SWEEPS of a tube at each position, "
        "SEED to LAST joined",
    ]
    for name, (positions, each) in skin.SETS.items():
        total = positions * each * tubes
        lines.append(
            f"  sim:{name:<12}{total:>5} sweeps, {each} of each of {tubes} tubes "
            f"at {positions} position(s)"
        )
    lines.append(
        f"  sim:{'T-HARD:1-20':<12}{20 * total:>5} sweeps, twenty simulated scenes joined, "
        "for narrow intervals"
    )
    lines.append(
        "  sim:NAME/level-blind   the same in a world where the level of a taxel says nothing "
        "about the tube"
    )
    return "\n".join(lines)
