"""Checksums of frames: sums, exclusive ors and cyclic redundancy checks with any parameters.

Names and parameters of the cyclic redundancy checks: Cook, Catalogue of parametrised CRC
algorithms (reveng.sourceforge.io/crc-catalogue).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from operator import xor
from typing import Any

KINDS = {"sum8": 1, "sum16": 2, "xor8": 1, "crc8": 1, "crc16": 2, "crc32": 4}
"""Kinds of checksums and their bytes."""
_PARAMETERS = re.compile(r"(poly|init|xorout)=([0-9a-f]{1,8})")


@dataclass(frozen=True, slots=True)
class Checksum:
    """A checksum of bytes. kind: one of KINDS. poly: polynomial of a CRC, its highest bit left out.
    init: value before the first byte. xorout: exclusive or at the end. reflected: a CRC that
    processes the lowest bit of a byte first."""

    kind: str
    poly: int = 0
    init: int = 0
    xorout: int = 0
    reflected: bool = False

    @property
    def size(self) -> int:
        return KINDS[self.kind]

    def of(self, data: bytes) -> int:
        value, most = self.init, (1 << 8 * self.size) - 1
        if self.kind.startswith("sum"):
            value = (value + sum(data)) & most
        elif self.kind.startswith("xor"):
            value = reduce(xor, data, value)
        else:
            value = self._crc(data)
        return value ^ self.xorout

    def _crc(self, data: bytes) -> int:
        bits = 8 * self.size
        table, most = _table(self.poly, bits, self.reflected), (1 << bits) - 1
        value = mirrored(self.init, bits) if self.reflected else self.init
        if self.reflected:
            for byte in data:
                value = table[(value ^ byte) & 0xFF] ^ (value >> 8)
        else:
            for byte in data:
                value = table[(value >> (bits - 8)) ^ byte] ^ (value << 8 & most)
        return value


def mirrored(value: int, bits: int) -> int:
    """`value` with its bits in reverse order."""
    return int(f"{value:0{bits}b}"[::-1], 2)


@lru_cache(4)
def _table(poly: int, bits: int, reflected: bool) -> list[int]:
    """The CRC of each byte."""
    table, most = [], (1 << bits) - 1
    for byte in range(256):
        value = byte << (bits - 8)
        for _ in range(8):
            value = (value << 1 ^ (poly if value >> (bits - 1) else 0)) & most
        table.append(value)
    if not reflected:
        return table
    return [mirrored(table[mirrored(byte, 8)], bits) for byte in range(256)]


def _crc(kind: str, parameters: str) -> Checksum:
    poly, init, xorout, order = parameters.split()
    return Checksum(kind, int(poly, 16), int(init, 16), int(xorout, 16), order == "reflected")


NAMED = {
    "sum8": Checksum("sum8"),
    "sum8-inverted": Checksum("sum8", xorout=0xFF),
    "sum8-negated": Checksum("sum8", init=0xFF, xorout=0xFF),
    "sum16": Checksum("sum16"),
    "sum16-inverted": Checksum("sum16", xorout=0xFFFF),
    "sum16-negated": Checksum("sum16", init=0xFFFF, xorout=0xFFFF),
    "xor8": Checksum("xor8"),
    "crc8": _crc("crc8", "07 00 00 plain"),
    "crc8-maxim": _crc("crc8", "31 00 00 reflected"),
    "crc8-sae-j1850": _crc("crc8", "1d ff ff plain"),
    "crc8-rohc": _crc("crc8", "07 ff 00 reflected"),
    "crc16-ccitt-false": _crc("crc16", "1021 ffff 0000 plain"),
    "crc16-xmodem": _crc("crc16", "1021 0000 0000 plain"),
    "crc16-kermit": _crc("crc16", "1021 0000 0000 reflected"),
    "crc16-x25": _crc("crc16", "1021 ffff ffff reflected"),
    "crc16-modbus": _crc("crc16", "8005 ffff 0000 reflected"),
    "crc16-arc": _crc("crc16", "8005 0000 0000 reflected"),
    "crc32": _crc("crc32", "04c11db7 ffffffff ffffffff reflected"),
    "crc32-mpeg2": _crc("crc32", "04c11db7 ffffffff 00000000 plain"),
    "crc32c": _crc("crc32", "1edc6f41 ffffffff ffffffff reflected"),
}
"""Checksums by name. A negated sum makes the sum of all bytes with it 0."""


def parsed(text: str) -> Checksum | None:
    """The checksum that `text` describes; None if it describes none. A name of NAMED, or one of
    KINDS, may be followed by parameters in hexadecimal: "crc8 poly=1d init=fd xorout=00 reflected".
    """
    name, *words = text.split() or [""]
    kind = name if name in KINDS else ""
    made = NAMED.get(name) or (Checksum(kind) if kind else None)
    if made is None:
        return None
    if words and kind.startswith("crc"):
        made = Checksum(kind)  # nothing of the named check remains next to given parameters
    for word in words:
        match = _PARAMETERS.fullmatch(word)
        if word == "reflected":
            made = replace(made, reflected=True)
        elif match and int(match[2], 16) < 1 << 8 * made.size:
            values: dict[str, Any] = {match[1]: int(match[2], 16)}
            made = replace(made, **values)
        else:
            return None
    return made if made.poly or not made.kind.startswith("crc") else None
