"""The command import: makes a sweep set of a folder of recordings, and reports on each file."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence

from palpate.core.errors import FormatError
from palpate.core.outputs import Row, add_rows
from palpate.core.storage import put
from palpate.core.text import printable, say
from palpate.core.types import DATA_TYPES
from palpate_train.arguments import options
from palpate_train.arguments.options import FLAG, above_zero, path, text
from palpate_train.arguments.program import Add
from palpate_train.data import label_table, labels, lerobot, summary
from palpate_train.data.file_names import EXAMPLE, GROUP, NamePattern
from palpate_train.data.import_plan import ImportPlan, Length
from palpate_train.data.importing import Imported, LeftOutFile, Taken, check_folder, import_folder

SHOWN = 5
"""Largest number of files with a line each that were left out for the same reason."""

# fmt: off
_OPTIONS: tuple[Row, ...] = (
    ("folder", "the recordings, in all folders below it", path("FOLDER")),
    ("--pattern", f"meaning of the names below FOLDER: {EXAMPLE},"
        " '{material}/{speed}/{}.csv'", text("PATTERN")),
    ("--field", "a column that holds a field of each frame: material=label, session=date",
        text("NAME=COLUMN", action="append", default=[])),
    ("--out", "the sweep set (.npz, .h5)", path("SET", required=True)),
    ("--labels", "a table of the files and their fields; its first line: file,material,position",
        path()),
    ("--report", "a line for each file, imported or not", path()),
    ("--transpose", "arrays are taxels x frames", FLAG),
    ("--grid", "how the columns lie: 4x4, 5x3x3", text("ROWSxCOLUMNS[xAXES]", "")),
    ("--columns", "columns of the taxels, in the grid's order: 2-17, s0,s1, s* (all but the time)",
        text("COLUMNS", "")),
    ("--variable", "the array to read if a file holds several; with a pattern, each that matches is"
        " a recording: '{material}_{trial:d}'", text("NAME", "")),
    ("--axes", "the axes of an array in their order: row,column,frame", text("AXES", "")),
    ("--decimal", "the decimal sign of texts, . or ,", text("SIGN", "")),
    ("--dtype", f"type of the counts: {', '.join(DATA_TYPES)} (as recorded, else the first that"
        " holds all)", text("TYPE", "")),
    ("--time", "the sampling times, in s, ms, us, ns, min, h or d: t:ms, 1:s",
        text("COLUMN:UNIT", "")),
    ("--every", "cut windows from the start on, one each LENGTH (the middle window alone)",
        text("LENGTH", "")),
    above_zero("--rate", "HZ", "frames per second"),
    ("--window", "length of a sweep: 2s, 500ms or 1500 frames (2s)", text("LENGTH", "2s")),
    options.RENAME,
)
# fmt: on


def register(add: Add) -> None:
    """Add the command import."""
    add_rows(add("import", run), *_OPTIONS)


def run(args: argparse.Namespace) -> None:
    """Import a folder, and print the files that were left out and the contents of the set.

    Raises FormatError at the end if a file was broken.
    """
    for option, endings in (("out", options.SET_FILES), ("report", ())):
        if path := getattr(args, option):
            options.writable_file(path, f"--{option}", *endings)
    check_folder(args.folder)
    plan = _plan(args)
    left_out: list[LeftOutFile] = []
    taken: Sequence[Taken] = ()
    try:
        made = import_folder(args.folder, plan, options.Log(), left_out)
        taken = made.taken
        made.sweeps.save(args.out)
    finally:
        say(*_left_out(left_out))
        if args.report:
            put(args.report, _report(taken, left_out).encode(errors="replace"))
    say(*_taken(made), *summary.description(made.sweeps), f"set: {args.out}")
    if broken := sum(one.broken for one in left_out):
        raise FormatError(
            f"{broken} of {broken + len(taken)} files could not be used, as said above; "
            f"{args.out} is of the others"
        )


def _plan(args: argparse.Namespace) -> ImportPlan:
    """The options as a plan. A LeRobot data set states its frame rate."""
    fields = dict(_field(text) for text in args.field)
    rate, table = args.rate, label_table.read(args.labels) if args.labels else {}
    if not args.pattern and (inner := next(args.folder.glob(f"*/{lerobot.INFO}"), None)):
        raise FormatError(
            f"{args.folder}: {inner.parents[1]} in it is a LeRobot data set; name its folder"
        )
    if not (args.pattern or args.time or rate) and lerobot.is_data_set(args.folder):
        rate = lerobot.rate_hz(args.folder, args.variable, "" if args.columns else args.grid)
    return ImportPlan(
        NamePattern(args.pattern) if args.pattern else None,
        args.grid,
        args.columns,
        args.time,
        rate,
        Length(args.window, "--window"),
        Length(args.every, "--every") if args.every else None,
        args.dtype,
        args.variable,
        args.transpose,
        labels.parse_renames(args.rename),
        args.axes,
        args.decimal,
        fields,
        table,
    )


def _field(text: str) -> tuple[str, str]:
    """Name and column of a text NAME=COLUMN."""
    name, separator, column = text.partition("=")
    if not (separator and column and GROUP.fullmatch(name)) or name == "recording":
        raise FormatError(f"--field {text!r} cannot be read; write NAME=COLUMN: material=label")
    return name, column


def _left_out(left_out: Sequence[LeftOutFile]) -> list[str]:
    """A line for each file; with the same reason, only for the first SHOWN files."""
    lines, reasons = [], Counter(one.why for one in left_out)
    seen: Counter[str] = Counter()
    for one in sorted(left_out, key=lambda one: one.name):
        seen[one.why] += 1
        if seen[one.why] <= SHOWN:
            lines.append(f"left out: {one.name}: {one.why}")
        elif seen[one.why] == reasons[one.why]:
            lines.append(
                f"left out: {seen[one.why] - SHOWN} more for the same reason: {one.why}; "
                "--report FILE lists all"
            )
    return lines


def _taken(made: Imported) -> list[str]:
    """How the taken files became sweeps, in lines."""
    lines = [f"taken: {len(made.taken)} files; left out: {len(made.left_out)}"]
    for what in ("interpolated onto even times", "gaps"):
        if n := sum(what in one.notes for one in made.taken):
            lines.append(f"  {n} of them: {what}")
    said = [(one.name, note) for one in made.taken for note in one.said]
    notes = Counter(note for _, note in said)
    for note, n in list(notes.items())[:SHOWN]:
        name = next(name for name, other in said if other == note)
        lines.append(f"  {name}: {note}" + f" ({n} files)" * (n > 1))
    if len(notes) > SHOWN:
        lines.append(f"  {len(notes) - SHOWN} more remarks; --report FILE lists all")
    return [*lines, *(f"  {note}" for note in made.notes)]


def _report(taken: Sequence[Taken], left_out: Sequence[LeftOutFile]) -> str:
    """A line for each file, in the order of their names."""
    lines = {one.name: f"left out: {one.why}" for one in left_out}
    for one in taken:
        notes = f"; {one.notes}" if one.notes else ""
        lines[one.name] = f"taken: {one.windows} windows of {one.frames} frames{notes}"
    return "".join(
        f"{printable(name)}\t{printable(line)}\n" for name, line in sorted(lines.items())
    )
