"""Reads text with one frame on each line: CSV and its kin, R's tables, LabVIEW's .lvm.

NumPy and the csv module parse lines and cells. This module decides which lines are frames and which
column is text. A cell that is not a number is never skipped: it is kept as a fault of its column.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.files import plain_lines
from palpate_train.data.files.decimals import decimal_sign, is_number, plain
from palpate_train.data.files.plain_lines import SAMPLED
from palpate_train.data.files.table import Array, ReadPlan, Table, excerpt, normal

COMMENTS = ("#", "%", "//")
DELIMITERS = ("\t", ";", "|", ",", None)
"""What can separate columns. Without any of the signs, blanks do."""
SHEET_ERROR = re.compile(r"[\"']?#(N/A|N/V|NV|[A-ZÄÖÜ0-9/]+[!?])")
"""How spreadsheets write a cell without a value. It is not a comment."""
MISSING = {
    *("", "na", "n/a", "n.a.", "null", "none", "-", "--", "?", "nil", "err", "error"),
    *("missing", "invalid", "overflow", "ovf", "overrange", "sat"),
}
UNIT = re.compile(
    r"[\[(].*[\])]|[kmuµn]?(s|sec|V|N|A|Pa|g|m|T)|%|°C|bar|psi|counts?|raw|lsb|digits?|a\.?u\.?|-?",
    re.IGNORECASE,
)
QUANTITY = re.compile(r"[-+]?\d[\d.,]*\s*(?:[kmuµn]?(?:s|sec|V|N|A|Pa|g|m|Hz)|%)")
"""A number with its unit, as in the rows of ranges below names."""
LEAST_COUNTED = 8
"""From more numbers 1, 2, 3 ..., or other even steps, a line is no frame, whatever the frames are
like."""
CLEAR = 0.9
"""A sign separates the columns if the share of numbers between it is this part of the largest."""
NO_NUMBERS = "holds no line of numbers"
HEAD = 4096
"""Number of bytes at the start that show whether a file is a text."""
_CONTROL = re.compile(rb"[^\t\n\f\r\x1a\x1b\x20-\xff]")
LVM = "LabVIEW Measurement"
LVM_END = "***End_of_Header***"
Row = tuple[int, str]


def decoded(data: bytes) -> tuple[str, list[str]]:
    """The text, and remarks on bytes that were dropped at its end."""
    notes: list[str] = []
    if wide := _wide(data):
        return data.decode(wide, "replace").lstrip("\ufeff"), notes
    head = data[:HEAD].rstrip(b"\0")
    if len(_CONTROL.findall(head)) * 100 > len(head):
        raise FormatError("is not a text, and of no known kind; export it as CSV, HDF5 or .npy")
    whole = data.rstrip(b"\0\x1a")
    if lost := len(data) - len(whole):
        notes.append(f"read up to {lost} bytes NUL at its end")
    try:
        return whole.decode("utf-8-sig"), notes
    except UnicodeDecodeError:
        return whole.decode("cp1252", "replace"), notes


def _wide(data: bytes) -> str:
    """The encoding of a text of two or four bytes a character, "" for another: a mark at its
    beginning shows it, or the zeros between its characters."""
    if data.startswith((b"\xff\xfe\0\0", b"\0\0\xfe\xff")):
        return "utf-32"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    head = data[:400]
    for encoding, zeros, others in (
        ("utf-16-le", head[1::2], head[::2]),
        ("utf-16-be", head[::2], head[1::2]),
    ):
        if len(zeros) > 8 and not any(zeros) and all(others):
            return encoding
    return ""


def lines_of(text: str) -> list[str]:
    """The lines of a text, in the order of their numbers."""
    return re.split(r"\r\n|\n|\r", text.replace("\r\r\n", "\n"))


@dataclass(frozen=True)
class Layout:
    """How the lines of a text divide into cells. text_columns: columns that hold words in most
    lines."""

    delimiter: str | None
    wide: int
    text_columns: frozenset[int]

    def cells(self, line: str) -> list[str]:
        found = cells(line, self.delimiter)
        return found[:-1] if len(found) == self.wide + 1 and not found[-1].strip() else found

    def is_frame(self, line: str) -> bool:
        """Whether at least half of the columns of numbers hold one."""
        found = self.cells(line)
        given = [is_number(found[i]) for i in self.numbers] if len(found) == self.wide else []
        return sum(given) * 2 >= len(given) > 0

    @property
    def numbers(self) -> list[int]:
        return [i for i in range(self.wide) if i not in self.text_columns]


def table(
    lines: Sequence[str],
    wanted: ReadPlan,
    notes: Sequence[str] = (),
    delimiter: str = "",
    decimal: str = "",
) -> Table:
    """The table in the lines of a text. delimiter, decimal: "" if the text must show them."""
    decimal = wanted.decimal or decimal
    labels: tuple[str, ...] = ()
    decorations: Sequence[str] = ()
    if not (lines and lines[0].startswith(LVM)):
        lines, labels, decorations = plain_lines.plain(lines)
    numbered, names, decimal = _labview(lines, decimal)
    kept = [(i, line) for i, line in numbered if line.strip()]
    layout = _layout(kept, delimiter)
    start, end = _body(kept, layout)
    said = [*notes, *decorations, *_passed_over(kept[:start], layout)]
    said += _remarks(kept, start, end, layout)
    rows = [  # a frame that begins with # is no comment
        (i, line)
        for i, line in kept[start:end]
        if not _marked(line) or len(layout.cells(line)) == layout.wide
    ]
    if between := end - start - len(rows):
        said.append(f"{between} comments between its frames are passed over")
    decimal = decimal or decimal_sign(rows, layout.delimiter, layout.cells)
    named = len(labels) == layout.wide
    asked = (wanted.time, *wanted.fields)
    names = names or (labels if named else _heads(kept[:start], layout, asked))
    names, label = _row_names(names, rows, layout)
    layout = Layout(layout.delimiter, layout.wide, layout.text_columns | label)
    whole = _plain_numbers(rows, layout, decimal)
    if whole is not None:
        return Table(whole, names, notes=tuple(said))
    values, texts, faults = _columns(rows, layout, decimal)
    return Table(values, names, texts=texts, faults=faults, notes=tuple(said))


def cells(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line. delimiter: None separates at blanks. Raises FormatError for a cell that
    is too long."""
    if delimiter is None and '"' not in line:
        return line.split()
    blanks = delimiter is None
    try:
        return next(
            csv.reader(
                [line.replace("\t", " ").strip() if blanks else line],
                delimiter=delimiter or " ",
                skipinitialspace=blanks,
            ),
            [],
        )
    except csv.Error as e:
        raise FormatError(f"the line {excerpt(line)} cannot be divided into cells: {e}") from e


