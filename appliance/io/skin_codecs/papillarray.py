"""Packets of Contactile's PapillArray (PTS 2.0), with counter, clock and a sum of their bytes."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from numpy.typing import NDArray

from appliance.core.types import shown
from appliance.io.skin_codecs.frames import MOST_PACKET, Decoded, Rest, arranged
from appliance.io.skin_profile import SkinProfile

_HEAD, _TAIL = bytes.fromhex("55667788"), bytes.fromhex("aabbccdd")
_U16 = struct.Struct("<H")
_CLOCK = np.dtype([("count", "<u4"), ("us", "<u8")])
_PILLAR, _TYPE = 26, 2
"""Bytes of a pillar: a uint16 that is _TYPE, and six float32."""
_LOW_32 = np.uint64(0xFFFFFFFF)

Span = tuple[int, int]


@dataclass(frozen=True, slots=True)
class PtsForm:
    """Where things are in the content of a packet. size: its bytes. clock: offset of counter and
    time. numbers: offsets of the bytes of all numbers of all pillars. fixed: offsets of the bytes
    that say so. seen: what stands there."""

    size: int
    clock: int
    numbers: NDArray[np.int64]
    fixed: NDArray[np.int64]
    seen: NDArray[np.uint8]

    def run(self, contents: NDArray[np.uint8]) -> int:
        """How many of `contents` [n, bytes], from the first on, are of this form."""
        if contents.shape[1] != self.size:
            return 0
        same = (contents[:, self.fixed] == self.seen).all(axis=1)
        return len(same) if same.all() else int(same.argmin())


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Packets between head and tail with a sum of their bytes; a tail may occur inside, where the
    sum does not fit."""
    data = rest.data + new
    spans, kept = _packets(data)
    size = 4 * profile.rows * profile.cols * profile.values
    numbers, clocks = [np.empty((0, size), np.uint8)], [np.empty((0, _CLOCK.itemsize), np.uint8)]
    taken: list[Span] = []
    wrong = ""
    form: PtsForm | None = rest.form
    for one, contents, where in _alike(data, spans, form):
        form = one
        if len(form.numbers) == size:
            numbers.append(contents[:, form.numbers])
            clocks.append(contents[:, form.clock : form.clock + _CLOCK.itemsize])
            taken += where
        else:
            wrong = f"it sends {len(form.numbers) // (_PILLAR - 2)} pillars, its profile says {shown((profile.rows, profile.cols))}"
    starts, ends = np.array(taken, np.int64).reshape(-1, 2).T
    clock = np.concatenate(clocks).view(_CLOCK)[:, 0]
    return Decoded(
        arranged(profile, np.concatenate(numbers).view("<f4")),
        ends,
        starts - np.append(0, ends)[:-1],
        taken[-1][1] - taken[-1][0] if taken else 0,
        kept - int((ends - starts).sum()),
        Rest(data[kept:], form=form),
        clock["count"].astype(np.int64),
        (clock["us"] & _LOW_32).astype(np.int64),
        wrong,
    )


def _packets(data: bytes) -> tuple[list[Span], int]:
    """Where packets begin and end, and the beginning of what is left over."""
    spans: list[Span] = []
    at = 0
    while (start := data.find(_HEAD, at)) >= 0:
        end = _end(data, start + len(_HEAD))
        if end == 0:
            return spans, start
        if end > 0:
            spans.append((start, end))
        at = end if end > 0 else start + 1
    return spans, max(at, len(data) - len(_HEAD) + 1)


def _end(data: bytes, begin: int) -> int:
    """Where the packet ends whose content begins at `begin`; 0 if more bytes are needed, -1 if
    there is no packet."""
    tail = begin
    while (tail := data.find(_TAIL, tail)) >= 0 and tail - begin <= MOST_PACKET:
        if (
            tail - 2 > begin
            and sum(data[begin : tail - 2]) & 0xFFFF == _U16.unpack_from(data, tail - 2)[0]
        ):
            return tail + len(_TAIL)
        # here it ended, damaged: among the bytes up to some later tail, one sum in 65,536 would fit
        # by chance
        if data.startswith(_HEAD, tail + len(_TAIL)):
            return -1
        tail += 1
    return 0 if tail < 0 and len(data) - begin <= MOST_PACKET else -1


