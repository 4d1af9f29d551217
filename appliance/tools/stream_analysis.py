"""What an unknown skin sends, found in its bytes alone, for `palpate skin new`. In: reads with
their times. Out: Proposals, the most likely first.

Nothing is decided here: a person confirms the grid, which no stream can tell (16 values may be 4 x
4 or 2 x 8).
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
"""Frames that must follow one another before a pattern counts."""
SHARE = 0.8
"""Least share of the bytes that the frames of a proposal explain. A wrong baud rate explains
none."""
CONSTANT = 0.99
"""A byte of a frame is constant if it has one value in this share of the frames."""
MOST_MARK = 4
"""Longest marker or trailer that is proposed; the makers known to us use two or four bytes."""
FLOATS = 1e-6, 1e7
"""Magnitudes of sensible numbers; other bytes read as float32 seldom lie within (nor does a zero
count against it)."""
CONTRAST = 4.0
"""How many more values one byte of a pair must take than the other, for the two to be one
number."""
AGAIN = 0.01
"""Where as many bytes, less this share, come again after a shorter distance, it is the frame and
the longer is two."""
COUNTS = 0.95
"""A number counts the frames if it grows by one in this share of them; the rest were lost."""
LONGEST = 4
"""A grid that is more times longer than wide is not likely."""
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_TEXT = frozenset(b"0123456789+-.eE,;:[]() \t\r\n")

Grid = tuple[int, int, int]
"""Rows, columns, axes."""


@dataclass(frozen=True, slots=True)
class Read:
    """What one read of the port gave. t_ns: when it ended, host monotonic."""

    t_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Proposal:
    """One way to understand a stream.

    framing: what shows where a frame is: a `mark` before it, a `mark` behind it, or lines of text.
    length: bytes of a frame with its mark; for text, lines. sequence: type of a count of the frames
    behind the marker, "" for none. dtype, big_endian: type of a value on the wire. values: in a
    frame. grids: that have as many values, the squarest first. rate_hz: frames by their times of
    arrival. share: of all bytes that these frames explain, 0 to 1.
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
    """All ways in which `reads` can be understood, the most likely first; empty if there is no
    pattern in them."""
    data = b"".join(read.data for read in reads)
    if not data:
        return []
    seconds = max((reads[-1].t_ns - reads[0].t_ns) / 1e9, 1e-9)
    if sum(byte in _TEXT for byte in data) > 0.98 * len(data):
        return _text(data, seconds)
    return _binary(data, np.cumsum([len(read.data) for read in reads])[:-1], seconds)


def grids(values: int) -> tuple[Grid, ...]:
    """Up to six grids of `values` numbers: one axis, then three where it divides by three; the
    squarest first."""
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
    """Lines of numbers: each a frame, or so many to one, with a shorter line behind them."""
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
    """Frames of one length with the same bytes at their begin or end. boundaries: offsets at which
    reads began."""
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
            continue  # what nobody touches is zero, too
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
    """What speaks against a proposal: a grid much longer than wide; small numbers, as which
    anything can be read."""
    flat = not proposal.grids or max(proposal.grids[0][:2]) > LONGEST * min(proposal.grids[0][:2])
    return flat, -np.dtype(proposal.dtype).itemsize


def _period(stream: NDArray[np.uint8]) -> tuple[int, NDArray[np.int64], float] | None:
    """(bytes of a frame, offsets of one constant place in the frames, share of the stream that they
    explain).

    Candidates are the distances at which a byte, or a pair of bytes, comes again and again. The
    frame is the one at which most bytes of the stream come again: numbers change little from one
    frame to the next.
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
    """Where frames begin after `start`, if reads begin there more often than elsewhere: a board
    sends frames whole."""
    if not len(boundaries):
        return None
    phases = np.bincount((boundaries - start) % length, minlength=length)
    return int(phases.argmax()) if phases.max() >= 0.5 * len(boundaries) else None


def _marks(
    constant: NDArray[np.bool_], usual: NDArray[np.uint8], begin: int | None
) -> Iterator[tuple[Literal["marker", "trailer"], int, int]]:
    """(framing, first byte, bytes) of each run of constant bytes that can mark a frame, the most
    likely first.

    A run at the begin of a frame is a marker, one at its end a trailer; where reads do not tell,
    all are markers. Zeros are left out at the side of the values: taxels that nobody touches are
    zero, too.
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
        if inner < size:  # frames begin in this run: what is before belongs to the end of a frame
            for kept in _sizes(text[inner:][::-1]):
                yield "marker", (first + inner) % length, kept
        if begin is not None and 0 < inner <= size:
            for kept in _sizes(text[:inner]):
                yield "trailer", (first + inner - kept) % length, kept


def _sizes(run: NDArray[np.uint8]) -> list[int]:
    """Bytes that a mark can have in a run whose last byte is the mark's outer one: all, two as most
    have, or three. The bytes of numbers that do not change can lie beside it."""
    beside = np.flatnonzero(run)
    most = min(MOST_MARK, len(run) - int(beside[0])) if len(beside) else 0
    return [most, *(size for size in (2, 3) if size < most)] if most else []


def _types(payload: NDArray[np.uint8]) -> Iterator[tuple[str, bool]]:
    """(type, big-endian) that the bytes [frames, bytes] of the values can have, the most likely
    first."""
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
    """True if a value goes from a little above zero to a little below it: it has a sign."""
    near = np.abs(numbers) < 1 << 13
    return bool((near.all(axis=0) & (numbers.min(axis=0) < 0)).any())


def _sequences(payload: NDArray[np.uint8]) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """(type of the count of frames in front, the bytes behind it), the most likely first; "" where
    nothing counts.

    The lowest byte grows by one from frame to frame; further bytes belong to the count if they
    carry.
    """
    counting = (np.diff(payload.astype(np.int16), axis=0) % 256 == 1).mean(axis=0) >= COUNTS
    if (
        payload.shape[1] > 4 and counting[0] and counting.mean() < 0.5
    ):  # taxels of a test pattern may all count
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