def _labview(lines: Sequence[str], decimal: str) -> tuple[list[Row], tuple[str, ...], str]:
    """The numbered lines after the headers of an .lvm file, the names of its columns and its
    decimal sign; all lines of another text."""
    rows = list(enumerate(lines, 1))
    if not lines or not lines[0].startswith(LVM):
        return rows, (), decimal
    ends = [i for i, line in rows if line.startswith(LVM_END)]
    head = dict(cells(line, "\t")[:2] for line in lines[: ends[0] if ends else 0] if "\t" in line)
    delimiter = "," if head.get("Separator") == "Comma" else "\t"
    segments = [i for i in ends if any(x.strip() for x in lines[i : i + 1])]
    if len(ends) > 2 and len(segments) > 1:
        raise FormatError(
            f"holds {len(segments)} segments, the second after line {segments[1]}; "
            "save each as a file"
        )
    if not ends:
        raise FormatError(f"has no line {LVM_END}; export it again")
    names = [name.strip() for name in cells(lines[ends[-1]], delimiter)]
    names = names[:-1] if names[-1] in ("Comment", "") else names
    return rows[ends[-1] + 1 :], tuple(names), decimal or head.get("Decimal_Separator", "")


def _layout(kept: Sequence[Row], delimiter: str) -> Layout:
    """The layout that most lines at the start and the end share."""
    sample = [line for _, line in (*kept[:SAMPLED], *kept[max(SAMPLED, len(kept) - SAMPLED) :])]
    sample = [line for line in sample if not _marked(line)]
    ways = (delimiter,) if delimiter else DELIMITERS
    shares = {way: sum(_share(line, way) for line in sample) for way in ways}
    best = next(way for way, share in shares.items() if share >= CLEAR * max(shares.values()))
    found = [cells(line, best) for line in sample if _share(line, best)]
    if not found:
        raise no_numbers(kept)
    counts = Counter(map(len, found))
    wide = max(counts, key=lambda n: (counts[n], n))
    # the last column may be empty in most lines, but not in all
    if not any(len(row) == wide and row[-1].strip() for row in found):
        found = list(map(_trimmed, found))
        counts = Counter(map(len, found))
        wide = max(counts, key=lambda n: (counts[n], n))
    lines = [row for row in found if len(row) == wide][-SAMPLED:]
    words = frozenset(
        i
        for i in range(wide)
        if 2 * sum(not is_number(r[i]) and r[i].strip().lower() not in MISSING for r in lines)
        > len(lines)
    )
    return Layout(best, wide, words)


