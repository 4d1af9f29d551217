"""Packets of Robotiq's TSF-85 fingertips. Only their grids of static pressure are used."""

from __future__ import annotations

import numpy as np

from palpate.io.skin_codecs.frames import Decoded, Gathering, Rest
from palpate.io.skin_profile import SkinProfile

_TSF_START = b"\x9a\x00"
_TSF_HEADER = 4
_TSF_TAXELS = 28
_TSF_READ, _TSF_AUTOSEND = 0x61, 0x58
_TSF_FIELDS = {0x10: 2 * _TSF_TAXELS, 0x20: 2, 0x30: 6, 0x40: 6, 0x50: 6, 0x60: 2, 0x70: 8}
"""Type of a field (high nibble) -> bytes of its numbers. 0x10 is the grid. The others are dynamic
pressure, accelerometer, gyroscope, magnetometer, temperature, time stamp."""


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Packets of fields without a checksum; a packet ends where the next begins. A frame is
    complete with the grids of all fingers, in one packet or in several."""
    data, frames = rest.data + new, Gathering(profile)
    fingers = profile.rows * profile.cols // _TSF_TAXELS
    grids: dict[int, bytes] = {}
    at = 0
    while (end := _tsf_end(data, at)) != 0:
        fields = _tsf_fields(data[at + _TSF_HEADER : end]) if end > 0 else None
        if fields is None:
            found = data.find(_TSF_START, at + 1)
            at = found if found >= 0 else len(data) - data.endswith(_TSF_START[:1])
        if fields is None or grids.keys() & fields.keys():
            # no packet, or a finger's grid is missing: the current frame is incomplete
            frames.waste(at)
            grids = {}
        if fields is None:
            continue
        grids |= {finger: grid for finger, grid in fields.items() if finger < fingers}
        at = end
        if len(grids) == fingers:
            frames.frame(end, [np.frombuffer(grids[i], ">u2") for i in sorted(grids)])
            grids = {}
    return frames.decoded(Rest(data[frames.begun :]))


def _tsf_end(data: bytes, at: int) -> int:
    """The end of the packet at `at`; 0 if more bytes are needed, -1 if no packet begins there."""
    head = data[at : at + _TSF_HEADER]
    if not head.startswith(_TSF_START[: len(head)]):
        return -1
    if len(head) < _TSF_HEADER:
        return 0
    end = at + _TSF_HEADER + head[3]
    after = data[end : end + len(_TSF_START)]
    if head[2] not in (_TSF_READ, _TSF_AUTOSEND) or not after.startswith(_TSF_START[: len(after)]):
        return -1
    return end if len(after) == len(_TSF_START) else 0


def _tsf_fields(content: bytes) -> dict[int, bytes] | None:
    """Finger -> bytes of its grid, of one packet; None if the fields do not fill it exactly."""
    grids: dict[int, bytes] = {}
    at = 0
    while at < len(content):
        kind, finger = content[at] & 0xF0, content[at] >> 2 & 3
        size = _TSF_FIELDS.get(kind)
        if size is None or at + 1 + size > len(content):
            return None
        if kind == 0x10:
            grids[finger] = content[at + 1 : at + 1 + size]
        at += 1 + size
    return grids
