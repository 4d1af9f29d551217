"""Finds the format of an unknown skin in its bytes, for `palpate skin new`.

Reads with their times become proposals, the most likely first. A person confirms the grid: no
stream shows whether 16 values are 4 x 4 or 2 x 8.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.io import wire_numbers
from palpate.io.skin_codecs.frames import MOST_PACKET
from palpate.tools import frame_fields, text_analysis
from palpate.tools.frame_fields import CheckField, Columns, CountField
from palpate.tools.text_analysis import LEAST_FRAMES, SHARE

CONSTANT = 0.99
"""A byte of a frame is constant if it has one value in this share of the frames."""
MOST_MARK = 8
"""Longest proposed marker or trailer; the known makers use two or four bytes, and constant bytes
such as a length may follow."""
MOST_RUNS = 6
"""Most runs of constant bytes that are tried as marks."""
MOST_BEFORE = 2
"""Most constant bytes before a marker that belong to the number before it, in frames of up to SHORT
bytes."""
SHORT = 256
AGAIN = 0.01
"""If a shorter distance repeats as many bytes, less this share, the shorter distance is the
frame."""
LONGEST = 4
"""Ratio of the sides from which on a grid is unlikely."""
HEADER, FOOTER = 12, 8
"""Bytes behind the marker and before the end in which a count or a clock is searched."""
MOST_IGNORED = 8, 4
"""Most bytes of unknown meaning before and behind the numbers."""
STILL, MOVING, UNUSED, FLAT, SMALL = 2, 4, 3, 3, 4
"""Reasons against a proposal: an ignored byte that never changes; one that does; a count that is
not used; a grid that is much longer than wide; a type although a larger one fits."""
MOST_COST = 14
MOST_PROPOSALS = 40

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
    length: bytes of a frame with its mark; for text, lines. sequence: type of the frame count, ""
    for none. dtype, big_endian: type of a value on the wire. values: number of values in a frame.
    grids: grids with as many values, the squarest first. rate_hz: frames by their times of arrival.
    share: share of the bytes that these frames explain, 0 to 1. keys: further keys of the profile.
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
    keys: Mapping[str, Any] = field(default_factory=dict)


def analyse(reads: Sequence[Read], values: int = 0) -> list[Proposal]:
    """All possible formats of `reads`, the most likely first; empty without a pattern. values:
    number of values in a frame, which may have any number of other bytes; 0: unknown."""
    data = b"".join(read.data for read in reads)
    if not data:
        return []
    seconds = max((reads[-1].t_ns - reads[0].t_ns) / 1e9, 1e-9)
    if text_analysis.is_text(data):
        found = _text(data, seconds, values)
        if found or (data.isascii() and len(data.splitlines()) > LEAST_FRAMES):
            return found  # hexadecimal digits, too, would have the pattern of a frame
    boundaries = np.cumsum([len(read.data) for read in reads])[:-1]
    return _binary(data, boundaries, seconds, values)


def obstacle(reads: Sequence[Read]) -> str:
    """Why reads without a pattern have none, as far as it shows; "" if it does not."""
    data = b"".join(read.data for read in reads)
    return text_analysis.obstacle(data) if data and text_analysis.is_text(data) else ""


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


def _text(data: bytes, seconds: float, wanted: int) -> list[Proposal]:
    """Formats of lines of numbers. Their type is the widest: a skin that rests sends neither signs
    nor decimals. wanted: number of values, 0 for any."""
    made = []
    for form in text_analysis.forms(data, wanted):
        values = form.lines * form.values
        known = ((form.lines, form.values, 1),) if form.lines > 1 else ()
        fits = known + tuple(grid for grid in grids(values) if grid not in known)
        rate = form.frames / seconds
        made.append(
            Proposal(
                "text",
                b"",
                form.lines,
                "",
                "float32",
                False,
                values,
                fits,
                rate,
                form.share,
                form.keys,
            )
        )
    return made


@dataclass(frozen=True, slots=True)
class Framing:
    """Frames [n, bytes] whose beginning is decided. marker, trailer: bytes at both ends. check: of
    the bytes between. columns: their statistics."""

    frames: NDArray[np.uint8]
    marker: int
    trailer: int
    check: CheckField | None
    columns: Columns

    @property
    def end(self) -> int:
        """The first byte behind the content."""
        checked = self.check.checksum.size if self.check else 0
        return int(self.frames.shape[1]) - self.trailer - checked


def _binary(
    data: bytes, boundaries: NDArray[np.int64], seconds: float, wanted: int
) -> list[Proposal]:
    """Formats with frames of one length and the same bytes at their begin or end. boundaries:
    offsets at which reads began. wanted: number of values, 0 for any."""
    stream = np.frombuffer(data, np.uint8)
    found = _period(stream)
    if found is None:
        return []
    length, starts, share = found
    rate = len(stream) * share / length / seconds
    best: dict[tuple[int, str], tuple[tuple[float, ...], Proposal]] = {}
    for framing in _framings(stream, starts, length, _begin(boundaries, int(starts[0]), length)):
        for cost, proposal in _contents(framing, wanted, rate, share):
            key = proposal.values, proposal.dtype
            if key not in best or cost < best[key][0]:
                best[key] = cost, proposal
    ranked = sorted(best.values(), key=lambda one: one[0])
    return [proposal for _, proposal in ranked[:MOST_PROPOSALS]]


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


def _framings(
    stream: NDArray[np.uint8], starts: NDArray[np.int64], length: int, begin: int | None
) -> Iterator[Framing]:
    """The stream as frames that begin and end with each of the possible marks."""
    table = stream[starts[:, None] + np.arange(length)]
    usual = np.array([np.bincount(column).argmax() for column in table.T], np.uint8)
    constant = (table == usual).mean(axis=0) >= CONSTANT
    known: dict[int, tuple[NDArray[np.uint8], Columns]] = {}
    checks: dict[tuple[int, int], CheckField | None] = {}
    for first, marker, trailer in _marks(constant, usual, begin):
        at = first % length
        if at not in known:
            if any(checks.values()):
                return  # no other marks explain a checksum by chance
            whole = starts[starts + at + length <= len(stream)]
            frames = stream[whole[:, None] + at + np.arange(length)]
            known[at] = frames, Columns(frames)
        frames, columns = known[at]
        if (at, trailer) not in checks:
            content = frames[:, : length - trailer]
            checks[at, trailer] = frame_fields.checksum(content, marker + HEADER)
        yield Framing(frames, marker, trailer, checks[at, trailer], columns)


def _begin(boundaries: NDArray[np.int64], start: int, length: int) -> int | None:
    """The begin of frames after `start`, if reads begin there more often than elsewhere: a board
    sends whole frames."""
    if not len(boundaries):
        return None
    phases = np.bincount((boundaries - start) % length, minlength=length)
    return int(phases.argmax()) if phases.max() >= 0.5 * len(boundaries) else None


def _marks(
    constant: NDArray[np.bool_], usual: NDArray[np.uint8], begin: int | None
) -> Iterator[tuple[int, int, int]]:
    """(begin of frames, bytes of their marker, bytes of their trailer), the most likely first: of
    each run of constant bytes that can mark a frame.

    Frames begin in a run where reads show it, else at one of the run's first bytes: a number at the
    end of the frame before may rest, too. Zeros at the side of
    the values are left out: untouched taxels are zero, too.
    """
    length = len(constant)
    runs = []
    for first in np.flatnonzero(constant & ~np.roll(constant, 1)).tolist():
        size = int(np.argmin(np.roll(constant, -first))) or length
        runs.append((first, size))
    runs.sort(key=lambda run: -np.count_nonzero(np.roll(usual, -run[0])[: run[1]]))
    most = MOST_BEFORE if length <= SHORT else 0  # each place takes its time
    starts = [
        (first, size, inner)
        for first, size in runs[:MOST_RUNS]
        for inner in (range(min(size, most + 1)) if begin is None else [(begin - first) % length])
    ]
    for first, size, inner in starts:
        if inner > size:
            continue
        text = np.roll(usual, -first)[:size]
        markers, trailers = _sizes(text[inner:][::-1]), _sizes(text[:inner])
        for marker in markers:
            for trailer in (*trailers[:1], 0):
                yield first + inner, marker, trailer
        for trailer in trailers:
            yield first + inner, 0, trailer


def _sizes(run: NDArray[np.uint8]) -> list[int]:
    """Possible lengths of a mark in a run whose last byte is the mark's outer byte: all bytes, or
    fewer, as constant bytes of numbers can lie beside a mark."""
    beside = np.flatnonzero(run)
    most = min(MOST_MARK, len(run) - int(beside[0])) if len(beside) else 0
    return [most, *(size for size in (4, 2, 3, 1) if size < most)] if most else []


def _contents(
    framing: Framing, wanted: int, rate: float, share: float
) -> Iterator[tuple[tuple[float, ...], Proposal]]:
    """Possible contents of frames between their marks, each with the reasons against it. wanted:
    number of values, 0 for any."""
    m, end = framing.marker, framing.end
    places = {*range(m, min(m + HEADER, end)), *range(max(m, end - FOOTER), end)}
    counts = frame_fields.counts(framing.frames[:, :end], places)
    for count in [*counts, None]:
        begin, stop, clock = _between(framing, count)
        for first, last in _spans(begin, stop, wanted):
            cost = _ignored(framing.columns, begin, first) + _ignored(framing.columns, last, stop)
            cost += UNUSED * (bool(counts) and count is None) + clock
            if cost > MOST_COST and not wanted:
                continue
            for against, proposal in _numbers(framing, count, (first, last), cost, rate, share):
                if proposal.values == wanted or (not wanted and against[0] <= MOST_COST):
                    yield against, proposal


def _spans(begin: int, stop: int, wanted: int) -> Iterator[tuple[int, int]]:
    """Parts of the bytes from `begin` to `stop` that may be the numbers. wanted: how many numbers
    there are, 0 for any."""
    if wanted:
        for size in (4 * wanted, 3 * wanted, 2 * wanted, wanted):
            for first in range(begin, stop - size + 1):
                yield first, first + size
        return
    for before in range(MOST_IGNORED[0] + 1):
        for behind in range(MOST_IGNORED[1] + 1):
            if stop - behind - begin - before >= 1:
                yield begin + before, stop - behind


def _between(framing: Framing, count: CountField | None) -> tuple[int, int, bool]:
    """The bytes between the fields at the begin and those at the end, and whether a clock is among
    these."""
    begin, stop = framing.marker, framing.end
    if count and count.at < (begin + stop) / 2:
        begin = count.end
    elif count:
        stop = count.at
    for size in (8, 4, 2):
        if stop - begin > size:
            if frame_fields.is_clock(framing.frames, begin, size):
                return begin + size, stop, True
            if frame_fields.is_clock(framing.frames, stop - size, size):
                return begin, stop - size, True
    return begin, stop, False


def _ignored(columns: Columns, first: int, last: int) -> float:
    """The reasons against ignoring these bytes."""
    still = columns.still(first, last)
    return STILL * still + MOVING * (last - first - still)


def _numbers(
    framing: Framing,
    count: CountField | None,
    span: tuple[int, int],
    cost: float,
    rate: float,
    share: float,
) -> Iterator[tuple[tuple[float, ...], Proposal]]:
    """Possible numbers in the bytes of `span`."""
    first, last = span
    frame = framing.frames[len(framing.frames) // 2]
    marker = frame[: framing.marker].tobytes()
    trailer = frame[len(frame) - framing.trailer :].tobytes()
    kind: Literal["marker", "trailer"] = "marker" if marker else "trailer"
    for rank, (dtype, big_endian) in enumerate(framing.columns.types(first, last)):
        size = wire_numbers.size(dtype)
        values = (last - first) // size
        fits = grids(values)
        flat = not fits or max(fits[0][:2]) > LONGEST * min(fits[0][:2])
        keys = _keys(framing, count, span, "big" if big_endian else "little")
        keys |= {"trailer": trailer.hex(" ")} if marker and trailer else {}
        against = (
            cost + SMALL * rank + FLAT * flat,
            -size,
            -framing.marker - framing.trailer,
            count.at - count.end if count else 0,
            framing.columns.roughness(first, last, dtype, big_endian),
        )
        mark, sequence, length = marker or trailer, count.kind if count else "", len(frame)
        yield (
            against,
            Proposal(
                kind, mark, length, sequence, dtype, big_endian, values, fits, rate, share, keys
            ),
        )


def _keys(
    framing: Framing, count: CountField | None, span: tuple[int, int], order: str
) -> dict[str, Any]:
    """The keys of a profile for everything that is not a number, where they differ from the
    defaults. order: of the bytes of a number."""
    (first, last), m, end = span, framing.marker, framing.end
    before, behind = first - m, end - last
    keys: dict[str, Any] = {}
    if count:
        room = count.end - count.at
        before, behind = (before - room, behind) if count.at < first else (before, behind - room)
        if count.at > m:
            keys["sequence_at"] = count.at - m
        if room > 1 and count.order != order:
            keys["sequence_order"] = count.order
    keys |= {"skip_before": before} if before else {}
    keys |= {"skip_after": behind} if behind else {}
    if check := framing.check:
        keys["checksum"] = check.checksum.text
        keys |= {"checksum_from": check.first} if check.first else {}
        if check.checksum.size > 1 and check.order != order:
            keys["checksum_order"] = check.order
    return keys
