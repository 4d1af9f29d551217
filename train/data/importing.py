"""Imports a folder of recordings as a sweep set. In: files of frames x taxels, an ImportPlan. Out:
a Dataset and a report.

Each file is one recording of one material; what it is of stands in its name. Nothing is guessed:
what is missing or fits in two ways leaves the file out, and the report says why.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from appliance.core.types import DATA_TYPES
from train.data import labels, raw_files, readers, sampling
from train.data.file_names import NamePattern, group
from train.data.progress import Progress
from train.data.raw_files import Table
from train.data.sets import Dataset

Array = NDArray[Any]
GRID = re.compile(r"[1-9]\d{0,2}x[1-9]\d{0,2}(x[1-8])?")
LENGTH = re.compile(r"(\d+(?:\.\d+)?)(ms|s)|([1-9]\d*)")
RANGE = re.compile(r"([1-9]\d*)(?:-([1-9]\d*))?")


@dataclass(frozen=True)
class Length:
    """A length of time, as seconds or as frames. Raises FormatError where its text is neither."""

    text: str
    option: str

    def __post_init__(self) -> None:
        if not (found := LENGTH.fullmatch(self.text)) or not float(found[1] or found[3]):
            raise FormatError(
                f"{self.option} {self.text} cannot be read; write 2s, 500ms, or a number of frames, 1500"
            )

    def frames(self, rate_hz: float) -> int:
        """In frames, at least one."""
        found = LENGTH.fullmatch(self.text)
        assert found
        if found[3]:
            return int(found[3])
        return max(round(float(found[1]) * rate_hz * (1e-3 if found[2] == "ms" else 1)), 1)


@dataclass(frozen=True)
class ImportPlan:
    """How files become sweeps. grid: ROWSxCOLUMNS or ROWSxCOLUMNSxAXES, "" where arrays have that
    shape. columns: those of the taxels, "" for all but the time. time: COLUMN:UNIT, rate_hz: frames
    per second; one of them is needed.

    every: from the start of one window to that of the next, None for the middle window alone.
    dtype: of the counts, "" as recorded. variable, transpose: for files of several arrays, and
    arrays of taxels x frames. renames: materials. Raises FormatError where an option cannot be
    read.
    """

    pattern: NamePattern
    grid: str = ""
    columns: str = ""
    time: str = ""
    rate_hz: float | None = None
    window: Length = Length("2s", "--window")
    every: Length | None = None
    dtype: str = ""
    variable: str = ""
    transpose: bool = False
    renames: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.grid and not GRID.fullmatch(self.grid):
            raise FormatError(
                f"--grid {self.grid} cannot be read; write ROWSxCOLUMNS or ROWSxCOLUMNSxAXES: 4x4, 4x4x3"
            )
        if not self.time and not self.rate_hz:
            raise FormatError(
                "how fast frames follow is not known; give --rate HZ, or --time COLUMN:UNIT where a column holds times"
            )
        if self.time and self.time.rpartition(":")[2] not in sampling.UNITS_S:
            raise FormatError(
                f"--time {self.time} names no unit; write {self.time}:s, :ms, :us or :ns"
            )
        if self.dtype and self.dtype not in DATA_TYPES:
            raise FormatError(
                f"--dtype {self.dtype} is unknown; use one of {', '.join(DATA_TYPES)}"
            )

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, columns, and axes where there are several; () where --grid is not given."""
        rows_columns_axes = tuple(map(int, self.grid.split("x"))) if self.grid else ()
        return rows_columns_axes[:2] if rows_columns_axes[2:] == (1,) else rows_columns_axes


@dataclass(frozen=True)
class Recording:
    """One file as it was read. frames: [n, R, C] or [n, R, C, A] as recorded; time_s: [n], or None
    where it has none."""

    name: str
    fields: Mapping[str, str]
    frames: Array
    time_s: Array | None


@dataclass(frozen=True)
class LeftOut:
    """A file that was not taken. broken: it fits the pattern, but cannot be used."""

    name: str
    why: str
    broken: bool = False


@dataclass(frozen=True)
class Cut:
    """Windows [k, T, R, C(, A)] of one recording, and what was done to it."""

    recording: Recording
    windows: Array
    notes: str


