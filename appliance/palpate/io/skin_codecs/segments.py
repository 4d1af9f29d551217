"""Frames in one part or several, each with a marker, and perhaps a length, a number and a checksum;
runs of zeros may be shortened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.io import checksums, wire_numbers
from palpate.io.skin_codecs.frames import MOST_PACKET, Decoded, Gathering, Rest
from palpate.io.skin_profile import FIELD_BYTES, SkinProfile


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A part of a frame. end: its end in the stream."""

    end: int
    index: int
    numbers: NDArray[Any]


ReadPart = Callable[[bytes, int], Part | str | None]
"""Reads the part whose marker is at an offset: why it is none, or None if bytes are missing."""


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Read parts as the profile describes. Without a checksum or a trailer, a part counts once
    the next one follows."""
    return gathered(profile, profile.marker, rest.data + new, lambda d, at: _part(profile, d, at))


def gathered(profile: SkinProfile, marker: bytes, data: bytes, read: ReadPart) -> Decoded:
    """The frames of all parts."""
    frames, at, misfit = Gathering(profile), 0, ""
    while (at := data.find(marker, at)) >= 0:
        part = read(data, at)
        if part is None:
            break
        if isinstance(part, str):
            misfit, at = part or misfit, at + 1
            continue
        frames.put(at, part.end, part.index, part.numbers)
        at = part.end
    if not frames.open:  # a marker may have begun
        frames.waste(at if at >= 0 else max(frames.begun, len(data) - len(marker) + 1))
    if len(data) - frames.begun > MOST_PACKET + 4 * profile.body:
        frames.waste(len(data))
    return frames.decoded(Rest(data[frames.begun :]), misfit)


def _part(p: SkinProfile, data: bytes, at: int) -> Part | str | None:
    head = at + len(p.marker)
    begin = head + p.skip_before
    if begin > len(data):
        return None
    count, size = p.segment or p.numbers, wire_numbers.size(p.number)
    each = size if p.length_of == "numbers" else 1
    length = _field(p, data, head + p.length_at, p.length) * each if p.length else count * size
    if not 0 < length <= MOST_PACKET or length % (size * len(p.number.split())):
        return f"a part is {length} bytes long; correct length, length_at or number"
    found = _numbers(p, data, begin, None if p.zeros and not p.length else length, count)
    if found is None or isinstance(found, str):
        return found
    numbers, end = found
    index = _field(p, data, head + p.index_at, p.index) if p.index else 0
    if not p.index and len(numbers) != p.numbers:
        return f"a frame holds {len(numbers)} numbers, not {p.numbers}; correct rows and cols"
    closed = _closed(p, data, at, end + p.skip_after)
    return Part(closed, index, numbers) if isinstance(closed, int) else closed


def _closed(p: SkinProfile, data: bytes, at: int, check: int) -> int | str | None:
    """The end of a part whose checksum stands at `check`."""
    checksum = checksums.parsed(p.checksum)
    end = check + (checksum.size if checksum else 0)
    follows = p.trailer if p.trailer or checksum else p.marker
    if end + len(follows) > len(data):
        return None
    if checksum:
        sent = int.from_bytes(data[check:end], p.checksum_order or p.byte_order)
        if checksum.of(data[at + p.checksum_from : check]) != sent:
            return f"the {p.checksum} is wrong; correct checksum, checksum_from or checksum_order"
    if data[end : end + len(follows)] != follows:
        return f"no {follows.hex(' ')} follows; correct skip_before, skip_after, segment or length"
    return end + len(p.trailer)


def _field(p: SkinProfile, data: bytes, at: int, kind: str) -> int:
    return int.from_bytes(data[at : at + FIELD_BYTES[kind]], p.byte_order)


def _numbers(
    p: SkinProfile, data: bytes, begin: int, length: int | None, count: int
) -> tuple[NDArray[Any], int] | str | None:
    """The numbers of a part and their end. length: their bytes; None if they end with the
    `count`th number."""
    size = wire_numbers.size(p.number)
    end = begin + (len(data) - begin) // size * size if length is None else begin + length
    if end > len(data):
        return None
    raw = np.frombuffer(data, np.uint8, end - begin, begin)[None]
    numbers = wire_numbers.read(raw, p.number, p.byte_order)[0] if end > begin else raw[0]
    if not p.zeros:
        return numbers, end
    most = count if length is None else len(data) * 256
    values, used = _expanded(numbers.tolist(), most)
    if length is None and len(values) < count:
        return None
    if len(values) > p.numbers or (length is not None and used * size != length):
        return "a run of zeros is too long; correct zeros, rows or cols"
    return np.array(values, numbers.dtype), begin + used * size


def _expanded(numbers: list[int], most: int) -> tuple[list[int], int]:
    """The numbers with their runs of zeros, at least `most` if there are so many, and how many were
    used."""
    values: list[int] = []
    at = 0
    while at < len(numbers) and len(values) < most:
        if numbers[at]:
            values.append(numbers[at])
            at += 1
        elif at + 1 < len(numbers):
            values += [0] * min(numbers[at + 1], most + 1)
            at += 2
        else:
            break
    return values, at