def _share(line: str, delimiter: str | None) -> float:
    """The share of a line's cells that are numbers, 0 if it lacks the delimiter."""
    if delimiter and delimiter not in line:
        return 0.0
    try:
        found = _trimmed(cells(line, delimiter))
    except FormatError:
        return 0.0
    return sum(map(is_number, found)) / max(len(found), 1)


def _bare(cell: str) -> str:
    return cell.strip().strip("\"'")


def _trimmed(found: list[str]) -> list[str]:
    return found[:-1] if len(found) > 1 and not found[-1].strip() else found


def _marked(line: str) -> bool:
    """Whether a line begins as a comment; the error of a spreadsheet does not."""
    line = line.lstrip()
    return line.startswith(COMMENTS) and not SHEET_ERROR.match(line)


def _body(kept: Sequence[Row], layout: Layout) -> tuple[int, int]:
    """The first frame and the end of the frames among the lines that are not blank."""
    last = len(kept) - 1
    start = next(
        (
            k
            for k, (_, line) in enumerate(kept)
            if not _marked(line)
            and layout.is_frame(line)
            and not _counts_columns(kept[k : k + SAMPLED], layout)
            and not _is_summary(layout.cells(line), layout)
            and not _counts_frames(layout.cells(line), len(kept) - k - 1)
            and not _untimed(*(layout.cells(one) for _, one in (kept[k], kept[min(k + 1, last)])))
        ),
        len(kept),
    )
    if start == len(kept):
        raise no_numbers(kept)
    end = len(kept)
    while end > start + 1 and _is_footer(kept[end - 2 : end], layout, end == len(kept)):
        end -= 1
    return start, end


def _counts_columns(lines: Sequence[Row], layout: Layout) -> bool:
    """Whether the first of these lines is a head that counts its columns: time,1,2,3, or ,0,1,2,3
    of pandas. If all frames begin with a word, it has LEAST_COUNTED numbers; without a word, these
    or numbers that its columns do not reach below. If the line below begins alike, it is a frame.
    """
    first, below = (list(map(_bare, layout.cells(line))) for _, line in (lines[0], lines[:2][-1]))
    long = layout.wide > LEAST_COUNTED
    if is_number(first[0]):
        apart = long or (len(first) > 2 and first[0] in ("0", "1") and _stands_out(lines, layout))
        return apart and _is_count(first) and not _is_count(below)
    clear = long or (0 not in layout.text_columns and first[1] in ("0", "1"))
    return clear and _is_count(first[1:]) and first[0] != below[0]


def _stands_out(lines: Sequence[Row], layout: Layout) -> bool:
    """Whether each number of the first line lies outside of the range of those below it."""
    rows = [[_bare(c) for c in layout.cells(line)] for _, line in lines if layout.is_frame(line)]
    whole = [row for row in rows if all(map(is_number, row))]
    values = np.array([[float(plain(cell, ".")) for cell in row] for row in whole])
    below = values[1:]
    return bool(len(below) and ((values[0] < below.min(0)) | (values[0] > below.max(0))).all())


def _is_count(found: Sequence[str]) -> bool:
    """Whether cells are numbers that rise by one each; more of them may have other even steps, or
    the steps of rows and columns: 11, 12, 13, 14, 21, 22 ..."""
    if len(found) < 2 or not all(map(is_number, found)):
        return False
    counts = np.array([float(plain(cell, ".")) for cell in found])
    steps = np.round(np.diff(counts), 6)
    if len(found) < LEAST_COUNTED:
        return bool((steps == 1).all())
    wide = next((k for k, step in enumerate(steps, 1) if step != steps[0]), len(counts))
    if not steps[0] or wide < 2 or len(counts) % wide:
        return False
    rows = np.round(np.diff(counts.reshape(-1, wide), axis=0), 6)
    return bool((rows == rows[:1, :1]).all())


