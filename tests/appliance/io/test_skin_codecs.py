"""The bytes of each skin, put together by hand from published layouts: frames, and bytes that are
not frames."""

from __future__ import annotations

import struct
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.io.skin_codecs import Decoded, Rest, arranged, codec, fixed
from appliance.io.skin_profile import SkinProfile
from tests.factories.skin_wires import NAMES, papillarray, profile, taxels, wire

SMALL = SkinProfile(about="a", source="s", codec="fixed", marker=b"\xaa\x55", rows=2, cols=3)


def decoded(p: SkinProfile, data: bytes) -> Decoded:
    """All bytes decoded at once."""
    return codec(p)(Rest(), data)


def test_a_matrix_byte_by_byte():
    """AA 55 and six bytes, three times: two frames, since no mark follows the third yet."""
    frame = bytes.fromhex("aa55 010203040506")
    found = decoded(SMALL, frame * 3)
    assert found.taxels.tolist() == [[[1, 2, 3], [4, 5, 6]]] * 2
    assert found.ends.tolist() == [8, 16]
    assert (found.garbage, found.rest.data, found.rest.synced) == (0, frame, True)


def test_anyskin_byte_by_byte():
    """Five times (t, x, y, z), CR LF: 82 bytes. The temperature is left out, z is last. The first
    frame has no mark before it and is not used."""
    values = [25.0, 1.0, 2.0, 3.0] * 4 + [25.0, 7.0, 8.0, 9.5]
    frame = struct.pack("<20f", *values) + b"\r\n"
    assert len(frame) == 82
    found = decoded(profile("anyskin"), frame * 4)
    assert found.taxels.shape == (3, 5, 1, 3)
    assert found.taxels[0, 0, 0].tolist() == [1, 2, 3]
    assert found.taxels[0, 4, 0].tolist() == [7, 8, 9.5]
    assert found.rest.data == b"\r\n"


def test_reskin_and_vitac_lines():
    """Decimal text with tabs or blanks; rows on lines that a shorter line ends; a number outside
    the range of its type makes the row invalid."""
    found = decoded(profile("reskin"), b"25.0\t1\t-2.5\t3e2\t" * 4 + b"25,1,2,3\r\n" + b"1 2 3\n")
    assert found.taxels[0, 0, 0].tolist() == [1, -2.5, 300]
    assert (len(found), found.garbage) == (1, 6)
    p = replace(profile("3d-vitac"), rows=2, cols=2, number="uint8")
    found = decoded(
        p, b"3 4\n\n1 2\n3 4\n\n5 6\n7 256\n\n1 2\n3 4\n5 6\n\n9 9\r\n8 8\r\n7\r\n1 x\n1 1\n\n"
    )
    assert found.taxels.tolist() == [[[1, 2], [3, 4]], [[9, 9], [8, 8]]]
    assert found.skipped.tolist() == [5, 11 + 13]


@pytest.mark.parametrize(
    "word", [b"1_0", b"0x10", b"1.5", b"+-1", b"", b"nan", b"99999999999999999999", b"-1"]
)
def test_a_word_that_is_no_whole_number(word: bytes):
    """A text of whole numbers contains no other word."""
    p = replace(profile("3d-vitac"), rows=1, cols=2)
    assert len(decoded(p, b"1 2 \n\n1 " + word + b"\n\n")) == 1


def test_papillarray_byte_by_byte():
    """One sensor of nine pillars: forces, count and microseconds of its clock. A packet with a
    wrong sum, or with additional zero bytes, which the sum does not detect, is not a frame."""
    p = profile("papillarray")
    data = wire("papillarray", 5)
    found = decoded(p, data)
    assert (found.taxels[0] == taxels(p, 5)).all()
    assert (found.counts.tolist(), found.times_us.tolist()) == ([1005], [5_005_000])
    assert len(decoded(p, data[:30] + bytes([data[30] ^ 1]) + data[31:])) == 0
    at = data.index(b"\x02\x00", 40)
    assert len(decoded(p, data[:at] + bytes(26) + data[at:])) == 0
    assert len(decoded(p, data[:-6] + bytes(7) + data[-6:])) == 0


