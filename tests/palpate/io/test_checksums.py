"""Checksums by name and by parameters, against published check values."""

from __future__ import annotations

import pytest

from palpate.io.checksums import NAMED, Checksum, parsed

CHECK = {
    "sum8": 0xDD,
    "sum16": 0x01DD,
    "xor8": 0x31,
    "crc8": 0xF4,
    "crc8-maxim": 0xA1,
    "crc8-sae-j1850": 0x4B,
    "crc8-rohc": 0xD0,
    "crc16-ccitt-false": 0x29B1,
    "crc16-xmodem": 0x31C3,
    "crc16-kermit": 0x2189,
    "crc16-x25": 0x906E,
    "crc16-modbus": 0x4B37,
    "crc16-arc": 0xBB3D,
    "crc32": 0xCBF43926,
    "crc32-mpeg2": 0x0376E6E7,
    "crc32c": 0xE3069283,
}
"""Of the nine bytes "123456789", from the catalogue named in `checksums`; sums by hand."""


@pytest.mark.parametrize("name", sorted(CHECK))
def test_the_check_values_of_the_catalogue(name):
    """Each name gives the value that the catalogue prints."""
    assert NAMED[name].of(b"123456789") == CHECK[name]


def test_sums_and_parameters_describe_checksums():
    """Negated all bytes sum to 0; polynomial, initial value, exclusive or."""
    data = b"\x12\xff\x80\x01"
    assert (sum(data) + NAMED["sum8-negated"].of(data)) & 0xFF == 0
    assert (sum(data) + NAMED["sum16-negated"].of(data)) & 0xFFFF == 0
    assert (sum(data) + NAMED["sum8-inverted"].of(data)) & 0xFF == 0xFF
    icode = Checksum("crc8", 0x1D, 0xFD)
    assert parsed("crc8 poly=1d init=fd xorout=00") == icode
    assert icode.of(b"123456789") == 0x7E  # CRC-8/I-CODE
    # those of the catalogue that have no name here
    for text, value in {
        "crc8 poly=31 init=ff": 0xF7,
        "crc8 poly=39 reflected": 0x15,
        "crc16 poly=1021 init=1d0f": 0xE5CC,
        "crc16 poly=3d65 xorout=ffff reflected": 0xEA82,
        "crc32 poly=04c11db7 init=ffffffff xorout=ffffffff": 0xFC891918,
    }.items():
        assert parsed(text).of(b"123456789") == value
    assert parsed("sum8 init=5a") == Checksum("sum8", init=0x5A)
    for text in ("", "crc8 poly=0", "crc7", "crc8 poly=1d1", "crc8 poly=xx", "sum8 fast", "crc16"):
        assert parsed(text) is None, text
