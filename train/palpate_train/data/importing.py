"""Imports a folder of recordings, files of frames x taxels, as a sweep set.

Each file is one recording of one material, and its name says which. Nothing is guessed: a file
with missing or ambiguous information is left out, and the report says why.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from palpate.core.errors import FormatError
from palpate.core.names import shown
from palpate.core.sweep_set import Array
from palpate.core.text import printable
from palpate.core.types import DATA_TYPES
from palpate_train.data import frames, labels, lerobot, number_types, raw_files, readers, sampling
from palpate_train.data.file_names import NamePattern, group
from palpate_train.data.files import zarr_store
from palpate_train.data.files.table import MOST_LISTED, ReadPlan, Table, normal
from palpate_train.data.import_plan import ImportPlan
from palpate_train.data.progress import Progress
from palpate_train.data.sets import Dataset

DISPLAY = "display name"
"""Field of a recording whose material has a display name next to the name that is sent."""
BATCH = 4096
"""Number of frames that are converted at a time."""
Fields = dict[str, str]


@dataclass(frozen=True, eq=False)
class Recording:
    """The contents of one file. frames: [n, R, C] or [n, R, C, A], as recorded. time_s: [n], or
    None if the file holds no times. notes: remarks of the reader."""

    name: str
    fields: Fields
    frames: Array
    time_s: Array | None
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class LeftOutFile:
    """A file that was not imported. broken: its name matches the pattern, but it cannot be used."""

    name: str
    why: str
    broken: bool = False


Source = tuple[str, Fields, Callable[[], Table]] | LeftOutFile
"""Name of a recording, its fields that are known already, and a function that reads it; or why it
cannot be read."""


@dataclass(frozen=True)
class Taken:
    """A recording that was imported: its numbers of windows and frames. said: remarks of the
    reader. notes: how its frames were changed."""

    name: str
    windows: int
    frames: int
    said: Sequence[str]
    notes: str


@dataclass(frozen=True, eq=False)
class Cut:
    """Windows [k, T, R, C(, A)] of one recording, most of them views of its frames. notes: how its
    frames were changed."""

    recording: Recording
    windows: Array
    notes: str

    def counted(self) -> Taken:
        """The counts and remarks, without windows and frames."""
        one = self.recording
        return Taken(one.name, len(self.windows), len(one.frames), one.notes, self.notes)


@dataclass(frozen=True, eq=False)
class Imported:
    """An imported sweep set. taken, left_out: one entry for each file. notes: remarks on the whole
    set."""

    sweeps: Dataset
    taken: Sequence[Taken]
    left_out: Sequence[LeftOutFile]
    notes: Sequence[str]


def import_folder(
    folder: Path, plan: ImportPlan, log: Callable[[str], None], left_out: list[LeftOutFile]
) -> Imported:
    """Import all files in and below `folder` whose names match the pattern.

    Files that cannot be imported are added to `left_out` at once, so that the caller can show them
    even after an error. Raises FormatError if the box cannot send a material's name, or if no file
    remains.
    """
    plan, sources = _sources(folder, plan, log, left_out)
    recordings, count = [], 0
    orders: dict[tuple[str, ...], tuple[str, ...]] = {}
    for source in sources:
        count += 1
        if isinstance(source, LeftOutFile):
            left_out.append(source)
            continue
        name, known, read = source
        try:
            table = read()
            frames.check_order(table, orders, plan)
            recordings += _recordings(table, name, known, plan)
        except frames.GridMissing as e:
            if not recordings:  # the other files would fail, too, after the time to read them
                raise FormatError(f"{folder}: {name} {e}") from e
            left_out.append(LeftOutFile(name, str(e), broken=True))
        except FormatError as e:
            left_out.append(LeftOutFile(name, str(e), broken=True))
    if "material" not in plan.of_files and recordings:
        _name_materials(folder, [one.fields for one in recordings], plan)
    cuts, rate_hz = _cuts(recordings, plan, left_out)
    del recordings  # their frames go as soon as they are in the set
    cuts, warnings = _without_copies(cuts, left_out)
    dtype, about = _common_type(cuts, plan.dtype, left_out)
    cuts = [cut for cut in cuts if cut.recording.name not in {file.name for file in left_out}]
    if not cuts:
        raise FormatError(
            f"{folder}: none of {count} files could be imported; the messages above say why"
        )
    taken = [cut.counted() for cut in cuts]
    sweeps, notes = _set(folder, cuts, rate_hz, dtype, plan)
    return Imported(sweeps, taken, left_out, [about, *warnings, *notes])


def _sources(
    folder: Path, plan: ImportPlan, log: Callable[[str], None], left_out: list[LeftOutFile]
) -> tuple[ImportPlan, Iterator[Source]]:
    """What can be read of a folder, and the plan with the grid that a LeRobot data set states."""
    check_folder(folder)
    if plan.pattern is not None or not lerobot.is_data_set(folder):
        return plan, _files(_named(folder, plan, left_out), plan, log)
    plan, remark = lerobot.with_grid(folder, plan)
    episodes = lerobot.episodes(folder, plan)
    return plan, ((name, {}, partial(replace, table, notes=remark)) for name, table in episodes)


def check_folder(folder: Path) -> None:
    """Raise FormatError for a folder that cannot be read."""
    if not folder.is_dir():
        raise FormatError(f"{folder} is not a folder; name the folder that holds the recordings")
    readers.check_folder(folder)


def _named(
    folder: Path, plan: ImportPlan, left_out: list[LeftOutFile]
) -> dict[str, tuple[Path, Fields]]:
    """Path and fields of each file whose name matches the pattern, and which is in the table of
    labels if there is one, by its path below `folder`.

    Materials have their new names. Files that only systems and editors read are passed over.
    """
    inside = [folder] if zarr_store.is_store(folder) else readers.files_below(folder)
    root = folder.parent if inside == [folder] else folder
    paths = {normal(p.relative_to(root).as_posix()): p for p in inside}
    found: dict[str, tuple[Path, Fields]] = {}
    for name, path in paths.items():
        fields = _fields_of(name, plan)
        if isinstance(fields, LeftOutFile):
            left_out.append(fields)
        else:
            found[name] = path, fields
    there = {*paths, *(path.name for path in paths.values())}
    left_out += [
        LeftOutFile(name, "it is in the table of --labels, but not in the folder", broken=True)
        for name in plan.labels
        if name not in there
    ]
    if not found:
        first = f"the first file is {next(iter(paths))!r}" if paths else "it holds no files"
        pattern = f"matches --pattern {plan.pattern.text!r}" if plan.pattern else "is there"
        why = next((one.why for one in left_out if one.broken), "")
        first += f": {why}" if paths and why else ""
        raise FormatError(f"{folder}: no file {pattern}; {first}")
    if "material" in plan.of_files:
        _name_materials(folder, [fields for _, fields in found.values()], plan)
    return found


def _fields_of(name: str, plan: ImportPlan) -> Fields | LeftOutFile:
    """The fields of a file by its path below the folder and the table of labels."""
    try:
        in_name = plan.pattern.read(name) if plan.pattern else {}
    except FormatError as e:
        return LeftOutFile(name, str(e), broken=True)
    if in_name is None:
        return LeftOutFile(name, "its name does not match the pattern")
    row = plan.labels.get(name, plan.labels.get(name.rpartition("/")[2], {}))
    if plan.labels and not row:
        return LeftOutFile(name, "it is not in the table of --labels")
    return {**in_name, **row}


def _name_materials(folder: Path, known: Sequence[Fields], plan: ImportPlan) -> None:
    """Give materials their new names. A name that the box cannot send is replaced, and stays as the
    display name. Raises FormatError for a new name that the box cannot send, or for an old name
    that does not occur."""
    labels.check_renames(plan.renames, (fields["material"] for fields in known))
    if why := labels.unsendable(plan.renames.values()):
        raise FormatError(f"{folder}: {why}; {labels.REMEDY}")
    names = {fields["material"] for fields in known}
    new = {name: plan.renames.get(name, name) for name in names}
    sent = labels.sendable(new.values())
    for fields in known:
        written = fields["material"]
        fields["material"] = sent[new[written]]
        if labels.unsendable([written]) and (text := shown(written)):
            fields[DISPLAY] = text


def _files(
    named: Mapping[str, tuple[Path, Fields]], plan: ImportPlan, log: Callable[[str], None]
) -> Iterator[Source]:
    """The files of a folder; each is read when it is its turn."""
    progress = Progress(len(named), log)
    wanted = ReadPlan(
        plan.variable,
        plan.time.rpartition(":")[0],
        plan.decimal,
        fields=tuple(map(normal, plan.fields.values())),
    )
    for name, (path, fields) in named.items():
        progress.begin(name)
        if plan.variables is None:
            yield name, fields, partial(raw_files.read, path, wanted)
        else:
            yield from _arrays(name, path, fields, plan.variables, wanted)


def _arrays(
    name: str, path: Path, fields: Fields, pattern: NamePattern, wanted: ReadPlan
) -> Iterator[Source]:
    """The arrays of a file whose names match the pattern, each a recording; a file without one, or
    a name that fits in several ways, is a recording that cannot be read."""
    try:
        held = raw_files.arrays_of(path)
    except FormatError as e:
        return (yield LeftOutFile(name, str(e), broken=True))
    matched = False
    for array in held:
        short = array if "/" in pattern.text else array.rpartition("/")[2]
        at = f"{name} {printable(array)}"
        try:
            found = pattern.read(short)
        except FormatError as e:
            yield LeftOutFile(at, str(e), broken=True)
            continue
        if found is not None:
            matched, plan = True, replace(wanted, variable=array)
            yield at, {**fields, **found}, partial(raw_files.read, path, plan)
    if not matched:
        listed = ", ".join(map(printable, held[:MOST_LISTED])) or "none"
        why = f"has no array of frames that matches --variable {pattern.text!r}; it holds {listed}"
        yield LeftOutFile(name, why, broken=True)


def _recordings(table: Table, name: str, known: Fields, plan: ImportPlan) -> list[Recording]:
    """The recordings in a table; several if a column of --field changes its value."""
    counts, time_s, notes = frames.frames(table, plan)
    counts = number_types.compact(counts)
    parts = frames.fields(table, plan.fields, len(counts))
    made = []
    for part, found in parts:
        at = f"{name} [{part.start + 1}-{part.stop}]" if len(parts) > 1 else name
        times = None if time_s is None else time_s[part]
        said = (*table.notes, *notes)
        made.append(Recording(at, {**known, **found}, counts[part], times, said))
    return made


def _without_copies(
    cuts: Sequence[Cut], left_out: list[LeftOutFile]
) -> tuple[list[Cut], list[str]]:
    """The windows without recordings that repeat the frames of another of their material.

    A copy under another material stays, with a remark: only the user knows which name is wrong.
    """
    kept: list[Cut] = []
    warnings: list[str] = []
    seen: dict[bytes, dict[str, Recording]] = {}
    for cut in cuts:
        one = cut.recording
        same = seen.setdefault(_digest(one.frames), {})
        material = one.fields["material"]
        if material in same:
            why = f"holds the same frames as {same[material].name}, which counts once"
            left_out.append(LeftOutFile(one.name, why))
            continue
        warnings += [
            f"warning: {one.name} holds the same frames as {other.name}, of {name}: "
            "one of the two names is wrong"
            for name, other in same.items()
        ]
        same[material] = one
        kept.append(cut)
    return kept, warnings


def _digest(counts: Array) -> bytes:
    """The SHA-256 of frames as float64, a part at a time."""
    total = hashlib.sha256(repr(counts.shape).encode())
    for first in range(0, len(counts), BATCH):
        total.update(np.ascontiguousarray(counts[first : first + BATCH], np.float64).data)
    return total.digest()


def _cuts(
    recordings: Sequence[Recording], plan: ImportPlan, left_out: list[LeftOutFile]
) -> tuple[list[Cut], float]:
    """The windows of each recording, and their common frame rate in Hz.

    Recordings without a window are added to `left_out`.
    """
    rates = []
    for one in recordings:
        with suppress(FormatError):  # the recording is left out below, with its reason
            rates += [sampling.measured_hz(one.time_s)] if one.time_s is not None else []
    rate_hz = plan.rate_hz or (sampling.nominal_hz(np.array(rates)) if rates else 1.0)
    cuts = []
    for one in recordings:
        try:
            even = one.time_s is not None and sampling.runs(one.frames, one.time_s, rate_hz)
            cut = _cut(one, even or sampling.Runs((one.frames,)), rate_hz, plan)
        except FormatError as e:
            left_out.append(LeftOutFile(one.name, str(e), broken=True))
            continue
        if len(cut.windows):
            cuts.append(cut)
        else:
            left_out.append(LeftOutFile(one.name, cut.notes))
    return cuts, rate_hz


def _cut(one: Recording, runs: sampling.Runs, rate_hz: float, plan: ImportPlan) -> Cut:
    """The windows of a recording; no windows, and the reason in `notes`, if it is too short."""
    window, longest = plan.window.frames(rate_hz), max(runs.parts, key=len)
    if plan.every:
        hop = plan.every.frames(rate_hz)
        ends = ((part, len(part) - window + 1) for part in runs.parts)
        starts = [(part, start) for part, end in ends for start in range(0, end, hop)]
    else:
        starts = [(longest, (len(longest) - window) // 2)] if len(longest) >= window else []
    if not starts:
        between = f" in a row ({runs.gaps} gaps)" if runs.gaps else ""
        why = f"has {len(longest)} frames{between}, but a window needs {window}; see --window"
        why += f" and the unit of --time: {rate_hz:g} Hz" * bool(plan.time)
        return Cut(one, np.empty(0), why)
    windows = _windows(starts, window)
    if runs.interpolated and not (one.frames % 1).any():
        windows = np.rint(windows)  # whole counts stay whole
    if one.frames.dtype.kind in "iu":
        windows = windows.astype(one.frames.dtype, copy=False)
    notes = [*one.notes, *["interpolated onto even times"] * runs.interpolated]
    notes += [f"{runs.gaps} gaps"] * (runs.gaps > 0)
    return Cut(one, windows, ", ".join(notes))


def _windows(starts: Sequence[tuple[Array, int]], window: int) -> Array:
    """The windows [k, T, ...] at these starts; a view of the frames if all are of one array and at
    equal distances."""
    (part, first), hops = starts[0], {b - a for (_, a), (_, b) in pairwise(starts)}
    if len(hops) <= 1 and all(one is part for one, _ in starts):
        every = sliding_window_view(part, window, axis=0)[first :: min(hops, default=1)]
        return np.moveaxis(every[: len(starts)], -1, 1)
    return np.stack([part[start : start + window] for part, start in starts])


def _common_type(cuts: Sequence[Cut], wanted: str, left_out: list[LeftOutFile]) -> tuple[str, str]:
    """The data type of the set, and a sentence that gives the reason.

    It is `wanted` if given, else the type of all recordings, else the first of DATA_TYPES that
    holds all counts. Recordings that do not fit are added to `left_out`.
    """
    if wanted:
        for cut in cuts:
            if why := number_types.why_not(cut.windows, wanted):
                left_out.append(LeftOutFile(cut.recording.name, why, broken=True))
        return wanted, f"counts are {wanted}, as --dtype says"
    recorded = {cut.windows.dtype.name for cut in cuts}
    if len(recorded) == 1 and recorded <= set(DATA_TYPES):
        return recorded.pop(), "counts are as recorded"
    for cut in cuts:
        if all(reasons := [number_types.why_not(cut.windows, name) for name in DATA_TYPES]):
            left_out.append(LeftOutFile(cut.recording.name, reasons[-1], broken=True))
    out = {file.name for file in left_out}
    kept = [cut.windows for cut in cuts if cut.recording.name not in out]
    holds = (d for d in DATA_TYPES if not any(number_types.why_not(w, d) for w in kept))
    name = next(holds, "float32")
    if not kept:
        return name, ""
    low, high = min(windows.min() for windows in kept), max(windows.max() for windows in kept)
    return (
        name,
        f"counts from {low:g} to {high:g} fit {name}; "
        "if the skin announces another type, name it with --dtype",
    )


def _set(
    folder: Path, cuts: list[Cut], rate_hz: float, dtype: str, plan: ImportPlan
) -> tuple[Dataset, list[str]]:
    """All windows as one set, and notes about the units of its groups. `cuts` is emptied."""
    shapes = {cut.windows.shape[2:] for cut in cuts}
    if len(shapes) > 1:
        raise FormatError(
            f"{folder}: frames differ in shape: {sorted(map(list, shapes))}; "
            "import each shape by itself"
        )
    count = [len(cut.windows) for cut in cuts]
    materials = sorted({cut.recording.fields["material"] for cut in cuts})
    numbers = np.array([materials.index(cut.recording.fields["material"]) for cut in cuts])
    groups, units = {"recording": np.repeat(np.arange(len(cuts)), count)}, dict[str, str]()
    for name in plan.names:
        if name != "material":
            texts = [cut.recording.fields[name] for cut in cuts]
            values, unit = group(plan.pattern_of(name), name, texts)
            groups[name] = np.repeat(values, count)
            units |= {name: unit} if unit else {}
    displays = _displays([cut.recording.fields for cut in cuts])
    sweeps = Dataset(
        _moved(cuts, sum(count), dtype),
        np.repeat(numbers, count),
        tuple(materials),
        rate_hz,
        groups,
        str(folder),
        units=units,
        displays={name: texts[0] for name, texts in displays.items() if len(texts) == 1},
    )
    return sweeps, [
        *_alike(materials),
        *(
            f"{text!r} is sent as {name!r}; --rename changes that"
            for name, texts in displays.items()
            for text in texts
        ),
        *(f"{name} is in {unit}, as its name says" for name, unit in units.items()),
    ]


def _alike(materials: Sequence[str]) -> Iterator[str]:
    """Warnings about materials whose names differ in capitals alone."""
    for a, b in combinations(materials, 2):
        if a.lower() == b.lower():
            differ = f"warning: materials {a!r} and {b!r} differ in capitals alone"
            yield f"{differ}; --rename '{a}={b}' joins them"


def _displays(known: Sequence[Fields]) -> dict[str, list[str]]:
    """The names in the files of renamed materials, by the new name."""
    found: dict[str, list[str]] = {}
    for name, text in sorted({(f["material"], f[DISPLAY]) for f in known if DISPLAY in f}):
        found.setdefault(name, []).append(text)
    return found


def _moved(cuts: list[Cut], count: int, dtype: str) -> Array:
    """All windows [count, T, R, C(, A)], from the last on; the memory of each recording is free
    once it is copied."""
    samples, end = np.empty((count, *cuts[0].windows.shape[1:]), dtype), count
    while cuts:
        windows = cuts.pop().windows
        samples[end - len(windows) : end] = windows
        end -= len(windows)
    return samples