@dataclass(frozen=True)
class Imported:
    """A sweep set and how it came about. taken, left_out: by file. notes: what holds for the whole
    set."""

    sweeps: Dataset
    taken: Sequence[Cut]
    left_out: Sequence[LeftOut]
    notes: Sequence[str]


def import_folder(
    folder: Path, plan: ImportPlan, log: Callable[[str], None], left_out: list[LeftOut]
) -> Imported:
    """The set of all files in `folder` and below whose names fit the pattern; files that are left
    out are added to `left_out` as they are found. Raises FormatError where materials cannot be sent
    or nothing is left."""
    named = _named(folder, plan, left_out)
    recordings, progress = [], Progress(len(named), log)
    for name, fields in named.items():
        progress.begin(name)
        try:
            recordings.append(_recording(folder / name, name, fields, plan))
        except FormatError as e:
            left_out.append(LeftOut(name, str(e), broken=True))
    cuts, rate_hz = _cuts(recordings, plan, left_out)
    dtype, about = _common_type(cuts, plan.dtype, left_out)
    cuts = [cut for cut in cuts if cut.recording.name not in {one.name for one in left_out}]
    if not cuts:
        raise FormatError(
            f"{folder}: none of {len(named)} files could be taken; the lines above say why"
        )
    sweeps, notes = _set(folder, cuts, rate_hz, dtype, plan)
    return Imported(sweeps, cuts, left_out, [about, *notes])


def _named(folder: Path, plan: ImportPlan, left_out: list[LeftOut]) -> dict[str, dict[str, str]]:
    """The fields of each file whose name fits the pattern, by its path below `folder`; materials
    are renamed."""
    if not folder.is_dir():
        raise FormatError(f"{folder} is no folder; name one that holds the recordings")
    readers.check_folder(folder)
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    names = [
        name for path in paths if not (name := path.relative_to(folder).as_posix()).startswith(".")
    ]
    found: dict[str, dict[str, str]] = {}
    for name in names:
        try:
            if fields := plan.pattern.read(name):
                found[name] = fields
            else:
                left_out.append(LeftOut(name, "its name does not fit the pattern"))
        except FormatError as e:
            left_out.append(LeftOut(name, str(e), broken=True))
    if not found:
        first = f"the first is {names[0]!r}" if names else "it holds none"
        raise FormatError(f"{folder}: no file fits --pattern {plan.pattern.text!r}; {first}")
    labels.check_known(plan.renames, (fields["material"] for fields in found.values()))
    for fields in found.values():
        fields["material"] = plan.renames.get(fields["material"], fields["material"])
    if why := labels.unsendable(sorted({fields["material"] for fields in found.values()})):
        raise FormatError(f"{folder}: {why}; {labels.REMEDY}")
    return found


def _recording(path: Path, name: str, fields: Mapping[str, str], plan: ImportPlan) -> Recording:
    table = raw_files.read(path, plan.variable)
    values = table.values.T if plan.transpose else table.values
    if values.dtype.kind == "b":
        values = values.astype(np.uint8)
    if values.dtype.kind not in "iuf" or values.ndim < 2 or not values.size:
        raise FormatError(f"holds {values.dtype} {list(values.shape)}; frames x taxels are wanted")
    at, time_s = _times(values, table, plan)
    frames = _frames(values, table, plan, at)
    if not np.isfinite(frames).all():
        place = np.argwhere(~np.isfinite(frames))[0]
        where = ", ".join(map(str, place[1:] + 1))
        raise FormatError(
            f"frame {place[0] + 1}, taxel {where} is {frames[tuple(place)]}; fill it in or cut it away"
        )
    return Recording(name, fields, frames, time_s)


def _times(values: Array, table: Table, plan: ImportPlan) -> tuple[int | None, Array | None]:
    """The number of the time column, where it is one of `values`, and the times [n] in seconds."""
    if not plan.time:
        return None, None
    name, _, unit = plan.time.rpartition(":")
    if name in table.vectors:
        time_s = table.vectors[name] * sampling.UNITS_S[unit]
        if len(time_s) != len(values):
            raise FormatError(f"{name} holds {len(time_s)} times, there are {len(values)} frames")
        return None, time_s
    if values.ndim != 2:
        raise FormatError(
            f"has no times {name!r}; beside the frames it has {', '.join(table.vectors) or 'nothing'}"
        )
    (at,) = _columns(name, table.columns, values.shape[1], "--time", 1)
    return at, values[:, at] * sampling.UNITS_S[unit]


