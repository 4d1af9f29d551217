"""Packets: for any bytes, intact frames are returned exactly and everything else is counted."""

import itertools
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.core.errors import FormatError
from palpate.core.types import DATA_TYPES, EPOCH_BITS
from palpate.io import packets as wire


def stream(count: int, frames: int = 3, first: int = 0, dtype: str = "uint8") -> list[bytes]:
    """`count` packets of 2x3 taxels, each count equal to the number of its frame."""
    packets = []
    for k in range(count):
        seq = first + k * frames
        taxels = (np.arange(seq, seq + frames) % 200)[:, None, None] + np.arange(6).reshape(1, 2, 3)
        packets.append(wire.pack(seq, seq * 1333, taxels.astype(dtype)))
    return packets


def frames_of(packets: list[wire.Packet]) -> dict[int, bytes]:
    """Every frame that came out, by its number."""
    return {p.seq + i: t.tobytes() for p in packets for i, t in enumerate(p.taxels)}


def test_bytes_are_the_documents_table():
    """Built by hand from PROTOCOL.md; too large a packet is not built."""
    payload = bytes(range(8))
    head = struct.pack("<BBBBHBBBBBBII", 0x50, 0xC1, 1, 0, 8, 1, 2, 2, 2, 0, 0, 0xFFFFFFFF, 7)
    by_hand = head + payload + struct.pack("<I", zlib.crc32(head + payload))
    assert (
        wire.pack(0xFFFFFFFF, 7, np.arange(8, dtype=np.uint8).reshape(2, 2, 2), wire.Flag.TRIGGER)
        == by_hand
    )
    with pytest.raises(FormatError, match="4096"):
        wire.pack(0, 0, np.zeros((255, 5, 5), np.uint8))


@pytest.mark.parametrize(
    ("byte", "shape"), [(0, (4, 2)), (1, (4, 2)), (2, (2, 2, 2)), (8, (1, 1, 8))]
)
def test_axes_of_a_taxel(byte, shape):
    """The byte after the data type; 0 means one axis, and the box writes one as 0."""
    payload = bytes(range(8))
    head = struct.pack("<BBBBHBBBBBBII", 0x50, 0xC1, 1, 0, 8, 0, 1, *shape[:2], 0, byte, 5, 7)
    by_hand = head + payload + struct.pack("<I", zlib.crc32(head + payload))
    (packet,) = wire.unpack(by_hand).packets
    np.testing.assert_array_equal(packet.taxels, np.arange(8, dtype=np.uint8).reshape(1, *shape))
    if byte != 1:
        assert wire.pack(5, 7, packet.taxels) == by_hand


@pytest.mark.parametrize(("byte", "size"), [(9, 9), (3, 8), (255, 255)])
def test_axes_that_cannot_be(byte, size):
    """More than eight axes, or another number than in the payload: the bytes are garbage."""
    head = struct.pack("<BBBBHBBBBBBII", 0x50, 0xC1, 1, 0, size, 0, 1, 1, 1, 0, byte, 5, 7)
    data = head + bytes(size) + struct.pack("<I", zlib.crc32(head + bytes(size)))
    got = wire.unpack(data)
    assert (got.packets, got.garbage + len(got.leftover)) == ([], len(data))


@pytest.mark.parametrize("dtype", DATA_TYPES)
def test_every_data_type_survives(dtype):
    """Raw counts of each type arrive as they were sent."""
    sent = stream(2, dtype=dtype)
    got = wire.unpack(b"".join(sent))
    assert [p.taxels.dtype.name for p in got.packets] == [dtype, dtype]
    assert frames_of(got.packets) == frames_of(
        wire.unpack(sent[0]).packets + wire.unpack(sent[1]).packets
    )
    assert got.garbage == 0
    assert got.leftover == b""


@given(cuts=st.lists(st.integers(0, 400), max_size=12), data=st.data())
def test_any_split_gives_the_same(cuts, data):
    """However a stream is cut into transfers, the same frames come out and nothing is counted."""
    whole = b"".join(stream(8, first=data.draw(st.integers(0, 2**32 - 1))))
    edges = sorted({0, *(c % len(whole) for c in cuts), len(whole)})
    packets, rest = [], b""
    for a, b in itertools.pairwise(edges):
        got = wire.unpack(rest + whole[a:b])
        packets, rest = packets + got.packets, got.leftover
        assert got.garbage == 0
    assert rest == b""
    assert frames_of(packets) == frames_of(wire.unpack(whole).packets)


