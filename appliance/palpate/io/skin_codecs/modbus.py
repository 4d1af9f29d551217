"""Skins that hold their taxels in registers of Modbus RTU (modbus.org, over serial line 1.02)."""

from __future__ import annotations

import numpy as np

from palpate.io import wire_numbers
from palpate.io.checksums import NAMED
from palpate.io.skin_codecs.frames import Decoded, Rest
from palpate.io.skin_codecs.segments import Part, gathered
from palpate.io.skin_profile import SkinProfile

MOST_REGISTERS = 125
"""Most registers of one request."""
_CRC = NAMED["crc16-modbus"]
_EXCEPTIONS = {
    1: "does not know function {function}; correct function",
    2: "has no such registers; correct register, rows or cols",
    3: "does not send so many registers; correct rows or cols",
}


def counts(profile: SkinProfile) -> list[int]:
    """The registers of each request of a frame. All differ: an answer holds no address, so its
    length shows its place."""
    each = wire_numbers.size(profile.number) // 2
    most, requests = MOST_REGISTERS // each, 1
    while True:
        lowest, more = divmod(profile.numbers - requests * (requests - 1) // 2, requests)
        parts = [lowest + i + (i >= requests - more) for i in range(requests)]
        if parts[-1] <= most:
            return [each * part for part in parts]
        requests += 1


def requests(profile: SkinProfile) -> list[bytes]:
    """The requests of one frame."""
    made, register = [], profile.register
    for count in counts(profile):
        words = register.to_bytes(2, "big") + count.to_bytes(2, "big")
        made.append(_summed(bytes([profile.unit_id, profile.function]) + words))
        register += count
    return made


def _summed(data: bytes) -> bytes:
    return data + _CRC.of(data).to_bytes(2, "little")


def decode(profile: SkinProfile, rest: Rest, new: bytes) -> Decoded:
    """Read the answers to `requests`, in their order."""
    lengths = [2 * count for count in counts(profile)]
    data, unit = rest.data + new, bytes([profile.unit_id])

    def read(data: bytes, at: int) -> Part | str | None:
        if len(data) < at + 5:
            return None
        function, length = data[at + 1], data[at + 2]
        if function == profile.function | 0x80 and _summed(data[at : at + 3]) == data[at : at + 5]:
            why = _EXCEPTIONS.get(length, "is not ready (exception {code}); lower rate_hz")
            return "it " + why.format(function=profile.function, code=length)
        if function != profile.function or length not in lengths:
            return ""
        begin, end = at + 3, at + 3 + length
        if len(data) < end + 2:
            return None
        if _summed(data[at:end]) != data[at : end + 2]:
            return "the checksum of an answer is wrong; check the cable, or lower rate_hz"
        raw = np.frombuffer(data, np.uint8, length, begin)
        numbers = wire_numbers.read(raw[None], profile.number, "big")[0]
        return Part(end + 2, lengths.index(length), numbers)

    return gathered(profile, unit, data, read)