def test_papillarray_with_a_tail_inside():
    """AA BB CC DD among the numbers does not end the packet, since the sum does not fit there."""
    p = profile("papillarray")
    grid = np.zeros((3, 3, 6), np.float32)
    grid[1, 1, 2] = struct.unpack("<f", b"\xaa\xbb\xcc\xdd")[0]
    found = decoded(p, papillarray(grid, 1) * 2)
    assert len(found) == 2
    assert found.taxels[0, 1, 1, 2] == grid[1, 1, 2]
    assert found.garbage == 0


def test_papillarray_of_changing_form():
    """Packets of the same length with other offsets of pillars are read by their own tables, and
    invalid packets are left out. The result is the same whether packets come at once or one by one.
    """
    p = replace(profile("papillarray"), rows=6)
    grids = [np.arange(108, dtype=np.float32).reshape(6, 3, 6) + i for i in range(5)]
    data = [papillarray(grid, i, sensors=2 if i % 2 else 1) for i, grid in enumerate(grids)]
    # garbage, after which all packets are equally far apart
    data[2] += bytes(len(data[1]) - len(data[2]))
    alike = papillarray(grids[0], 7, sensors=2)
    other = bytearray(alike)
    at = other.index(b"\x02\x00", 40)
    other[at], other[at + 2] = (
        3,
        (other[at + 2] - 1) % 256,
    )  # numbers of another type with the same sum
    stream = [*data, alike, bytes(other), alike]
    found = decoded(p, b"".join(stream))
    single = [decoded(p, packet).taxels for packet in stream]
    assert found.taxels.tolist() == np.concatenate(single).tolist()
    assert [len(one) for one in single] == [1, 1, 1, 1, 1, 1, 0, 1]
    assert found.taxels[3].tolist() == grids[3][..., :3].tolist()
    assert found.skipped.tolist() == [0, 0, 0, len(data[2]) - len(data[0]), 0, 0, len(other)]


def test_papillarray_of_two_sensors():
    """Two sensors are 6x3, one below the other; with a profile of 3x3 the error says that this is
    another skin."""
    grid = np.arange(108, dtype=np.float32).reshape(6, 3, 6)
    data = papillarray(grid, 1, sensors=2)
    found = decoded(replace(profile("papillarray"), rows=6), data)
    assert found.taxels[0].tolist() == grid[..., :3].tolist()
    wrong = decoded(profile("papillarray"), data)
    assert (len(wrong), wrong.wrong) == (0, "it sends 18 pillars, its profile says 3x3")


def test_xela_byte_by_byte():
    """t 710 8 and eight bytes: X Y Z big-endian in bytes 1 to 6. Answers of the adapter are not
    garbage. A first byte of X from FA on marks a missing value, and a frame without a taxel is
    invalid."""
    p = replace(profile("xela-can"), rows=1, cols=2)
    lines = [b"t7108001234567800FF00\r", b"t71180000010002000300\r"]
    found = decoded(p, b"\r\az\r" + b"".join(lines) + b"z\r")
    assert found.taxels.tolist() == [[[[0x1234, 0x5678, 0xFF], [1, 2, 3]]]]
    assert found.garbage == 0
    assert len(decoded(p, lines[0].replace(b"00123", b"00FA3") + lines[1])) == 0
    found = decoded(p, lines[0] + lines[0] + lines[1])
    assert (len(found), found.skipped.tolist()) == (1, [len(lines[0])])
    assert len(decoded(p, lines[1] + lines[0])) == 0
    assert decoded(p, b"t71280000010002000300\r" * 4).wrong == "it sends taxels beyond 1x2"


