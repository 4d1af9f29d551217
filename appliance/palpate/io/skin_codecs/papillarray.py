"""Packets of Contactile's PapillArray (PTS 2.0), with frame count, clock and sum."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from palpate.core.types import shown
from palpate.io.skin_codecs.frames import MOST_PACKET, Decoded, Gathering, Rest
from palpate.io.skin_profile import SkinProfile

_HEAD, _TAIL = bytes.fromhex("55667788"), bytes.fromhex("aabbccdd")
_U16 = struct.Struct("<H")
_CLOCK = struct.Struct("<IQ")
_PILLAR, _TYPE = 26, 2
"""Bytes of a pillar: the uint16 _TYPE, and six float32."""

Span = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class PtsLayout:
    """Offsets in the content of a packet. size: its bytes. clock: offset of count and time.
    numbers: offsets of the bytes of all numbers of all pillars. fixed: offsets of the bytes that
    define this layout. seen: the values of these bytes."""

    size: int
    clock: int
    numbers: NDArray[np.int64]
    fixed: NDArray[np.int64]
    seen: bytes

    def fits(self, content: NDArray[np.uint8]) -> bool:
        """Whether a packet's content [bytes] has this layout."""
        return len(content) == self.size and content.take(self.fixed).tobytes() == self.seen


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Packets between head and tail with a sum of their bytes; a tail may occur inside."""
    data, frames, counts, times_us = rest.data + new, Gathering(profile), list[int](), list[int]()
    spans, kept = _packets(data)
    frames.garbage, wrong, before = kept, "", 0
    layout: PtsLayout | None = rest.layout
    for start, end in spans:
        content = data[start + len(_HEAD) : end - len(_TAIL) - 2]
        raw = np.frombuffer(content, np.uint8)
        if not (layout and layout.fits(raw)):
            layout = _layout(content)
        if layout and len(layout.numbers) == 4 * profile.numbers:
            frames.numbers.append(raw.take(layout.numbers).view("<f4"))
            frames.skipped.append(start - before)
            frames.ends.append(end)
            frames.size = end - start
            frames.garbage -= frames.size
            count, us = _CLOCK.unpack_from(content, layout.clock)
            counts.append(count)
            times_us.append(us & 0xFFFFFFFF)
            before = end
        elif layout:
            wrong = (
                f"it sends {len(layout.numbers) // (_PILLAR - 2)} pillars, its profile says "
                f"{shown((profile.rows, profile.cols))}"
            )
    clock = np.array(counts, np.int64), np.array(times_us, np.int64)
    left = Rest(data[kept:], layout=layout)
    return frames.decoded(left, wrong=wrong, counts=clock[0], times_us=clock[1])


def _packets(data: bytes) -> tuple[list[Span], int]:
    """Begin and end of each packet, and the beginning of the leftover."""
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
    """The end of the packet whose content begins at `begin`; 0: too few bytes, -1: none."""
    tail = begin
    while (tail := data.find(_TAIL, tail)) >= 0 and tail - begin <= MOST_PACKET:
        if (
            tail - 2 > begin
            and sum(data[begin : tail - 2]) & 0xFFFF == _U16.unpack_from(data, tail - 2)[0]
        ):
            return tail + len(_TAIL)
        # the packet is damaged and ended here; among the bytes up to a later tail, one sum in
        # 65,536 would fit by chance
        if data.startswith(_HEAD, tail + len(_TAIL)):
            return -1
        tail += 1
    return 0 if tail < 0 and len(data) - begin <= MOST_PACKET else -1


def _layout(content: bytes) -> PtsLayout | None:
    """The layout of a packet; None if its content is invalid."""
    try:
        blocks, fixed = _table(content)
        ends = dict(pairwise([*sorted(blocks.values()), len(content)]))
        if ends[blocks[1]] - blocks[1] != _CLOCK.size:
            return None
        # the sum does not detect missing zero bytes; then block 4 no longer begins with the number
        # of sensors
        if 4 in blocks:
            fixed += range(blocks[4], blocks[4] + 2)
            if _U16.unpack_from(content, blocks[4]) != _U16.unpack_from(content, blocks[3]):
                return None
        # added zero bytes are found by the lengths of the blocks
        pillars, more = _pillars(content[: ends[blocks[3]]], blocks[3])
    except (struct.error, KeyError, ValueError, IndexError):
        return None
    numbers = np.add.outer(np.array(pillars, np.int64), np.arange(2, _PILLAR)).ravel()
    known = np.array(fixed + more, np.int64)
    return PtsLayout(
        len(content), blocks[1], numbers, known, np.frombuffer(content, np.uint8)[known].tobytes()
    )


def _table(content: bytes) -> tuple[dict[int, int], list[int]]:
    """Type -> offset of each block, and the offsets of this table. It ends where the first block
    begins. Raises struct.error, IndexError or ValueError if it is invalid."""
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
    """Offsets of all pillars in the block of type 3, and of the bytes that define them: the sensors
    and their offsets, and for each sensor its pillars, their offsets and their numbers."""
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
