"""Reads and writes packets of the readout board in pure functions (firmware_config/PROTOCOL.md,
part 1), and counts lost bytes and frames.

`unpack` and `follow` accept any bytes without raising, and return only frames of packets with a
correct CRC.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate.core.types import DATA_TYPES, EPOCH_BITS, EPOCHS, MOST_AXES, shape, shown

MAGIC = b"\x50\xc1"
VERSION = 1
HEADER = struct.Struct("<2sBBHBBBBBBII")
CRC = struct.Struct("<I")
MAX_PAYLOAD = 4096
MAX_FRAMES = 255
RECENT = 1 << 16
"""A packet at most this many frames behind the newest is a repetition. A packet further behind
shows that the readout board has restarted its count."""

_DTYPES = tuple(np.dtype(d).newbyteorder("<") for d in DATA_TYPES)
_IDENTITY = struct.Struct("<BBBB16s16s")
_FORMAT = struct.Struct("<BBBBIII")


class PacketKind(IntEnum):
    """Byte 3 of a packet."""

    FRAMES = 0
    REPLY = 1


class Flag(IntFlag):
    """Byte 6 of a packet."""

    TRIGGER = 1
    OVERFLOW = 2


class Request(IntEnum):
    """Requests: bRequest of a vendor device, or a byte to a CDC-ACM device."""

    IDENTITY = 1
    FORMAT = 2
    START = 3
    STOP = 4


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """Consecutive frames. seq, t_us: sequence number and time of the first frame, 32 bits as sent.
    flags: bits of Flag. taxels: raw counts [n, R, C] or [n, R, C, A]."""

    seq: int
    t_us: int
    flags: int
    taxels: NDArray[Any]


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply to a request that was sent as a byte (CDC-ACM)."""

    request: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Unpacked:
    """The content of bytes: packets and replies, bytes outside of them, the unfinished rest."""

    packets: list[Packet]
    replies: list[Reply]
    garbage: int
    leftover: bytes


@dataclass(frozen=True, slots=True)
class Identity:
    """The reply to IDENTITY: versions of protocol and firmware, name, serial number."""

    protocol: int
    firmware: tuple[int, int, int]
    board: str
    serial: str


@dataclass(frozen=True, slots=True)
class SkinFormat:
    """The reply to FORMAT: grid, data type, rate, frames in the FIFO and in a packet, axes."""

    rows: int
    cols: int
    dtype: str
    rate_hz: float
    fifo_frames: int
    packet_frames: int
    axes: int = 1

    @property
    def shape(self) -> tuple[int, ...]:
        return shape(self.rows, self.cols, self.axes)


@dataclass(frozen=True, slots=True)
class StreamPosition:
    """Position in the stream: enumeration, and number of the next frame (None at first)."""

    epoch: int
    next: int | None = None


def _seal(head: bytes, payload: bytes) -> bytes:
    return head + payload + CRC.pack(zlib.crc32(payload, zlib.crc32(head)))


def pack(seq: int, t_us: int, taxels: NDArray[Any], flags: int = 0) -> bytes:
    """A frame packet. taxels: raw counts [n, R, C] or [n, R, C, A] of one of DATA_TYPES. seq and
    t_us are sent modulo 2**32. Raises FormatError if the frames do not fit one packet."""
    n, rows, cols, *axes = taxels.shape
    code = _DTYPES.index(taxels.dtype.newbyteorder("<"))
    payload = taxels.astype(_DTYPES[code], copy=False).tobytes()
    if not 0 < n <= MAX_FRAMES or len(payload) > MAX_PAYLOAD:
        frames = f"{n} frames of {shown(taxels.shape[1:])} {taxels.dtype}"
        raise FormatError(f"{frames} do not fit a packet of {MAX_PAYLOAD} bytes; send fewer")
    grid = n, rows, cols, code, _axes_byte(*axes)
    stamp = seq % (1 << 32), t_us % (1 << 32)
    kind = PacketKind.FRAMES
    return _seal(HEADER.pack(MAGIC, VERSION, kind, len(payload), flags, *grid, *stamp), payload)


def pack_reply(request: Request, payload: bytes, version: int = VERSION) -> bytes:
    """A reply packet: the reply of a CDC-ACM device to a request byte."""
    return _seal(
        HEADER.pack(MAGIC, version, PacketKind.REPLY, len(payload), 0, request, 0, 0, 0, 0, 0, 0),
        payload,
    )


def unpack(data: bytes) -> Unpacked:
    """Find all complete packets in `data`. The leftover belongs before the next bytes."""
    packets: list[Packet] = []
    replies: list[Reply] = []
    garbage = at = 0
    while True:
        start = data.find(MAGIC, at)
        if start < 0:
            # the last byte may be the first half of MAGIC
            keep = 1 if data[at:].endswith(MAGIC[:1]) else 0
            garbage += len(data) - at - keep
            return Unpacked(packets, replies, garbage, data[len(data) - keep :])
        garbage += start - at
        item, size = _one(data, start)
        if size == 0:
            return Unpacked(packets, replies, garbage, data[start:])
        if isinstance(item, Packet):
            packets.append(item)
        elif item is not None:
            replies.append(item)
        else:
            garbage += size
        at = start + size