@pytest.mark.slow
@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("packet"), st.integers(0, 19)),
            st.tuples(st.just("garbage"), st.binary(min_size=1, max_size=40)),
            st.tuples(st.just("cut"), st.tuples(st.integers(0, 19), st.integers(1, 41))),
            st.tuples(
                st.just("flip"),
                st.tuples(st.integers(0, 19), st.integers(0, 41), st.integers(1, 255)),
            ),
        ),
        max_size=25,
    )
)
def test_only_intact_frames_and_all_bytes_accounted(pieces):
    """No frame is invented, no intact one missed, and bytes add up, whatever is damaged."""
    sent = stream(20)
    wanted, data = {}, b""
    for what, argument in pieces:
        if what == "packet":
            wanted |= frames_of(wire.unpack(sent[argument]).packets)
            data += sent[argument]
        elif what == "garbage":
            data += argument
        elif what == "cut":
            data += sent[argument[0]][: argument[1]]
        else:
            broken = bytearray(sent[argument[0]])
            broken[argument[1] % len(broken)] ^= argument[2]
            data += broken
    # a broken header may announce up to MAX_PAYLOAD bytes: with that much after it, all is decided
    got = wire.unpack(data + bytes(wire.MAX_PAYLOAD + 64))
    everything = frames_of([p for s in sent for p in wire.unpack(s).packets])
    have = frames_of(got.packets)
    assert wanted.items() <= have.items()
    assert have.items() <= everything.items()
    size = sum(len(p.taxels) // 3 * len(sent[0]) for p in got.packets)
    assert size + got.garbage + len(got.leftover) == len(data) + wire.MAX_PAYLOAD + 64


@given(st.binary(max_size=3000))
def test_garbage_never_raises_and_is_counted(data):
    """Random bytes give no frames; each byte is garbage or part of the rest."""
    got = wire.unpack(data)
    assert got.packets == []
    assert got.garbage + len(got.leftover) == len(data)


@given(st.lists(st.integers(0, 30), max_size=40), st.integers(0, 2**32 - 1))
def test_follow_accounts_for_every_frame(order, first):
    """In any order: numbers rise, and fresh plus lost frames cover the whole range."""
    packets = [
        wire.Packet((first + 3 * k) % 2**32, 0, wire.Flag(0), np.zeros((3, 1, 1), np.uint8))
        for k in order
    ]
    fresh, place, lost, stale = wire.follow(packets, wire.StreamPosition(0))
    starts = [s for s, _ in fresh]
    assert starts == sorted(set(starts))
    assert 3 * len(fresh) + stale == 3 * len(packets)
    if fresh:
        assert place.next - starts[0] == 3 * len(fresh) + lost
        assert starts[0] == first + 3 * order[0] - (2**32 if first + 3 * order[0] >= 2**32 else 0)


def test_counts_wrap_or_restart():
    """At 32 bits without loss; far back a new epoch begins, nothing is lost or adjacent."""
    packets = wire.unpack(b"".join(stream(3, first=2**32 - 4))).packets
    fresh, _, lost, stale = wire.follow(packets, wire.StreamPosition(2))
    assert [s - (2 << EPOCH_BITS) for s, _ in fresh] == [2**32 - 4, 2**32 - 1, 2**32 + 2]
    assert (lost, stale) == (0, 0)
    packets = wire.unpack(stream(1, first=900_000)[0] + stream(1, first=0)[0]).packets
    fresh, place, lost, stale = wire.follow(packets, wire.StreamPosition(0))
    assert [s for s, _ in fresh] == [900_000, 1 << EPOCH_BITS]
    assert (place.epoch, lost, stale) == (1, 0, 0)


def test_replies_are_read_as_written_of_any_version():
    """Frames of an unknown version are garbage, so that it can be named."""
    packet = bytearray(stream(1)[0])
    packet[2] = 9
    assert wire.unpack(bytes(packet) + bytes(50)).packets == []
    assert wire.unpack(wire.pack_reply(wire.Request.IDENTITY, b"\x09", version=9)).replies == [
        wire.Reply(1, b"\x09")
    ]
    who = wire.Identity(1, (1, 2, 3), "board", "0042")
    skin = wire.SkinFormat(16, 1, "int16", 35.61, 100, 2)
    assert wire.unpack_identity(wire.pack_identity(who) + b"later fields") == who
    assert wire.unpack_format(wire.pack_format(skin)) == skin
    assert wire.unpack_format(wire.pack_format(three := replace(skin, axes=3))) == three
    one = bytearray(wire.pack_format(skin))
    assert one[3] == 0
    one[3] = 1
    assert wire.unpack_format(bytes(one)) == skin


@pytest.mark.parametrize(
    ("call", "value", "hint"),
    [
        (wire.unpack_identity, b"\x01", "36"),
        (wire.unpack_format, b"\x01", "16"),
        (wire.unpack_format, b"\x04\x04\x09" + bytes(13), r"data type 9 .* 0\.\.3;"),
        (wire.unpack_format, b"\x04\x04\x00\x09" + bytes(12), "9 axes .* 8;"),
    ],
)
def test_broken_replies_are_named(call, value, hint):
    """A reply that is too short or has an unknown data type is a FormatError with the reason."""
    with pytest.raises(FormatError, match=hint):
        call(value)
