"""The source of frames for the loop, its counts, and those who observe its bytes; the links to a
readout board, and requests sent as single bytes (PROTOCOL.md, part 1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from palpate.core.clock import Clock
from palpate.core.errors import SensorError, SensorMismatch
from palpate.core.types import Frames
from palpate.io import packets

REPLY_MS = 500
"""Longest wait for the reply to a request."""
TTY_BYTES = 4095
"""Most bytes that a serial port returns at once; after a read of so many, more may be waiting."""
_MOST_BYTES = 4 * packets.MAX_PAYLOAD


@dataclass(slots=True)
class SensorCounters:
    """Counts since the program started.

    frames: received. lost_frames: missing in the sequence numbers. stale_frames: repeated or late,
    and left out. garbage_bytes: bytes outside of packets. overflows: transfers larger than the
    read. fifo_overflows: packets with the flag OVERFLOW, set when the FIFO of the readout board was
    full. enumerations: times the skin was found and started. foreign_frames: of other nodes on the
    skin's bus, left out.
    """

    frames: int = 0
    lost_frames: int = 0
    stale_frames: int = 0
    garbage_bytes: int = 0
    overflows: int = 0
    fifo_overflows: int = 0
    enumerations: int = 0
    foreign_frames: int = 0


class Sensor(Protocol):
    """The source of frames for the loop."""

    @property
    def state(self) -> str:
        """`streaming`, or the state that prevents it (PROTOCOL.md, states of the skin)."""

    @property
    def trouble(self) -> SensorError | None:
        """The reason why it is not streaming, with a remedy; None while it streams."""

    @property
    def identity(self) -> packets.Identity | None:
        """Name and version of the readout board; None before it was asked."""

    @property
    def clock(self) -> dict[str, float] | None:
        """Accuracy of the times: DeviceClock.quality."""

    @property
    def loss_known(self) -> bool:
        """Whether every lost frame is seen, not only losses that times show."""

    @property
    def counters(self) -> SensorCounters: ...

    def read(self) -> Frames:
        """The frames since the last call; an empty Frames after a bounded wait."""


OPENED = "opened"
"""Given to observers when a skin was opened, which begins a new enumeration. It is not a state: the
skin keeps its last state until its first frame."""


class TransferObserver(Protocol):
    """Observes the bytes that the sensor receives, for captures."""

    def transfer(self, t_ns: int, data: bytes) -> None:
        """A bulk transfer has ended."""

    def state(self, t_ns: int, state: str) -> None:
        """The sensor's state has changed, or the skin was opened (OPENED)."""


class FrameStream(Protocol):
    """Converts the bytes of a skin to Frames with numbers and host times, without I/O."""

    @property
    def loss_known(self) -> bool:
        """Whether every lost frame is seen, as the skin counts its frames."""

    @property
    def clock(self) -> dict[str, float] | None:
        """Accuracy of the times: DeviceClock.quality."""

    @property
    def misfit(self) -> str:
        """Why bytes are not frames, and the remedy, as far as it shows; "" if it does not."""

    def restart(self) -> None:
        """Begin an enumeration: frame numbers get the next epoch, the clock starts again."""

    def feed(self, data: bytes, arrival_ns: int) -> Frames:
        """The frames in bytes that were read until `arrival_ns`. Raises SensorMismatch."""


class Readable(Protocol):
    """An opened skin. Each failure raises the SensorError that explains it."""

    def read(self, size: int, timeout_ms: int) -> bytes:
        """At most `size` bytes; b"" if none came within `timeout_ms`."""

    def close(self) -> None:
        """Ask the readout board to stop, unless it is gone, and release it."""


class SkinLink(Readable, Protocol):
    """An opened readout board."""

    def request(self, request: packets.Request, length: int) -> bytes:
        """Send a request; returns a reply of at most `length` bytes, b"" for length 0."""


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