def _counts_frames(found: Sequence[str], frames: int) -> bool:
    """Whether each cell is the number of the frames below, as BIOPAC writes it."""
    return frames > 1 and {cell.strip() for cell in _trimmed(list(found))} == {str(frames)}


def _is_summary(found: Sequence[str], layout: Layout, at: int = 0) -> bool:
    """Whether a line has a word where all frames have a number, such as Mean, SD, 75% or Max. at:
    the column, its first one or its last one."""
    cell = _bare(found[at]).lstrip("#%/ ")
    word = any(map(str.isalpha, cell)) or cell.endswith("%")
    word = word and not is_number(cell) and cell.lower() not in MISSING
    word = word and not SHEET_ERROR.match(found[at].strip())
    return word and at % layout.wide not in layout.text_columns and layout.wide > 1


def _untimed(found: Sequence[str], beside: Sequence[str]) -> bool:
    """Whether a line lacks the first number, which the line next to it has."""
    return not found[0].strip() and is_number(beside[0])


def no_numbers(kept: Sequence[Row]) -> FormatError:
    """The error about a text without frames."""
    if not kept:
        return FormatError(f"{NO_NUMBERS}: it is empty; export it again, with values")
    i, line = kept[len(kept) // 2]
    return FormatError(
        f"{NO_NUMBERS}, and line {i} is {excerpt(line.strip())}; write a row of numbers for each "
        "frame, with commas, semicolons, tabs or blanks between them"
    )


def _is_footer(pair: Sequence[Row], layout: Layout, last: bool) -> bool:
    """Whether the second of two lines after the frames is text, a comment or, as the last one, cut
    off. Cells that are empty in both belong to a slower channel that has ended."""
    (_, above), (_, line) = pair
    if _marked(line) and not _is_summary(layout.cells(line), layout):
        return len(layout.cells(line)) != layout.wide or not layout.is_frame(line)
    whole, before = layout.cells(line), layout.cells(above)
    if len(whole) == len(before) == layout.wide and not (before[-1] + whole[-1]).strip():
        return not layout.is_frame(line)
    found = _trimmed(whole)
    given = [is_number(cell) for cell in found]
    complete = len(found) == layout.wide and all(given[1:])
    if complete and (_is_summary(found, layout) or _untimed(found, before)):
        return True
    if len(found) == len(before) and all(given[:-1]) and is_number(before[-1]):
        return _is_summary(found, layout, -1) and len(found[-1].strip()) > 1
    if len(found) < layout.wide and (last or not all(given)):
        return True
    return len(found) != layout.wide and not any(given)


def _passed_over(before: Sequence[Row], layout: Layout) -> list[str]:
    """A remark on rows of numbers before the frames, unless these are names."""
    found = [(i, layout.cells(line)) for i, line in before if not _marked(line)]
    rows = [
        (i, cells[0])
        for i, cells in found
        if len(cells) == layout.wide
        and all(map(is_number, cells[1:]))
        and (is_number(cells[0]) or not _is_count(cells[1:]))
    ]
    return [f"line {i}, {excerpt(word.strip())}, is passed over" for i, word in rows]


def _remarks(kept: Sequence[Row], start: int, end: int, layout: Layout) -> list[str]:
    """Remarks on the lines after the frames."""
    rest = [(i, line) for i, line in kept[end:] if not _marked(line)]
    if not rest:
        return []
    i, line = rest[0]
    found = _trimmed(layout.cells(line))
    if len(rest) == 1 and len(found) < layout.wide and is_number(found[0]):
        return [f"read up to line {i}, which is cut off: {len(found)} of {layout.wide} columns"]
    return [f"read up to line {i}, which is {excerpt(line.strip())}"]


def _heads(before: Sequence[Row], layout: Layout, asked: Sequence[str]) -> tuple[str, ...]:
    """The names of the columns: the cells of the last line before the frames that has as many, or
    one fewer as in R. Lines of units and of numbers behind a word are passed over, and those
    without the names `asked` if a line has them."""
    comments = [line.lstrip("#% ") for _, line in before if _marked(line)]
    others = [line for _, line in before if not _marked(line)]
    for wide in (layout.wide, layout.wide - 1):
        for group in (others, comments):
            heads = [list(map(_bare, cells(line, layout.delimiter))) for line in group]
            heads = [h[:-1] if len(h) == wide + 1 and not h[-1] else h for h in heads]
            heads = [h for h in heads if len(h) == wide and not all(map(is_number, h))]
            heads = [h for h in heads if not all(map(QUANTITY.fullmatch, h[1:]))] or heads
            heads = [h for h in heads if not all(map(UNIT.fullmatch, h))] or heads
            heads = [h for h in heads if not all(map(is_number, h[1:]))] or heads
            heads = [
                h for h in heads if {*map(normal, h)}.intersection(filter(None, asked))
            ] or heads
            # ranges, gains and types repeat
            if named := [h for h in heads if len({*h}) == len(h)] or heads:
                return tuple(map(normal, named[-1]))
    return ()


def _row_names(
    names: tuple[str, ...], rows: Sequence[Row], layout: Layout
) -> tuple[tuple[str, ...], frozenset[int]]:
    """The names of all columns, and column 0 if it labels or counts the rows: R and pandas write
    such a column, without a name."""
    if len(names) == layout.wide - 1:
        names = ("", *names)
    elif not names or names[0] not in ("", "Unnamed: 0"):
        return names, frozenset()
    first = [layout.cells(line)[0].strip() for _, line in rows]
    quoted = all(line.lstrip().startswith('"') for _, line in rows)
    running = all(cell.isdecimal() for cell in first) and all(
        int(b) - int(a) == 1 for a, b in pairwise(first)
    )
    if quoted or running or 0 in layout.text_columns:
        return names, frozenset({0})
    return (names if names[0] else ()) if len(names) != layout.wide else names, frozenset()


def _plain_numbers(rows: Sequence[Row], layout: Layout, decimal: str) -> Array | None:
    """float64 [rows, columns] if every cell is a number, else None."""
    if layout.text_columns:
        return None
    lines = [line for _, line in rows]
    if layout.delimiter != "," and (decimal == "," or any("," in line for line in lines)):
        if not all(is_number(cell, decimal) for line in lines for cell in layout.cells(line)):
            return None
        lines = [plain(line, decimal) for line in lines]
    if layout.delimiter and all(line.rstrip(" ").endswith(layout.delimiter) for line in lines):
        lines = [line.rstrip(" ")[:-1] for line in lines]
    try:
        values = np.loadtxt(
            lines, np.float64, comments=None, delimiter=layout.delimiter, ndmin=2, quotechar='"'
        )
    except ValueError:
        return None
    return values if values.shape == (len(rows), layout.wide) else None


def _columns(
    rows: Sequence[Row], layout: Layout, decimal: str
) -> tuple[Array, dict[int, list[str]], dict[int, str]]:
    """The numbers, the text columns and the faults of the other columns. Raises FormatError if a
    line has another number of columns."""
    found = []
    for i, line in rows:
        try:
            found.append(layout.cells(line))
        except FormatError as e:
            raise FormatError(f"line {i}: {e}") from e
        if len(found[-1]) != layout.wide:
            raise FormatError(
                f"line {i} has {len(found[-1])} columns, line {rows[0][0]} has {layout.wide}; "
                "write one row for each frame"
            )
        if _is_summary(found[-1], layout) and all(
            map(is_number, (found[0][0], *(found[-1][c] for c in layout.numbers[1:])))
        ):
            raise FormatError(
                f"line {i} begins with {excerpt(found[-1][0])}, where other lines have a number; "
                "leave it out"
            )
    values = np.full((len(rows), layout.wide), math.nan)
    texts: dict[int, list[str]] = {}
    faults: dict[int, str] = {}
    for c in range(layout.wide):
        column = [row[c].strip() for row in found]
        if c in layout.text_columns:
            texts[c] = [normal(cell) for cell in column]
            continue
        for k, cell in enumerate(column):
            if not is_number(cell, decimal):
                at = f"line {rows[k][0]}, column {c + 1}"
                faults[c] = f"{at} is {excerpt(cell)}, which is not a number"
                break
            values[k, c] = float(plain(cell, decimal))
    return values, texts, faults
