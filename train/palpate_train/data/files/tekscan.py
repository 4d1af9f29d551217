"""Reads movies of pressure that Tekscan's programs export as text (.asf, .csv, .txt).

Layout, as published readers of such files describe it: lines KEY VALUE up to ASCII_DATA @@, then
for each frame a line "Frame N" and ROWS lines of COLS cells, with commas between them; @@ at the
end. B stands where the sensor has no sensel.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from palpate.core.errors import FormatError
from palpate_train.data.files.table import Array, ReadPlan, Table, excerpt, timed

START = re.compile(r'"?ASCII_DATA[\s",]*@@')
FRAME = re.compile(r'"?Frame\s+(\d+)', re.IGNORECASE)
KEY = re.compile(r'"?([A-Z_]+)"?[\s,]+"?(.*?)[",\s]*$')
END = "@@"
STEP = "SECONDS_PER_FRAME"
NO_SENSEL = "B"
Row = tuple[int, str]


def is_movie(lines: Sequence[str]) -> bool:
    """Whether a text holds frames as blocks of lines after Tekscan's header."""
    start = next((i for i, line in enumerate(lines[:200]) if START.match(line)), None)
    return start is not None and any(FRAME.match(line) for line in lines[start : start + 10])


def read(lines: Sequence[str], wanted: ReadPlan, notes: Sequence[str]) -> Table:
    """The frames [n, R, C] of a movie, and its times as the vector `time`, in seconds.

    Rows and columns without a sensel are left out. Raises FormatError with the line.
    """
    start = next(i for i, line in enumerate(lines) if START.match(line))
    matches = [found for line in lines[:start] if (found := KEY.match(line.strip()))]
    head = {str(found[1]): str(found[2]) for found in matches}
    blocks, said = _blocks(list(enumerate(lines, 1))[start + 1 :])
    shape = _shape(head, blocks)
    last, rows = blocks[-1]
    if said and (len(rows) < shape[0] or len(_cells(rows[-1][1])) < shape[1]):
        said.append(f"read up to frame {last}, which is cut off")
        blocks = blocks[:-1]
    if not blocks:
        raise FormatError("holds no whole frame")
    frames = np.stack([_frame(number, rows, shape) for number, rows in blocks])
    said = [*notes, *said]
    numbers = [number for number, _ in blocks]
    for before, after in pairwise(numbers):
        if after != before + 1:
            raise FormatError(f"frame {after} follows frame {before}; export all frames")
    frames, dropped = _without_empty(frames)
    said += [dropped] if dropped else []
    made = Table(frames, notes=tuple(said))
    stated = head.get(STEP, "").split()
    return timed(made, STEP, stated[0]) if stated else made


def _blocks(rows: Sequence[Row]) -> tuple[list[tuple[int, list[Row]]], list[str]]:
    """The number and the lines of each frame, and remarks on the lines after the last."""
    blocks: list[tuple[int, list[Row]]] = []
    for i, line in rows:
        text = line.strip().strip('"')
        if text.startswith(END):
            break
        if found := FRAME.match(line.strip()):
            blocks.append((int(found[1]), []))
        elif text.strip(", ;\t") and blocks:
            blocks[-1][1].append((i, text))
    else:
        return blocks, [f"has no {END} at its end"]
    return blocks, []


def _shape(head: dict[str, str], blocks: Sequence[tuple[int, list[Row]]]) -> tuple[int, int]:
    """Rows and columns, from the header or else from the first frame."""
    if not blocks or not blocks[0][1]:
        raise FormatError("holds no frames after ASCII_DATA @@")
    first = blocks[0][1]
    own = len(first), len(_cells(first[0][1]))
    stated = (head.get("ROWS", ""), head.get("COLS", ""))
    return (int(stated[0]), int(stated[1])) if all(map(str.isdecimal, stated)) else own


def _cells(line: str) -> list[str]:
    found = [cell.strip() for cell in re.split(r"[,;\t]", line)]
    return found[:-1] if found and not found[-1] else found


def _frame(number: int, rows: Sequence[Row], shape: tuple[int, int]) -> Array:
    """One frame, NaN where there is no sensel."""
    if len(rows) != shape[0]:
        raise FormatError(f"frame {number} has {len(rows)} lines, and ROWS says {shape[0]}")
    values = np.empty(shape)
    for r, (i, line) in enumerate(rows):
        found = _cells(line)
        if len(found) != shape[1]:
            raise FormatError(f"line {i} has {len(found)} columns, and COLS says {shape[1]}")
        for c, cell in enumerate(found):
            try:
                values[r, c] = math.nan if cell == NO_SENSEL else float(cell)
            except ValueError:
                raise FormatError(
                    f"line {i}, column {c + 1} is {excerpt(cell)}, which is not a number"
                ) from None
    return values


def _without_empty(frames: Array) -> tuple[Array, str]:
    """Frames without the rows and columns that have no sensel; 0 at other places without one."""
    empty = np.isnan(frames)
    missing: Array = np.all(empty, axis=0)
    if (empty.any(axis=0) != missing).any():
        r, c = np.argwhere(empty.any(axis=0) != missing)[0]
        raise FormatError(f"row {r + 1}, column {c + 1} is {NO_SENSEL} in some of the frames only")
    if not missing.any():
        return frames, ""
    kept = frames[:, ~missing.all(axis=1)][:, :, ~missing.all(axis=0)]
    holes = int(np.isnan(kept[0]).sum())
    note = f"has sensels in {kept.shape[1]} rows and {kept.shape[2]} columns"
    return np.nan_to_num(kept, nan=0.0), note + f"; {holes} places without one read 0" * (holes > 0)
