"""Finds the format of an unknown skin in its bytes, for `palpate skin new`.

Reads with their times become proposals, the most likely first. A person confirms the grid: no
stream shows whether 16 values are 4 x 4 or 2 x 8.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from appliance.io.skin_codecs.frames import MOST_PACKET

LEAST_FRAMES = 8
"""Frames in succession before a pattern counts."""
SHARE = 0.8
"""Least share of the bytes that the frames of a proposal explain. A wrong baud rate explains
none."""
CONSTANT = 0.99
"""A byte of a frame is constant if it has one value in this share of the frames."""
MOST_MARK = 4
"""Longest proposed marker or trailer; the known makers use two or four bytes."""
FLOATS = 1e-6, 1e7
"""Magnitudes of sensible numbers. Other bytes that are read as float32 are seldom within, and a
zero does not count against them."""
CONTRAST = 4.0
"""Ratio of the numbers of values of two bytes from which on they are one number."""
AGAIN = 0.01
"""If a shorter distance repeats as many bytes, less this share, the shorter distance is the
frame."""
COUNTS = 0.95
"""A number counts the frames if it grows by one in this share of them; the rest may be lost
frames."""
LONGEST = 4
"""Ratio of the sides from which on a grid is unlikely."""
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_TEXT = frozenset(b"0123456789+-.eE,;:[]() \t\r\n")

Grid = tuple[int, int, int]
"""Rows, columns, axes."""


@dataclass(frozen=True, slots=True)
class Read:
    """One read of the port. t_ns: its end, host monotonic."""

    t_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Proposal:
    """A possible format of a stream.

    framing: the way to find a frame: a `mark` before it, a `mark` behind it, or lines of text.
    length: bytes of a frame with its mark; for text, lines. sequence: type of the frame count
    behind the marker, "" for none. dtype, big_endian: type of a value on the wire. values: number
    of values in a frame. grids: grids with as many values, the squarest first. rate_hz: frames by
    their times of arrival. share: share of the bytes that these frames explain, 0 to 1.
    """

    framing: Literal["marker", "trailer", "text"]
    mark: bytes
    length: int
    sequence: str
    dtype: str
    big_endian: bool
    values: int
    grids: tuple[Grid, ...]
    rate_hz: float
    share: float


def analyse(reads: Sequence[Read]) -> list[Proposal]:
    """All possible formats of `reads`, the most likely first; empty without a pattern."""
    data = b"".join(read.data for read in reads)
    if not data:
        return []
    seconds = max((reads[-1].t_ns - reads[0].t_ns) / 1e9, 1e-9)
    if sum(byte in _TEXT for byte in data) > 0.98 * len(data):
        return _text(data, seconds)
    return _binary(data, np.cumsum([len(read.data) for read in reads])[:-1], seconds)


def grids(values: int) -> tuple[Grid, ...]:
    """Up to six grids of `values` numbers: with one axis, then with three if three divides the
    number; the squarest first."""
    found = []
    for axes in (1, 3):
        if values % axes == 0 and values >= axes:
            taxels = values // axes
            pairs = [
                (r, taxels // r, axes) for r in range(1, int(taxels**0.5) + 1) if taxels % r == 0
            ]
            found += [pair for pair in pairs[::-1] if max(pair) <= 255][:3]
    return tuple(found)


def _text(data: bytes, seconds: float) -> list[Proposal]:
    """Formats of lines of numbers: a line is a frame, or several lines that end with a shorter
    line."""
    lines = [
        _NUMBER.findall(line) for line in data.split(b"\n")[1:-1]
    ]  # the first and the last may be cut
    counts = [len(line) for line in lines]
    if len(counts) < LEAST_FRAMES or not max(counts):
        return []
    usual = Counter(c for c in counts if c).most_common(1)[0][0]
    ends = [i for i, count in enumerate(counts) if count < usual]
    spans = Counter(np.diff(ends).tolist())
    rows = spans.most_common(1)[0][0] - 1 if spans else 0
    height = rows if rows >= 1 and spans[rows + 1] * (rows + 1) >= SHARE * len(counts) else 1
    share = counts.count(usual) / (len(counts) if height == 1 else max(1, len(counts) - len(ends)))
    frames = spans[height + 1] if height > 1 else counts.count(usual)
    if share < SHARE or frames < LEAST_FRAMES:
        return []
    words = [word for line in lines if len(line) == usual for word in line]
    values = height * usual
    known = ((height, usual, 1),) if height > 1 else ()
    fits = known + tuple(grid for grid in grids(values) if grid not in known)
    return [
        Proposal(
            "text", b"", height, "", _text_type(words), False, values, fits, frames / seconds, share
        )
    ]


def _text_type(words: Sequence[bytes]) -> str:
    """The smallest type that leaves room for larger numbers of the same kind."""
    if any(set(word) & set(b".eE") for word in words):
        return "float32"
    return "int16" if any(word.startswith(b"-") for word in words) else "uint16"


def _binary(data: bytes, boundaries: NDArray[np.int64], seconds: float) -> list[Proposal]:
    """Formats with frames of one length and the same bytes at their begin or end. boundaries:
    offsets at which reads began."""
    stream = np.frombuffer(data, np.uint8)
    found = _period(stream)
    if found is None:
        return []
    length, starts, share = found
    table = stream[starts[:, None] + np.arange(length)]
    usual = np.array([np.bincount(column).argmax() for column in table.T], np.uint8)
    constant = (table == usual).mean(axis=0) >= CONSTANT
    begin = _begin(boundaries, int(starts[0]), length)
    rate = len(stream) * share / length / seconds
    proposals = []
    for framing, first, size in _marks(constant, usual, begin):
        at = first if framing == "marker" else (first + size) % length
        whole = starts[starts + at + length <= len(stream)]
        frames = stream[whole[:, None] + at + np.arange(length)]  # from the first byte of a frame
        payload = frames[:, size:] if framing == "marker" else frames[:, : length - size]
        mark = bytes(np.roll(usual, -first)[:size])
        if not any(mark):
            continue  # untouched taxels are zero, too
        for sequence, behind in _sequences(payload) if framing == "marker" else [("", payload)]:
            for dtype, big_endian in _types(behind):
                values = behind.shape[1] // np.dtype(dtype).itemsize
                proposals.append(
                    Proposal(
                        framing,
                        mark,
                        length,
                        sequence,
                        dtype,
                        big_endian,
                        values,
                        grids(values),
                        rate,
                        share,
                    )
                )
    return sorted(proposals, key=_unlikely)


def _unlikely(proposal: Proposal) -> tuple[bool, int]:
    """The reasons against a proposal: a grid much longer than wide; small numbers, because any
    bytes can be read as small numbers."""
    flat = not proposal.grids or max(proposal.grids[0][:2]) > LONGEST * min(proposal.grids[0][:2])
    return flat, -np.dtype(proposal.dtype).itemsize


def _period(stream: NDArray[np.uint8]) -> tuple[int, NDArray[np.int64], float] | None:
    """(bytes of a frame, offsets of a constant place in the frames, share of the stream that they
    explain).

    Candidates are the distances at which a byte, or a pair of bytes, repeats. The frame is the
    distance at which most bytes of the stream repeat: numbers change little between frames.
    """
    found: dict[int, tuple[NDArray[np.int64], float, float]] = {}
    for words in ((stream[:-1].astype(np.int32) << 8) + stream[1:], stream.astype(np.int32)):
        order = np.argsort(words, kind="stable")
        for places in np.split(order, np.flatnonzero(np.diff(words[order])) + 1):
            if len(places) < LEAST_FRAMES:
                continue
            gaps = np.bincount(np.diff(places))
            length = int(gaps.argmax())
            pure = gaps[length] / (len(places) - 1)  # the rest are the same bytes among the numbers
            starts = places[:-1][np.diff(places) == length]
            share = len(starts) * length / len(stream)
            fits = 3 <= length <= MOST_PACKET and len(starts) >= LEAST_FRAMES - 1 and share >= SHARE
            if fits and (length not in found or pure > found[length][2]):
                found[length] = starts, share, pure
    if not found:
        return None
    again = {length: float((stream[:-length] == stream[length:]).mean()) for length in found}
    length = min(length for length in found if again[length] >= max(again.values()) - AGAIN)
    return length, found[length][0], found[length][1]


def _begin(boundaries: NDArray[np.int64], start: int, length: int) -> int | None:
    """The begin of frames after `start`, if reads begin there more often than elsewhere: a board
    sends whole frames."""
    if not len(boundaries):
        return None
    phases = np.bincount((boundaries - start) % length, minlength=length)
    return int(phases.argmax()) if phases.max() >= 0.5 * len(boundaries) else None


def _marks(
    constant: NDArray[np.bool_], usual: NDArray[np.uint8], begin: int | None
) -> Iterator[tuple[Literal["marker", "trailer"], int, int]]:
    """(framing, first byte, bytes) of each run of constant bytes that can mark a frame, the most
    likely first.

    A run at the begin of a frame is a marker, a run at its end a trailer; if reads do not show it,
    all are markers. Zeros at the side of the values are left out: untouched taxels are zero, too.
    """
    length = len(constant)
    runs = []
    for first in np.flatnonzero(constant & ~np.roll(constant, 1)).tolist():
        size = int(np.argmin(np.roll(constant, -first))) or length
        runs.append((first, size))
    runs.sort(key=lambda run: -np.count_nonzero(np.roll(usual, -run[0])[: run[1]]))
    for first, size in runs:
        inner = 0 if begin is None else (begin - first) % length
        text = np.roll(usual, -first)[:size]
        if (
            inner < size
        ):  # frames begin in this run: the bytes before it belong to the end of a frame
            for kept in _sizes(text[inner:][::-1]):
                yield "marker", (first + inner) % length, kept
        if begin is not None and 0 < inner <= size:
            for kept in _sizes(text[:inner]):
                yield "trailer", (first + inner - kept) % length, kept


def _sizes(run: NDArray[np.uint8]) -> list[int]:
    """Possible lengths of a mark in a run whose last byte is the mark's outer byte: all bytes, two
    (the usual length), or three. Constant bytes of numbers can lie beside a mark."""
    beside = np.flatnonzero(run)
    most = min(MOST_MARK, len(run) - int(beside[0])) if len(beside) else 0
    return [most, *(size for size in (2, 3) if size < most)] if most else []


def _types(payload: NDArray[np.uint8]) -> Iterator[tuple[str, bool]]:
    """Possible (type, big-endian) of the value bytes [frames, bytes], the most likely first."""
    raw = np.ascontiguousarray(payload)
    size = raw.shape[1]
    if size % 4 == 0:
        for order in "<>":
            with np.errstate(invalid="ignore"):
                numbers = np.abs(raw.view(f"{order}f4").astype(np.float64))
            sensible = (numbers == 0) | ((numbers >= FLOATS[0]) & (numbers <= FLOATS[1]))
            if sensible.mean() >= CONSTANT and (numbers > 0).any():
                yield "float32", order == ">"
    if size % 2 == 0:
        changes = np.array([len(np.unique(column)) - 1 for column in raw.T])
        even, odd = float(changes[::2].mean()), float(changes[1::2].mean())
        for order, low, high in (("<", even, odd), (">", odd, even)):
            if low > CONTRAST * high:
                signed = raw.view(f"{order}i2").astype(np.int64)
                yield ("int16" if _crosses_zero(signed) else "uint16"), order == ">"
    yield "uint8", False


def _crosses_zero(numbers: NDArray[Any]) -> bool:
    """Whether a value passes from a little above zero to a little below it: then it has a sign."""
    near = np.abs(numbers) < 1 << 13
    return bool((near.all(axis=0) & (numbers.min(axis=0) < 0)).any())


def _sequences(payload: NDArray[np.uint8]) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """(type of the frame count in front, bytes behind it), the most likely first; "" without a
    count.

    The lowest byte grows by one from frame to frame. Further bytes belong to the count if they
    carry.
    """
    counting = (np.diff(payload.astype(np.int16), axis=0) % 256 == 1).mean(axis=0) >= COUNTS
    if (
        payload.shape[1] > 4 and counting[0] and counting.mean() < 0.5
    ):  # all taxels of a test pattern may count
        for size in (4, 2):
            number = payload[:, :size].copy().view(f"<u{size}")[:, 0].astype(np.int64)
            carried = (np.diff(number) == 1)[
                number[:-1] % 256 == 255
            ]  # else the next byte is a taxel that stays at zero
            if (np.diff(number) == 1).mean() >= COUNTS and (
                not len(carried) or carried.mean() >= COUNTS
            ):
                yield f"uint{8 * size}", payload[:, size:]
        yield "uint8", payload[:, 1:]
    yield "", payload
