"""Imports a folder of recordings, files of frames x taxels, as a sweep set.

Each file is one recording of one material, and its name says which. Nothing is guessed: a file
with missing or ambiguous information is left out, and the report says why.
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
    """A length of time, in seconds, milliseconds or frames. option: its name in error messages.

    Raises FormatError if the text is not a length.
    """

    text: str
    option: str

    def __post_init__(self) -> None:
        if not (found := LENGTH.fullmatch(self.text)) or not float(found[1] or found[3]):
            raise FormatError(
                f"{self.option} {self.text} cannot be read; "
                "write 2s, 500ms, or a number of frames, 1500"
            )

    def frames(self, rate_hz: float) -> int:
        """The length in frames, at least 1."""
        found = LENGTH.fullmatch(self.text)
        assert found
        if found[3]:
            return int(found[3])
        return max(round(float(found[1]) * rate_hz * (1e-3 if found[2] == "ms" else 1)), 1)


@dataclass(frozen=True)
class ImportPlan:
    """How files become sweeps; each attribute is an option of `palpate-train import`.

    grid: ROWSxCOLUMNS or ROWSxCOLUMNSxAXES, "" if the arrays already have that shape.
    columns: the taxels' columns, "" for all except the time.
    time: COLUMN:UNIT; rate_hz: frames per second. One of the two is needed.
    every: from the start of one window to the start of the next; None takes only the middle
    window.
    dtype: data type of the counts, "" to keep the recorded type.
    variable: the array to read from a file with several.
    transpose: whether files hold taxels x frames.
    renames: new names of materials by their old names.
    Raises FormatError if an option cannot be read.
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
                f"--grid {self.grid} cannot be read; "
                "write ROWSxCOLUMNS or ROWSxCOLUMNSxAXES: 4x4, 4x4x3"
            )
        if not self.time and not self.rate_hz:
            raise FormatError(
                "the frame rate is not known; give --rate HZ, or --time COLUMN:UNIT if a column "
                "holds times"
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
        """Rows, columns, and axes if there are several; () without --grid."""
        rows_columns_axes = tuple(map(int, self.grid.split("x"))) if self.grid else ()
        return rows_columns_axes[:2] if rows_columns_axes[2:] == (1,) else rows_columns_axes


@dataclass(frozen=True)
class Recording:
    """The contents of one file. frames: [n, R, C] or [n, R, C, A], as recorded. time_s: [n], or
    None if the file holds no times."""

    name: str
    fields: Mapping[str, str]
    frames: Array
    time_s: Array | None


@dataclass(frozen=True)
class LeftOut:
    """A file that was not imported. broken: its name matches the pattern, but it cannot be used."""

    name: str
    why: str
    broken: bool = False


@dataclass(frozen=True)
class Cut:
    """Windows [k, T, R, C(, A)] of one recording. notes: how its frames were changed."""

    recording: Recording
    windows: Array
    notes: str


@dataclass(frozen=True)
class Imported:
    """An imported sweep set. taken, left_out: one entry for each file. notes: remarks on the whole
    set."""

    sweeps: Dataset
    taken: Sequence[Cut]
    left_out: Sequence[LeftOut]
    notes: Sequence[str]


def import_folder(
    folder: Path, plan: ImportPlan, log: Callable[[str], None], left_out: list[LeftOut]
) -> Imported:
    """Import all files in and below `folder` whose names match the pattern.

    Files that cannot be imported are added to `left_out` at once, so that the caller can show them
    even after an error. Raises FormatError if the box cannot send a material's name, or if no file
    remains.
    """
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
    cuts = [cut for cut in cuts if cut.recording.name not in {file.name for file in left_out}]
    if not cuts:
        raise FormatError(
            f"{folder}: none of {len(named)} files could be imported; the messages above say why"
        )
    sweeps, notes = _set(folder, cuts, rate_hz, dtype, plan)
    return Imported(sweeps, cuts, left_out, [about, *notes])


def _named(folder: Path, plan: ImportPlan, left_out: list[LeftOut]) -> dict[str, dict[str, str]]:
    """The fields of each file whose name matches the pattern, by its path below `folder`.

    Materials have their new names.
    """
    if not folder.is_dir():
        raise FormatError(f"{folder} is not a folder; name the folder that holds the recordings")
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
                left_out.append(LeftOut(name, "its name does not match the pattern"))
        except FormatError as e:
            left_out.append(LeftOut(name, str(e), broken=True))
    if not found:
        first = f"the first file is {names[0]!r}" if names else "it holds no files"
        raise FormatError(f"{folder}: no file matches --pattern {plan.pattern.text!r}; {first}")
    labels.check_renames(plan.renames, (fields["material"] for fields in found.values()))
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
        raise FormatError(
            f"holds {values.dtype} {list(values.shape)}; give an array of frames x taxels"
        )
    at, time_s = _times(values, table, plan)
    frames = _frames(values, table, plan, at)
    if not np.isfinite(frames).all():
        index = np.argwhere(~np.isfinite(frames))[0]
        taxel = ", ".join(map(str, index[1:] + 1))
        raise FormatError(
            f"frame {index[0] + 1}, taxel {taxel} is {frames[tuple(index)]}; "
            "fill it in or cut it away"
        )
    return Recording(name, fields, frames, time_s)


def _times(values: Array, table: Table, plan: ImportPlan) -> tuple[int | None, Array | None]:
    """The number of the time column, None if `values` has no such column, and the times [n] in
    seconds."""
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
            f"has no times {name!r}; beside the frames it has "
            f"{', '.join(table.vectors) or 'nothing'}"
        )
    (at,) = _columns(name, table.columns, values.shape[1], "--time", 1)
    return at, values[:, at] * sampling.UNITS_S[unit]