def _frames(values: Array, table: Table, plan: ImportPlan, time_column: int | None) -> Array:
    """The counts of the taxels, [n, R, C] or [n, R, C, A]."""
    shape = plan.shape
    if values.ndim > 2:
        if plan.columns or (shape and values.shape[1:] != shape):
            raise FormatError(
                f"holds frames {list(values.shape[1:])}; leave --columns out, and --grid or give that one"
            )
        return values
    if not shape:
        raise FormatError(
            f"has {values.shape[1]} columns; say with --grid how they lie, e.g. 4x4 for 16 taxels"
        )
    wide, want = values.shape[1], int(np.prod(shape))
    if plan.columns:
        numbers = _columns(plan.columns, table.columns, wide, "--columns")
    else:
        numbers = [i for i in range(wide) if i != time_column]
    if len(numbers) != want:
        which = (
            "--columns names"
            if plan.columns
            else "it has"
            if time_column is None
            else "beside the time it has"
        )
        advice = (
            "it has so many rows, so add --transpose"
            if len(values) == want
            else "see --columns and --grid"
        )
        raise FormatError(
            f"{which} {len(numbers)} columns, a grid of {plan.grid} takes {want}; {advice}"
        )
    return values[:, numbers].reshape(len(values), *shape)


def _columns(
    text: str, names: Sequence[str], wide: int, option: str, most: int = 1 << 20
) -> list[int]:
    """The numbers, from 0 on, of columns given by name, by a name with * in it, by number from 1
    on, or as 2-17."""
    found: list[int] = []
    for part in (text,) if text in names else text.split(","):
        if part in names:
            found.append(names.index(part))
        elif number := RANGE.fullmatch(part):
            first, last = int(number[1]), int(number[2] or number[1])
            if not first <= last <= wide:
                raise FormatError(f"{option} {part}: it has {wide} columns")
            found += range(first - 1, last)
        elif matching := [
            i for i, name in enumerate(names) if "*" in part and fnmatchcase(name, part)
        ]:
            found += matching
        else:
            known = (
                f"its columns are {', '.join(names)}"
                if names
                else f"its {wide} columns have no names: use numbers"
            )
            raise FormatError(f"{option}: no column is called {part!r}; {known}")
    if len(set(found)) < len(found) or len(found) > most:
        raise FormatError(
            f"{option} {text} names {'a column twice' if len(found) <= most else 'several columns'}"
        )
    return found


def _cuts(
    recordings: Sequence[Recording], plan: ImportPlan, left_out: list[LeftOut]
) -> tuple[list[Cut], float]:
    """The windows of each recording, and the rate of all. Recordings that give none are left
    out."""
    rates = []
    for one in list(recordings):
        try:
            rates += [sampling.measured_hz(one.time_s)] if one.time_s is not None else []
        except FormatError:
            continue  # the recording is left out below, with its reason
    rate_hz = plan.rate_hz or (sampling.nominal_hz(np.array(rates)) if rates else 1.0)
    cuts = []
    for one in recordings:
        try:
            even = one.time_s is not None and sampling.runs(one.frames, one.time_s, rate_hz)
            cuts.append(_cut(one, even or sampling.Runs((one.frames,)), rate_hz, plan))
        except FormatError as e:
            left_out.append(LeftOut(one.name, str(e), broken=True))
    for cut in [cut for cut in cuts if not len(cut.windows)]:
        left_out.append(LeftOut(cut.recording.name, cut.notes))
        cuts.remove(cut)
    return cuts, rate_hz


