"""Packets of Contactile's PapillArray (PTS 2.0), with counter, clock and a sum of their bytes."""

from __future__ import annotations

import struct
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.types import shown
from appliance.io.skin_codecs.frames import MOST_PACKET, Decoded, Rest, collected
from appliance.io.skin_profile import SkinProfile

_PTS_HEAD, _PTS_TAIL = bytes.fromhex("55667788"), bytes.fromhex("aabbccdd")
_PILLAR = np.dtype([("type", "<u2"), ("values", "<f4", 6)])
_CLOCK = struct.Struct("<IQ")
_U16 = struct.Struct("<H")


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Packets between head and tail with a sum of their bytes; a tail may occur inside, where the sum does not fit."""
    data = rest.data + new
    numbers: list[NDArray[Any]] = []
    ends: list[int] = []
    skipped: list[int] = []
    clocks: list[tuple[int, int]] = []
    at = garbage = before = size = 0
    wrong = ""
    while (start := data.find(_PTS_HEAD, at)) >= 0:
        garbage, before = garbage + start - at, before + start - at
        end = _pts_end(data, start + 4)
        if end == 0:
            return _pts_decoded(profile, numbers, ends, skipped, clocks, garbage, Rest(data[start:]), size, wrong)
        found = _pts_content(data[start + 4 : end - 6]) if end > 0 else None
        if found and found[0].size == profile.rows * profile.cols * profile.values:
            numbers.append(found[0])
            clocks.append(found[1])
            ends.append(end)
            skipped.append(before)
            at, before, size = end, 0, end - start
            continue
        if found:
            wrong = f"it sends {found[0].size // 6} pillars, its profile says {shown((profile.rows, profile.cols))}"
        step = end - start if end > 0 else 1
        at, garbage, before = start + step, garbage + step, before + step
    kept = max(at, len(data) - len(_PTS_HEAD) + 1)
    garbage += kept - at
    return _pts_decoded(profile, numbers, ends, skipped, clocks, garbage, Rest(data[kept:]), size, wrong)


def _pts_decoded(
    profile: SkinProfile, numbers: list[NDArray[Any]], ends: list[int], skipped: list[int],
    clocks: list[tuple[int, int]], garbage: int, rest: Rest, size: int, wrong: str,
) -> Decoded:  # fmt: skip
    counts, times_us = np.array(clocks, np.uint64).reshape(-1, 2).T & np.uint64(0xFFFFFFFF)
    return collected(
        profile, numbers, ends, skipped, garbage, rest, size,
        counts=counts.astype(np.int64), times_us=times_us.astype(np.int64), wrong=wrong,
    )  # fmt: skip


def _pts_end(data: bytes, begin: int) -> int:
    """Where the packet ends whose content begins at `begin`; 0 if more bytes are needed, -1 if there is no packet."""
    tail = begin
    while (tail := data.find(_PTS_TAIL, tail)) >= 0 and tail - begin <= MOST_PACKET:
        if tail - 2 > begin and sum(data[begin : tail - 2]) & 0xFFFF == _U16.unpack_from(data, tail - 2)[0]:
            return tail + len(_PTS_TAIL)
        tail += 1
    return 0 if tail < 0 and len(data) - begin <= MOST_PACKET else -1


def _pts_content(body: bytes) -> tuple[NDArray[Any], tuple[int, int]] | None:
    """Numbers of all pillars [pillars * 6], and (counter, microseconds); None if the body does not hold them."""
    try:
        blocks = _pts_table(body)
        ends = dict(pairwise([*sorted(blocks.values()), len(body)]))
        if ends[blocks[1]] - blocks[1] != _CLOCK.size:
            return None
        # the sum does not see bytes of 0 that are missing; then block 4 no longer begins with the number of sensors
        if 4 in blocks and _U16.unpack_from(body, blocks[4]) != _U16.unpack_from(body, blocks[3]):
            return None
        clock = _CLOCK.unpack_from(body, blocks[1])
        # nor those that were added; the lengths of the blocks do
        return _pts_pillars(body[: ends[blocks[3]]], blocks[3]), clock
    except (struct.error, KeyError, ValueError, IndexError):
        return None


def _pts_table(body: bytes) -> dict[int, int]:
    """Type -> offset of each block. The table ends where the first block begins. Raises struct.error, IndexError or
    ValueError where it does not fit."""
    width = body[0]
    if not 1 <= width <= 4:
        raise ValueError(f"offsets of {width} bytes")
    blocks: dict[int, int] = {}
    at, first = 1, len(body)
    while at + 2 + width <= first:
        offset = int.from_bytes(body[at + 2 : at + 2 + width], "little")
        blocks[_U16.unpack_from(body, at)[0]] = offset
        first, at = min(first, offset), at + 2 + width
    return blocks


def _pts_pillars(body: bytes, at: int) -> NDArray[Any]:
    """The block of type 3: sensors, their offsets, of each sensor its pillars, their offsets, and their numbers."""
    width = body[0]
    (sensors,) = _U16.unpack_from(body, at)
    at += 2 + sensors * width
    parts = []
    for _ in range(sensors):
        (pillars,) = _U16.unpack_from(body, at)
        at += 2 + pillars * width
        part = np.frombuffer(body, _PILLAR, pillars, at)
        if (part["type"] != 2).any():
            raise ValueError("numbers of another type")
        parts.append(part["values"].reshape(-1))
        at += part.nbytes
    if at != len(body):
        raise ValueError("a block of another length")
    return np.concatenate(parts)