def _frames(values: Array, table: Table, plan: ImportPlan, time_column: int | None) -> Array:
    """The counts of the taxels, [n, R, C] or [n, R, C, A]."""
    shape = plan.shape
    if values.ndim > 2:
        if plan.columns or (shape and values.shape[1:] != shape):
            raise FormatError(
                f"holds frames of shape {list(values.shape[1:])}; "
                "leave --columns out, and leave --grid out or give that shape"
            )
        return values
    if not shape:
        raise FormatError(
            f"has {values.shape[1]} columns; give their layout with --grid, e.g. 4x4 for 16 taxels"
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
            f"it has {want} rows, so add --transpose"
            if len(values) == want
            else "see --columns and --grid"
        )
        raise FormatError(
            f"{which} {len(numbers)} columns, but a grid of {plan.grid} needs {want}; {advice}"
        )
    return values[:, numbers].reshape(len(values), *shape)


def _columns(
    text: str, names: Sequence[str], wide: int, option: str, most: int = 1 << 20
) -> list[int]:
    """Column numbers, from 0, for a comma-separated list `text`.

    Each entry is a name, a name with *, a number from 1, or a range such as 2-17.
    """
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
            raise FormatError(f"{option}: there is no column {part!r}; {known}")
    if len(set(found)) < len(found) or len(found) > most:
        raise FormatError(
            f"{option} {text} names {'a column twice' if len(found) <= most else 'several columns'}"
        )
    return found


def _cuts(
    recordings: Sequence[Recording], plan: ImportPlan, left_out: list[LeftOut]
) -> tuple[list[Cut], float]:
    """The windows of each recording, and their common frame rate in Hz.

    Recordings without a window are added to `left_out`.
    """
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
    """The windows of a recording; no windows, and the reason in `notes`, if it is too short."""
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
            f"has {len(longest)} frames{between}, but a window needs {window}; see --window",
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
    """The data type of the set, and a sentence that gives the reason.

    It is `wanted` if given, else the type of all recordings, else the first of DATA_TYPES that
    holds all counts. Recordings that do not fit are added to `left_out`.
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
    out = {file.name for file in left_out}
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
        f"counts from {low:g} to {high:g} fit {name}; "
        "if the skin announces another type, name it with --dtype",
    )


def _why_not(counts: Array, dtype: str) -> str:
    """The reason why a data type cannot hold these counts, or "" if it can.

    float32 may round fractions, but must hold whole numbers exactly.
    """
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
            f"{dtype} would round it; subtract an offset",
        )
    if not bad.any():
        return ""
    value = counts[tuple(np.argwhere(bad)[0])]
    return f"a count is {value:.17g}, and {what}"


def _set(
    folder: Path, cuts: Sequence[Cut], rate_hz: float, dtype: str, plan: ImportPlan
) -> tuple[Dataset, list[str]]:
    """All windows as one set, and notes about the units of its groups."""
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
    for name in plan.pattern.names:
        if name != "material":
            texts = [cut.recording.fields[name] for cut in cuts]
            values, unit = group(plan.pattern, name, texts)
            groups[name] = np.repeat(values, count)
            units |= {name: unit} if unit else {}
    samples = np.concatenate([cut.windows.astype(dtype) for cut in cuts])
    sweeps = Dataset(
        samples,
        np.repeat(numbers, count),
        tuple(materials),
        rate_hz,
        groups,
        str(folder),
        units=units,
    )
    return sweeps, [f"{name} is in {unit}, as its name says" for name, unit in units.items()]