def test_robotiq_byte_by_byte():
    """The grids of two fingers in one packet or in two, big-endian; other fields are ignored; the
    last packet waits for the next."""
    p = profile("robotiq-tsf")
    fingers = [
        bytes([0x10 | k << 2]) + struct.pack(">28H", *range(1000 * k, 1000 * k + 28))
        for k in (0, 1)
    ]
    dynamic = b"\x20\x00\x07"
    head = bytes.fromhex("9a0061")
    one = head + bytes([len(fingers[0] + dynamic + fingers[1])]) + fingers[0] + dynamic + fingers[1]
    two = b"".join(head + bytes([len(f)]) + f for f in fingers)
    version = bytes.fromhex("9a00e302 3031")
    found = decoded(p, one + two + version + one)
    assert len(found) == 2
    for frame in found.taxels:
        assert frame.reshape(-1).tolist() == [*range(28), *range(1000, 1028)]
    assert decoded(p, two[: len(two) // 2] + one + head).taxels.shape == (1, 14, 4)


@pytest.mark.parametrize(
    ("orientation", "wanted"),
    [
        ((), [[1, 2, 3], [4, 5, 6]]),
        (("transpose",), [[1, 4], [2, 5], [3, 6]]),
        (("flip-rows",), [[4, 5, 6], [1, 2, 3]]),
        (("flip-columns",), [[3, 2, 1], [6, 5, 4]]),
        (("transpose", "flip-rows"), [[3, 6], [2, 5], [1, 4]]),
    ],
)
def test_orientation(orientation: tuple[str, ...], wanted: list[list[int]]):
    """Turns in their order; the format has the shape of the result."""
    p = replace(SMALL, orientation=orientation)
    got = arranged(p, np.arange(1, 7, dtype=np.uint8)[None])
    assert got[0].tolist() == wanted
    assert p.format.shape == got.shape[1:]


def test_numbers_of_either_byte_order_and_a_count():
    """Big-endian int16 with a uint16 count after the marker."""
    p = replace(SMALL, number="int16", byte_order="big", sequence="uint16", rows=1, cols=2)
    frame = b"\xaa\x55" + struct.pack(">Hhh", 65535, -2, 300)
    found = decoded(p, frame * 3)
    assert found.taxels.tolist() == [[[-2, 300]]] * 2
    assert found.counts.tolist() == [65535] * 2
    assert found.taxels.dtype == np.dtype("<i2")


@pytest.mark.parametrize("name", NAMES)
def test_split_or_whole_is_the_same(name: str):
    """Any split gives the frames, ends, garbage of the whole, with garbage in between."""
    p = profile(name)
    data = wire(name, 0)[7:] + b"".join(
        wire(name, i) + b"\xaa\x55garbage\r\n" * (i == 4) for i in range(9)
    )
    whole = decoded(p, data)
    assert len(whole) >= 5
    for size in (1, 2, 7, 50, 400):
        rest, frames, garbage = Rest(), [], 0
        for at in range(0, len(data), size):
            part = codec(p)(rest, data[at : at + size])
            rest, garbage = part.rest, garbage + part.garbage
            frames += list(part.taxels)
        assert np.array_equal(frames, whole.taxels), size
        assert (garbage, rest.data) == (whole.garbage, whole.rest.data)


@pytest.mark.parametrize("name", NAMES)
@given(data=st.binary(max_size=600), at=st.integers(0, 500))
def test_no_bytes_raise(name: str, data: bytes, at: int):
    """Any bytes, also in the middle of frames: no exception, every byte is in a frame, garbage, or
    left over."""
    p = profile(name)
    sent = wire(name, 0) + wire(name, 1)
    mixed = sent[:at] + data + sent[at:]
    for one in (data, mixed):
        found = decoded(p, one)
        inside = len(one) - found.garbage - len(found.rest.data)
        assert 0 <= inside <= len(one)
        assert (inside > 0) == (len(found) > 0) or name in (
            "xela-can",
            "anyskin",
            "reskin",
            "3d-vitac",
        )
        assert len(found.ends) == len(found.skipped) == len(found.taxels)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_left_over_stays_small(name: str):
    """Bytes without an end do not pile up."""
    decode = partial(codec(profile(name)))
    for fill in (b"\x00", b"\xaa\x55", b"7", b"\x55\x66\x77\x88", b"\x9a\x00\x61\xff"):
        rest = Rest()
        for _ in range(300):
            rest = decode(rest, fill * 500).rest
            assert len(rest.data) < 200_000


@pytest.mark.parametrize("name", ["matrix", "flexitac", "anyskin"])
def test_nothing_but_marks_is_passed_over(name: str, monkeypatch: pytest.MonkeyPatch):
    """Frames full of marks have no recognizable beginning. They are skipped as a whole and not byte
    by byte, which would take longer than their arrival: the number of tried positions shows it."""
    p, looked = profile(name), []
    begins = fixed._begins
    monkeypatch.setattr(fixed, "_begins", lambda *args: looked.append(1) or begins(*args))
    data = (p.trailer + p.marker) * 15_000
    found = decoded(p, data)
    assert len(found) == 0
    assert len(looked) <= len(data) // fixed._layout(p).period + 1