def _cut(one: Recording, runs: sampling.Runs, rate_hz: float, plan: ImportPlan) -> Cut:
    """The windows of a recording; none, with the reason, where it is too short."""
    window, longest = plan.window.frames(rate_hz), max(runs.parts, key=len)
    if plan.every:
        hop = plan.every.frames(rate_hz)
        starts = [
            (part, start) for part in runs.parts for start in range(0, len(part) - window + 1, hop)
        ]
    else:
        starts = [(longest, (len(longest) - window) // 2)] if len(longest) >= window else []
    if not starts:
        between = f" in a row ({runs.gaps} gaps)" if runs.gaps else ""
        return Cut(
            one,
            np.empty(0),
            f"has {len(longest)} frames{between}, a window takes {window}; see --window",
        )
    windows = np.stack([part[start : start + window] for part, start in starts])
    if runs.interpolated and not (one.frames % 1).any():
        windows = np.rint(windows)  # whole counts stay whole
    if one.frames.dtype.kind in "iu":
        windows = windows.astype(one.frames.dtype)
    notes = ["interpolated onto even times"] * runs.interpolated + [f"{runs.gaps} gaps"] * (
        runs.gaps > 0
    )
    return Cut(one, windows, ", ".join(notes))


def _common_type(cuts: Sequence[Cut], wanted: str, left_out: list[LeftOut]) -> tuple[str, str]:
    """The data type of the set, and a line that says why: that of all recordings, else the first
    that holds all counts.

    Recordings that the type `wanted` cannot hold are left out.
    """
    if wanted:
        for cut in cuts:
            if why := _why_not(cut.windows, wanted):
                left_out.append(LeftOut(cut.recording.name, why, broken=True))
        return wanted, f"counts are {wanted}, as --dtype says"
    recorded = {cut.windows.dtype.name for cut in cuts}
    if len(recorded) == 1 and recorded <= set(DATA_TYPES):
        return recorded.pop(), "counts are as recorded"
    for cut in cuts:
        if all(reasons := [_why_not(cut.windows, name) for name in DATA_TYPES]):
            left_out.append(LeftOut(cut.recording.name, reasons[-1], broken=True))
    out = {one.name for one in left_out}
    kept = [cut.windows for cut in cuts if cut.recording.name not in out]
    name = next(
        (name for name in DATA_TYPES if not any(_why_not(windows, name) for windows in kept)),
        "float32",
    )
    if not kept:
        return name, ""
    low, high = min(windows.min() for windows in kept), max(windows.max() for windows in kept)
    return (
        name,
        f"counts from {low:g} to {high:g} fit {name}; if the skin announces another type, name it with --dtype",
    )


def _why_not(counts: Array, dtype: str) -> str:
    """Why a data type cannot hold these counts, "" where it can; float32 rounds fractions, but no
    whole number."""
    kind = np.dtype(dtype)
    low, high = (
        (-np.finfo(kind).max, np.finfo(kind).max)
        if kind.kind == "f"
        else (np.iinfo(kind).min, np.iinfo(kind).max)
    )
    bad = (counts < low) | (counts > high)
    what = f"{dtype} holds {low:g} to {high:g}"
    if not bad.any() and kind.kind != "f":
        bad, what = counts % 1 != 0, f"{dtype} holds whole numbers"
    elif not bad.any():
        bad, what = (
            (counts % 1 == 0) & (counts.astype(kind) != counts),
            f"{dtype} would round it; take an offset away",
        )
    if not bad.any():
        return ""
    value = counts[tuple(np.argwhere(bad)[0])]
    return f"a count is {value:.17g}, and {what}"


def _set(
    folder: Path, cuts: Sequence[Cut], rate_hz: float, dtype: str, plan: ImportPlan
) -> tuple[Dataset, list[str]]:
    """All windows as one set, and what the numbers of its groups stand for."""
    shapes = {cut.windows.shape[2:] for cut in cuts}
    if len(shapes) > 1:
        raise FormatError(
            f"{folder}: frames differ in shape: {sorted(map(list, shapes))}; import each kind by itself"
        )
    count = [len(cut.windows) for cut in cuts]
    materials = sorted({cut.recording.fields["material"] for cut in cuts})
    numbers = np.array([materials.index(cut.recording.fields["material"]) for cut in cuts])
    groups, notes = {"recording": np.repeat(np.arange(len(cuts)), count)}, []
    for name in plan.pattern.names:
        if name != "material":
            values, meaning = group([cut.recording.fields[name] for cut in cuts])
            groups[name] = np.repeat(values, count)
            notes += [f"{name}: {meaning}"] if meaning else []
    samples = np.concatenate([cut.windows.astype(dtype) for cut in cuts])
    sweeps = Dataset(
        samples, np.repeat(numbers, count), tuple(materials), rate_hz, groups, str(folder)
    )
    return sweeps, notes
