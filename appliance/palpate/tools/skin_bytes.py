"""`palpate skin check` for a skin with a profile: its first frames as they are read, next to their
bytes, and the first byte that does not fit the profile."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from palpate.core.types import shown
from palpate.io import skin_codecs
from palpate.io.skin_codecs import Decoded, Rest, fixed
from palpate.io.skin_profile import SkinProfile

SHOWN_FRAMES = 3
SHOWN_BYTES = 96
"""Most bytes of a frame that are printed."""
WIDTH = 16
"""Bytes of a printed line."""


Misfit = tuple[int, str]
"""The first byte that does not fit: its offset in the stream, and what is expected."""


def report(profile: SkinProfile, data: bytes) -> tuple[list[str], bool]:
    """The lines about the bytes of a skin, and whether all of them fit the profile, apart from the
    frames that were cut at the beginning and the end."""
    if not data:
        return ["no byte came; plug the skin in, or correct start, baud or skin.port"], False
    found = skin_codecs.codec(profile)(Rest(), data)
    spans = _spans(profile, found)
    lines = []
    for i, (begin, end) in enumerate(spans[:SHOWN_FRAMES]):
        lines.append(f"frame {i + 1}: bytes {begin} to {end - 1}, {shown(profile.format.shape)}")
        lines += dump(data, begin, min(end, begin + SHOWN_BYTES))
        lines.append(np.array2string(found.taxels[i], threshold=256, max_line_width=96))
    misfit = first_misfit(profile, data, found, spans)
    if misfit:
        at, why = misfit
        lines.append(f"byte {at} does not fit: {why}")
        lines += dump(data, max(0, at - WIDTH), min(len(data), at + WIDTH), at)
    lines.append(f"{len(found)} frames in {len(data)} bytes, {found.garbage} bytes in no frame")
    return lines, misfit is None and len(found) > 0 and not found.wrong


def dump(data: bytes, begin: int, end: int, marked: int = -1) -> Iterator[str]:
    """Bytes in hexadecimal with their offsets. marked: the offset of the byte in brackets."""
    for at in range(begin, end, WIDTH):
        line = data[at : min(at + WIDTH, end)]
        cells = [
            f"[{byte:02x}]" if at + i == marked else f" {byte:02x} " for i, byte in enumerate(line)
        ]
        text = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in line)
        yield f"  {at:06}  {''.join(cells):<{4 * WIDTH}}  {text}"


def first_misfit(
    profile: SkinProfile, data: bytes, found: Decoded, spans: list[tuple[int, int]]
) -> Misfit | None:
    """The first byte that does not fit; None if all fit."""
    if found.wrong:
        return spans[0][0] if spans else 0, found.wrong
    before = 0
    for begin, end in spans:
        # the first gap is the rest of a frame whose beginning was not heard
        if begin > before and (before or begin > end - begin):
            return _why(profile, data, before, found)
        before = end
    largest = max((end - begin for begin, end in spans), default=0)
    return _why(profile, data, before, found) if len(data) - before > 3 * largest else None


def _spans(profile: SkinProfile, found: Decoded) -> list[tuple[int, int]]:
    if profile.codec == "fixed":
        return [(int(end - found.size), int(end)) for end in found.ends]
    befores = np.append(0, found.ends[:-1]) + found.skipped
    return [(int(begin), int(end)) for begin, end in zip(befores, found.ends, strict=True)]


def _why(profile: SkinProfile, data: bytes, at: int, found: Decoded) -> Misfit:
    """The reason why no frame of the profile begins at or soon after `at`."""
    if profile.codec != "fixed":
        return at, found.misfit or "no frame of the profile begins here"
    layout = fixed.layout(profile)
    mark = layout.mark
    begin = data.find(mark, max(0, at - layout.tail))
    if begin < 0:
        return at, f"{mark.hex(' ')} does not come from here on; correct marker or trailer"
    due = begin + layout.period
    wrong = _first_difference(data[due : due + len(mark)], mark)
    if wrong is not None:
        after = data.find(mark, begin + 1)
        step = f"; it comes {after - begin} bytes after the last" if after > 0 else ""
        return due + wrong, (
            f"{data[due + wrong]:02x} where {mark[wrong]:02x} of {mark.hex(' ')} is expected,"
            f" {layout.period} bytes after the last{step}"
        )
    sent, right = layout.sums(data[begin:due])
    if due <= len(data) and (wrong := _first_difference(sent, right)) is not None:
        expected = f"the {profile.checksum} is {sent.hex(' ')}, {right.hex(' ')} is expected"
        return begin + layout.check + wrong, expected
    return begin, found.misfit or "the beginning of a frame is ambiguous here"


def _first_difference(sent: bytes, expected: bytes) -> int | None:
    """Index of the first byte that differs, as far as `sent` goes; None if none does."""
    pairs = zip(sent, expected, strict=False)
    return next((i for i, (one, other) in enumerate(pairs) if one != other), None)