def _one(data: bytes, at: int) -> tuple[Packet | Reply | None, int]:
    """The packet at `at` and its size; (None, 0): too few bytes, (None, 1): no packet here."""
    if len(data) - at < HEADER.size:
        return None, 0
    _, version, kind, length, flags, count, rows, cols, code, axes, seq, t_us = HEADER.unpack_from(
        data, at
    )
    axes = axes or 1
    known = kind == PacketKind.FRAMES and version == VERSION
    frames = known and code < len(_DTYPES) and axes <= MOST_AXES
    if frames:
        frames = 0 < length == count * rows * cols * axes * _DTYPES[code].itemsize
    if length > MAX_PAYLOAD or not (frames or kind == PacketKind.REPLY):
        return None, 1
    end = at + HEADER.size + length
    if len(data) < end + CRC.size:
        return None, 0
    if zlib.crc32(data[at:end]) != CRC.unpack_from(data, end)[0]:
        return None, 1
    size = end + CRC.size - at
    if kind == PacketKind.REPLY:
        return Reply(count, data[at + HEADER.size : end]), size
    counts = np.frombuffer(data, _DTYPES[code], count * rows * cols * axes, at + HEADER.size)
    return Packet(seq, t_us, flags, counts.reshape(count, *shape(rows, cols, axes))), size


def follow(
    packets: list[Packet], position: StreamPosition
) -> tuple[list[tuple[int, Packet]], StreamPosition, int, int]:
    """Unwrap sequence numbers: ([(unwrapped number of the first frame, packet)], new position, lost
    frames, stale frames).

    A packet behind the position is stale (repeated or late) and is left out. A packet more than
    RECENT frames behind begins a new epoch, since the readout board has restarted its count. Frames
    are lost where the count jumps ahead.
    """
    fresh: list[tuple[int, Packet]] = []
    lost = stale = 0
    for p in packets:
        n, ahead = len(p.taxels), 0
        if position.next is not None:
            ahead = (p.seq - position.next + (1 << 31)) % (1 << 32) - (1 << 31)
        if -RECENT <= ahead < 0:
            stale += n
            continue
        if ahead < 0:
            position = StreamPosition((position.epoch + 1) % EPOCHS)
        if position.next is None:
            first = (position.epoch << EPOCH_BITS) + p.seq
        else:
            first = position.next + ahead
            lost += ahead
        fresh.append((first, p))
        position = StreamPosition(position.epoch, first + n)
    return fresh, position, lost, stale


def pack_identity(who: Identity) -> bytes:
    return _IDENTITY.pack(
        who.protocol, *who.firmware, who.board.encode()[:16], who.serial.encode()[:16]
    )


def unpack_identity(payload: bytes) -> Identity:
    """Read an IDENTITY reply, which may be longer. Raises FormatError."""
    protocol, major, minor, patch, board, serial = _reply(payload, _IDENTITY, "identity")
    return Identity(protocol, (major, minor, patch), _text(board), _text(serial))


def pack_format(skin: SkinFormat) -> bytes:
    grid, rate_mhz = (skin.rows, skin.cols), round(skin.rate_hz * 1000)
    code, axes = DATA_TYPES.index(skin.dtype), _axes_byte(skin.axes)
    return _FORMAT.pack(*grid, code, axes, rate_mhz, skin.fifo_frames, skin.packet_frames)


def unpack_format(payload: bytes) -> SkinFormat:
    """Read a FORMAT reply. Raises FormatError."""
    rows, cols, code, axes, rate_mhz, fifo, packet_frames = _reply(payload, _FORMAT, "format")
    if code >= len(DATA_TYPES):
        raise FormatError(f"data type {code} is not among 0..{len(DATA_TYPES) - 1}; update the box")
    if axes > MOST_AXES:
        raise FormatError(f"{axes} axes of a taxel, at most {MOST_AXES}; check the firmware")
    return SkinFormat(rows, cols, DATA_TYPES[code], rate_mhz / 1000, fifo, packet_frames, axes or 1)


def _reply(payload: bytes, parts: struct.Struct, what: str) -> tuple[Any, ...]:
    if len(payload) < parts.size:
        wanted = f"protocol {VERSION} has {parts.size}"
        raise FormatError(f"{what} of {len(payload)} bytes; {wanted}: check the firmware")
    return parts.unpack_from(payload)


def _axes_byte(axes: int = 1) -> int:
    """One axis is sent as 0."""
    return 0 if axes == 1 else axes


def _text(raw: bytes) -> str:
    return "".join(c for c in raw.split(b"\0")[0].decode("ascii", "replace") if c.isprintable())
