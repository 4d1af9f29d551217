"""The interface of all links to a readout board, and requests sent as single bytes (PROTOCOL.md,
part 1). The links are `usb_link` (bulk transfers) and `serial_link` (serial ports)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from palpate.core.clock import Clock
from palpate.core.errors import SensorMismatch
from palpate.io import packets

REPLY_MS = 500
"""Longest wait for the reply to a request."""
TTY_BYTES = 4095
"""Most bytes that a serial port returns at once; after a read of so many, more may be waiting."""
_MOST_BYTES = 4 * packets.MAX_PAYLOAD


class Readable(Protocol):
    """An opened skin. Each failure raises the SensorError that explains it."""

    def read(self, size: int, timeout_ms: int) -> bytes:
        """At most `size` bytes; b"" if none came within `timeout_ms`."""
        ...

    def close(self) -> None:
        """Ask the readout board to stop, unless it is gone, and release it."""
        ...


class SkinLink(Readable, Protocol):
    """An opened readout board."""

    def request(self, request: packets.Request, length: int) -> bytes:
        """Send a request; returns a reply of at most `length` bytes, b"" for length 0."""
        ...


class BytePort(Readable, Protocol):
    """An opened port, as SerialLink is."""

    def write(self, data: bytes) -> None: ...


def reply_to(request: packets.Request, read: Callable[[int, int], bytes], clock: Clock) -> bytes:
    """The reply to a request that was sent as a byte. read: as `SkinLink.read`. Frames before the
    reply are dropped: they belong to a stream that an earlier program did not stop. Raises
    SensorMismatch if no reply comes within REPLY_MS."""
    data, until_ns = b"", clock.now_ns() + REPLY_MS * 1_000_000
    # without this limit, a device that sends a few bytes now and then would keep the loop running
    while len(data) <= _MOST_BYTES and clock.now_ns() < until_ns:
        data += read(4096, REPLY_MS)
        for reply in packets.unpack(data).replies:
            if reply.request == request:
                return reply.payload
    sent = f"sends {len(data)} other bytes but" if data else "sends nothing and"
    raise SensorMismatch(
        f"the skin {sent} does not answer request {request.name}; check its firmware, or set"
        " skin.profile"
    )
