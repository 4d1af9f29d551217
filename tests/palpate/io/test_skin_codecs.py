"""The bytes of each skin, put together by hand from published layouts, and other bytes."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core.errors import ConfigError
from palpate.io.skin_codecs import Decoded, Rest, arranged, codec, fixed
from palpate.io.skin_profile import SkinProfile
from tests.factories.skin_wires import NAMES, papillarray, profile, taxels, wire

SMALL = SkinProfile(about="a", source="s", codec="fixed", marker=b"\xaa\x55", rows=2, cols=3)


def decoded(p: SkinProfile, data: bytes) -> Decoded:
    """All bytes decoded at once."""
    return codec(p)(Rest(), data)


def test_a_matrix_byte_by_byte():
    """Two frames of three, no mark follows yet; noise but its last byte; a count behind."""
    frame = bytes.fromhex("aa55 010203040506")
    found = decoded(SMALL, frame * 3)
    assert found.taxels.tolist() == [[[1, 2, 3], [4, 5, 6]]] * 2
    assert found.ends.tolist() == [8, 16]
    assert (found.garbage, found.rest.data, found.rest.synced) == (0, frame, True)
    found = decoded(SMALL, bytes(100))
    assert (len(found), found.garbage, found.rest.data) == (0, 99, b"\0")
    p = replace(SMALL, sequence="uint8", sequence_at=6)
    found = decoded(p, b"".join(b"\xaa\x55" + bytes([i] * 6) + bytes([i + 9]) for i in range(5)))
    assert found.counts.tolist() == [9, 10, 11, 12]
    assert found.taxels[1].tolist() == [[1, 1, 1], [1, 1, 1]]


@pytest.mark.parametrize("cut", [0, 3])
def test_a_mark_among_the_numbers_of_some_frames(cut):
    """Frames begin at the mark that stays, also after the other."""
    numbers = ["01aa55040506"] * 3 + ["010203040506"] * 6
    data = b"".join(bytes.fromhex("aa55" + six) for six in numbers)[cut:]
    found = decoded(SMALL, data)
    assert found.garbage == (8 - cut) % 8
    wanted = [[[1, 170, 85], [4, 5, 6]]] * 3 + [[[1, 2, 3], [4, 5, 6]]] * 6
    assert found.taxels.tolist() == wanted[len(wanted) - 1 - len(found) : -1]
    assert len(found) == 8 - (cut > 0)


def test_a_frame_with_count_checksum_and_ignored_bytes():
    """All that a profile can say; a frame with a wrong checksum is garbage."""
    profile = SkinProfile(
        about="a",
        source="s",
        codec="fixed",
        marker=b"\xf0\x0f",
        trailer=b"\r\n",
        skip_before=2,
        skip_after=1,
        sequence="uint16",
        sequence_at=1,
        sequence_order="big",
        checksum="crc16-modbus",
        checksum_from=2,
        number="uint16",
        byte_order="little",
        checksum_order="big",
        rows=2,
        cols=3,
    )

    def modbus(data: bytes) -> int:
        """CRC-16/MODBUS bit by bit, as its specification has it."""
        value = 0xFFFF
        for byte in data:
            value ^= byte
            for _ in range(8):
                value = value >> 1 ^ (0xA001 if value & 1 else 0)
        return value

    def full(i: int, wrong: int = 0) -> bytes:
        """Frame `i` of it: mark, ignored byte, count, ignored, six numbers, ignored, sum, end."""
        body = b"\x07" + struct.pack(">H", i % 65536) + b"\x08"
        body += struct.pack("<6H", *((i * 31 + k) % 4000 for k in range(6))) + b"\x09"
        return b"\xf0\x0f" + body + struct.pack(">H", modbus(body) ^ wrong) + b"\r\n"

    frames = [full(i, wrong=i == 65533) for i in range(65530, 65540)]
    found = decoded(profile, b"\r\n" + b"".join(frames) + frames[0])
    good = [i for i in range(65530, 65540) if i != 65533]
    assert found.counts.tolist() == [i % 65536 for i in good]
    assert found.taxels[0].tolist() == [
        [(65530 * 31 + k + 3 * r) % 4000 for k in range(3)] for r in range(2)
    ]
    size = len(frames[0])
    assert (found.garbage, found.size, found.skipped.tolist()[3]) == (size, size, size)
    assert "crc16-modbus" in found.misfit
    # in parts, too
    rest, counts = Rest(), []
    for at in range(0, len(frames) * size, 17):
        part = codec(profile)(rest, (b"\r\n" + b"".join(frames) + frames[0])[at : at + 17])
        rest = part.rest
        counts += part.counts.tolist()
    assert counts == found.counts.tolist()[: len(counts)]
    assert len(counts) >= len(good) - 1


TEXT = SkinProfile(about="a", source="s", codec="text", lines="frames", number="float32", rows=1)


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({}, b"[1, -2.5, 3e2, nan]"),
        ({}, b"((1 -2.5) (3e2 nan))"),
        ({}, b"1,-2.5,300,ovf"),
        ({}, b"1,-2.5,300,-inf"),
        ({"around": "S#:S#:S#:S#:"}, b"S1:1 S2:-2.5 S3:300 S4:OVF"),
        ({"skip_columns": (0,)}, b"65538,1,-2.5,300,nan"),
        ({"skip_columns": (0, 5)}, b"7\t1\t-2.5\t300\tnan\t9"),
        ({"around": "S#:S#:S#:S#:"}, b"S1:1 S2:-2.5 S3:300 S4:nan"),
        (
            {"around": "taxel_#=taxel_#=taxel_#=taxel_#="},
            b"taxel_1=1,taxel_2=-2.5,taxel_3=3e2,taxel_4=NaN",
        ),
        ({"around": '"t":"v":', "skip_columns": (0,)}, b'{"t": 5, "v": [[1, -2.5], [300, null]]}'),
        ({"around": "#:#:#:#:"}, b"0:1 1:-2.5 2:300 3:nan"),
        ({"around": "->"}, b"12:00:59.123 -> 1 -2.5 300 nan"),
        ({"around": "mVmVmVmV"}, b"1mV -2.5mV 300.0mV nan mV"),
        ({"around": "$SKIN"}, b"$SKIN,1,-2.5,300,nan*78"),
        ({"decimal": ","}, b"1;-2,5;300,0;nan"),
        ({"line_end": "\r"}, b"1 -2.5 300 nan"),
    ],
)
def test_lines_with_other_text_around_their_numbers(keys, line):
    """Brackets, labels, JSON, units, times, NMEA: numbers are read, other text is not."""
    p = replace(TEXT, cols=4, **keys)
    end = p.line_end.encode()
    found = decoded(p, line + end + b"boot: 1 2 3 4" + end + line + end)
    assert len(found) == 2, found.misfit
    np.testing.assert_array_equal(found.taxels[0, 0], np.float32([1, -2.5, 300, np.nan]))
    if b"*" in line:
        assert len(decoded(p, line.replace(b"5", b"6") + end)) == 0, "the sum of NMEA is wrong"


@pytest.mark.parametrize(
    ("number", "line", "misfit"),
    [
        ("uint16", b"1 -3 2 4", "-3, which uint16"),
        ("uint16", b"1 2.5 2 4", "2.5, which uint16"),
        ("int16", b"1 40000 2 4", "40000, which int16"),
        ("float32", b"1 1e39 2 4", "1e39, which float32"),
        ("uint16", b"a:1 b:2 c:3 d:4", "'a:b:c:d:'"),
    ],
)
def test_the_value_that_does_not_fit_is_named(number, line, misfit):
    """A line that is refused says why."""
    found = decoded(replace(TEXT, cols=4, number=number), line + b"\n")
    assert (len(found), found.garbage) == (0, len(line) + 1)
    assert misfit in found.misfit


def test_lines_between_other_lines():
    """A frame ends with another line; without the prefix a line is neither frame nor garbage."""
    p = replace(TEXT, lines="rows", rows=2, cols=2)
    for text in (b"1 2\n3 4\n---\n", b"1,2\n3,4\nFrame 12\n", b"[[1 2]\n [3 4]]\n"):
        found = decoded(p, text * 3)
        assert found.taxels.tolist() == [[[1, 2], [3, 4]]] * 3, text
    assert len(decoded(p, b"1 2\n3 4\n5 6x\n\n")) == 0  # a third row, damaged
    p = replace(TEXT, cols=4, prefix="P:")
    other, wanted = b"T: 21.5\nL,1,2,3,4\n\n" * 5, b"P:1,2,3,4\n"
    found = decoded(p, (other + wanted) * 4)
    assert (len(found), found.garbage, found.size) == (4, 0, len(wanted))
    assert found.skipped.tolist() == [0] * 4
    assert found.ends.tolist() == [(k + 1) * len(other + wanted) for k in range(4)]
    glued = b"T: 21.5P:1,2,3,4\n"
    assert decoded(p, wanted + glued + wanted).skipped.tolist() == [0, len(glued)]
    assert len(decoded(p, b"P:1,2,3,4P:1,2,3,4\n" + wanted)) == 1
    with pytest.raises(ConfigError, match="prefix"):
        replace(p, lines="rows")


def test_anyskin_reskin_and_vitac_byte_by_byte():
    """Without temperature, z last; rows that a shorter line ends, numbers out of range."""
    values = [25.0, 1.0, 2.0, 3.0] * 4 + [25.0, 7.0, 8.0, 9.5]
    frame = struct.pack("<20f", *values) + b"\r\n"
    assert len(frame) == 82
    found = decoded(profile("anyskin"), frame * 4)
    assert found.taxels.shape == (3, 5, 1, 3)
    assert found.taxels[0, 0, 0].tolist() == [1, 2, 3]
    assert found.taxels[0, 4, 0].tolist() == [7, 8, 9.5]
    assert found.rest.data == b"\r\n"
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
def test_a_word_that_is_no_whole_number(word):
    """A text of whole numbers contains no other word."""
    p = replace(profile("3d-vitac"), rows=1, cols=2)
    assert len(decoded(p, b"1 2 \n\n1 " + word + b"\n\n")) == 1


def test_papillarray_byte_by_byte():
    """Forces, count and clock of nine pillars; a wrong sum or more zeros give none."""
    p = profile("papillarray")
    data = wire("papillarray", 5)
    found = decoded(p, data)
    assert (found.taxels[0] == taxels(p, 5)).all()
    assert (found.counts.tolist(), found.times_us.tolist()) == ([1005], [5_005_000])
    assert len(decoded(p, data[:30] + bytes([data[30] ^ 1]) + data[31:])) == 0
    at = data.index(b"\x02\x00", 40)
    assert len(decoded(p, data[:at] + bytes(26) + data[at:])) == 0
    assert len(decoded(p, data[:-6] + bytes(7) + data[-6:])) == 0
    # a count whose low bytes would be the type of a block, were they read as a part of the table
    assert len(decoded(p, papillarray(np.ones((3, 3, 6)), 65_536 + 3 - 1000))) == 1


def test_papillarray_of_two_sensors_with_a_tail_inside():
    """AA BB CC DD ends no packet where the sum does not fit; 6x3, not 3x3."""
    p = profile("papillarray")
    grid = np.zeros((3, 3, 6), np.float32)
    grid[1, 1, 2] = struct.unpack("<f", b"\xaa\xbb\xcc\xdd")[0]
    found = decoded(p, papillarray(grid, 1) * 2)
    assert len(found) == 2
    assert found.taxels[0, 1, 1, 2] == grid[1, 1, 2]
    assert found.garbage == 0
    grid = np.arange(108, dtype=np.float32).reshape(6, 3, 6)
    data = papillarray(grid, 1, sensors=2)
    found = decoded(replace(profile("papillarray"), rows=6), data)
    assert found.taxels[0].tolist() == grid[..., :3].tolist()
    wrong = decoded(profile("papillarray"), data)
    assert len(wrong) == 0
    assert "18 pillars" in wrong.wrong


def test_a_packet_of_another_form_is_read_by_its_own_table():
    """Any changed byte with a right sum, and after garbage."""
    p = replace(profile("papillarray"), rows=2, cols=1)
    grid = np.arange(1, 13, dtype=np.float32).reshape(2, 1, 6)
    good = papillarray(grid, 70_000, sensors=2)
    end = len(good) - 6
    for at in range(4, end):
        other = bytearray(good)
        other[at] ^= 1
        other[end : end + 2] = struct.pack("<H", sum(other[4:end]) & 0xFFFF)
        stream = [good, bytes(other), good, good + bytes(7), papillarray(grid, 1)]
        alone = [decoded(p, packet) for packet in stream]
        found = decoded(p, b"".join(stream))
        assert found.taxels.tobytes() == b"".join(one.taxels.tobytes() for one in alone), at
        assert found.counts.tolist() == [n for one in alone for n in one.counts.tolist()], at
        assert len(found.skipped) == len(found.ends) == len(found.taxels)


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
    more = b"".join(b"t71%d80000010002000300\r" % k for k in range(6))
    assert "beyond 1x2" in decoded(p, more).wrong
    assert not decoded(p, more[: -len(more) // 6]).wrong  # may be another node


def test_other_nodes_on_the_bus_are_passed_over_and_counted():
    """Whatever they send; a line that is not CAN breaks."""
    p = replace(profile("xela-can"), rows=1, cols=2)
    own = [b"t7108001234567800FF00\r", b"t71180000010002000300\r"]
    others = b"t1232AABB\rT000007102AABB\rr7108\rR000007108\rt7204AABBCCDD\r"
    others += b"t7A08" + b"00" * 8 + b"\r" + b"d7119" + b"11" * 12 + b"\r"
    data = (own[0] + others + own[1] + others) * 20
    whole = decoded(p, data)
    assert (len(whole), whole.garbage, whole.foreign, whole.wrong) == (20, 0, 280, "")
    assert whole.size == sum(map(len, own))
    for step in (1, 7, 50):
        rest, frames, foreign, garbage = Rest(), 0, 0, 0
        for at in range(0, len(data), step):
            found = codec(p)(rest, data[at : at + step])
            rest, frames, foreign = found.rest, frames + len(found), foreign + found.foreign
            garbage += found.garbage
        assert (frames, foreign, garbage) == (20, 280, 0)
    assert len(decoded(p, own[0] + b"x12\r" + own[1])) == 0


def test_robotiq_byte_by_byte():
    """Two fingers in one packet or two, big-endian; other fields are ignored."""
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
    short = b"".join(head + bytes([len(f) - 1]) + f[:-1] for f in fingers)
    assert len(decoded(p, short + one + head)) == 1


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
def test_orientation(orientation, wanted):
    """Turns in their order; the format has the shape of the result."""
    p = replace(SMALL, orientation=orientation)
    got = arranged(p, np.arange(1, 7, dtype=np.uint8)[None])
    assert got[0].tolist() == wanted
    assert p.format.shape == got.shape[1:]


@pytest.mark.parametrize("name", NAMES)
def test_split_or_whole_is_the_same(name):
    """Any split gives the frames, ends, garbage of the whole, with garbage in between."""
    p = profile(name)
    data = wire(name, 0)[7:] + b"".join(
        wire(name, i) + b"\xaa\x55garbage\r\n" * (i == 4) for i in range(9)
    )
    whole = decoded(p, data)
    assert len(whole) >= 5
    for size in (1, 7, 50)[len(data) > 8000 :]:
        rest, frames, garbage = Rest(), [], 0
        for at in range(0, len(data), size):
            part = codec(p)(rest, data[at : at + size])
            rest, garbage = part.rest, garbage + part.garbage
            frames += list(part.taxels)
        assert np.array_equal(frames, whole.taxels), size
        assert (garbage, rest.data) == (whole.garbage, whole.rest.data)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40)
@given(data=st.binary(max_size=600), at=st.integers(0, 500))
def test_no_bytes_raise(name, data, at):
    """Any bytes, within frames too: each is in a frame, garbage, or left over."""
    p = profile(name)
    sent = wire(name, 0) + wire(name, 1)
    mixed = sent[:at] + data + sent[at:]
    for one in (data, mixed):
        found = decoded(p, one)
        inside = len(one) - found.garbage - len(found.rest.data)
        assert 0 <= inside <= len(one)
        several = name in ("xela-can", "anyskin", "reskin", "3d-vitac")
        assert (inside > 0) == (len(found) > 0) or several
        assert len(found.ends) == len(found.skipped) == len(found.taxels)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_left_over_stays_small(name):
    """Bytes without an end do not pile up: 8 kB wait, of a text so much for each row."""
    decode = codec(profile(name))
    most = 8200 * (profile(name).rows if profile(name).lines == "rows" else 1)
    for fill in (b"\x00", b"\xaa\x55", b"7", b"\x55\x66\x77\x88", b"\x9a\x00\x61\xff"):
        rest = Rest()
        for _ in range(most // 4000 + 2):
            rest = decode(rest, fill * (4000 // len(fill))).rest
            assert len(rest.data) <= most


@pytest.mark.parametrize("name", ["matrix", "flexitac", "anyskin"])
def test_nothing_but_marks_is_passed_over(name, monkeypatch):
    """Frames full of marks have no recognizable beginning. They are skipped as a whole and not byte
    by byte, which would take longer than their arrival: the number of tried positions shows it."""
    p, looked = profile(name), []
    begins = fixed._begins
    monkeypatch.setattr(fixed, "_begins", lambda *args: looked.append(1) or begins(*args))
    data = (p.trailer + p.marker) * 15_000
    found = decoded(p, data)
    assert len(found) == 0
    assert len(looked) <= len(data) // fixed.layout(p).period + 1


@pytest.mark.parametrize(
    ("number", "order", "wire", "values"),
    [
        ("int16", "big", "ffff 8000 012c", [-1, -(1 << 15), 300]),
        ("uint24", "little", "010000 0000ff ffffff", [1, 0xFF0000, 0xFFFFFF]),
        ("uint24", "big", "000001 ff0000 ffffff", [1, 0xFF0000, 0xFFFFFF]),
        ("int24", "little", "ffffff 000080 ffff7f", [-1, -(1 << 23), (1 << 23) - 1]),
        ("int24", "big", "ffffff 800000 7fffff", [-1, -(1 << 23), (1 << 23) - 1]),
        ("uint32", "little", "01000000 00000080 ffffffff", [1, 1 << 31, 1 << 32]),
        ("int32", "big", "ffffffff 80000000 00ffffff", [-1, -(1 << 31), (1 << 24) - 1]),
    ],
)
def test_numbers_of_every_width(number, order, wire, values):
    """Both orders and signs; above 16 bits float32, which rounds; a text has no width."""
    if "4" in number:
        with pytest.raises(ConfigError, match=number):
            replace(TEXT, number=number)
    p = replace(SMALL, number=number, byte_order=order, rows=1, sequence="uint8")
    frames = b"".join(b"\xaa\x55" + bytes([i]) + bytes.fromhex(wire) for i in range(4))
    found = decoded(p, frames)
    assert found.taxels.dtype == p.format.dtype == ("int16" if number == "int16" else "float32")
    assert found.taxels.tolist() == [[values]] * 3
    assert found.counts.tolist() == [0, 1, 2]