def _alike(
    data: bytes, spans: list[Span], form: PtsForm | None
) -> Iterator[tuple[PtsForm, NDArray[np.uint8], list[Span]]]:
    """Packets of one form that follow each other: the form, their contents [n, bytes], and where
    they are. Those without a form are left out. form: of the packets before these, which is not
    looked for again."""
    for _, group in groupby(spans, lambda span: span[1] - span[0]):
        where = list(group)
        content = b"".join(data[start + len(_HEAD) : end - len(_TAIL) - 2] for start, end in where)
        contents = np.frombuffer(content, np.uint8).reshape(len(where), -1)
        while where:
            n = form.run(contents) if form else 0
            if not n:
                form = _form(contents[0].tobytes())
                n = form.run(contents) if form else 1
            if form:
                yield form, contents[:n], where[:n]
            contents, where = contents[n:], where[n:]


def _form(content: bytes) -> PtsForm | None:
    """The form of a packet; None if it does not hold what it should."""
    try:
        blocks, fixed = _table(content)
        ends = dict(pairwise([*sorted(blocks.values()), len(content)]))
        if ends[blocks[1]] - blocks[1] != _CLOCK.itemsize:
            return None
        # the sum does not see bytes of 0 that are missing; then block 4 no longer begins with the
        # number of sensors
        if 4 in blocks:
            fixed += range(blocks[4], blocks[4] + 2)
            if _U16.unpack_from(content, blocks[4]) != _U16.unpack_from(content, blocks[3]):
                return None
        # nor those that were added; the lengths of the blocks do
        pillars, more = _pillars(content[: ends[blocks[3]]], blocks[3])
    except (struct.error, KeyError, ValueError, IndexError):
        return None
    numbers = np.add.outer(np.array(pillars, np.int64), np.arange(2, _PILLAR)).ravel()
    known = np.array(fixed + more, np.int64)
    return PtsForm(len(content), blocks[1], numbers, known, np.frombuffer(content, np.uint8)[known])


def _table(content: bytes) -> tuple[dict[int, int], list[int]]:
    """Type -> offset of each block, and where that stands. The table ends where the first block
    begins. Raises struct.error, IndexError or ValueError where it does not fit."""
    width = content[0]
    if not 1 <= width <= 4:
        raise ValueError(f"offsets of {width} bytes")
    blocks: dict[int, int] = {}
    at, first = 1, len(content)
    while at + 2 + width <= first:
        offset = int.from_bytes(content[at + 2 : at + 2 + width], "little")
        blocks[_U16.unpack_from(content, at)[0]] = offset
        first, at = min(first, offset), at + 2 + width
    return blocks, list(range(at))


def _pillars(content: bytes, at: int) -> tuple[list[int], list[int]]:
    """Offsets of all pillars, and of the bytes that say where they are, in the block of type 3:
    sensors, their offsets, of each sensor its pillars, their offsets, and their numbers."""
    width, found, fixed = content[0], [], [at, at + 1]
    (sensors,) = _U16.unpack_from(content, at)
    at += 2 + sensors * width
    for _ in range(sensors):
        (pillars,) = _U16.unpack_from(content, at)
        fixed += [at, at + 1]
        at += 2 + pillars * width
        for _ in range(pillars):
            if _U16.unpack_from(content, at)[0] != _TYPE:
                raise ValueError("numbers of another type")
            found.append(at)
            fixed += [at, at + 1]
            at += _PILLAR
    if at != len(content):
        raise ValueError("a block of another length")
    return found, fixed
