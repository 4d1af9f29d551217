"""The source of frames for the loop, its counts, and those who observe its bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from palpate.core.errors import SensorError
from palpate.core.types import Frames
from palpate.io import packets


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
        ...

    @property
    def trouble(self) -> SensorError | None:
        """The reason why it is not streaming, with a remedy; None while it streams."""
        ...

    @property
    def identity(self) -> packets.Identity | None:
        """Name and version of the readout board; None before it was asked."""
        ...

    @property
    def clock(self) -> dict[str, float] | None:
        """Accuracy of the times: DeviceClock.quality."""
        ...

    @property
    def loss_known(self) -> bool:
        """Whether every lost frame is seen, not only losses that times show."""
        ...

    @property
    def counters(self) -> SensorCounters: ...

    def read(self) -> Frames:
        """The frames since the last call; an empty Frames after a bounded wait."""
        ...


OPENED = "opened"
"""Given to observers when a skin was opened, which begins a new enumeration. It is not a state: the
skin keeps its last state until its first frame."""


class TransferObserver(Protocol):
    """Observes the bytes that the sensor receives, for captures."""

    def transfer(self, t_ns: int, data: bytes) -> None:
        """A bulk transfer has ended."""
        ...

    def state(self, t_ns: int, state: str) -> None:
        """The sensor's state has changed, or the skin was opened (OPENED)."""
        ...


class FrameStream(Protocol):
    """Converts the bytes of a skin to Frames with numbers and host times, without I/O."""

    @property
    def loss_known(self) -> bool:
        """Whether every lost frame is seen, as the skin counts its frames."""
        ...

    @property
    def clock(self) -> dict[str, float] | None:
        """Accuracy of the times: DeviceClock.quality."""
        ...

    @property
    def misfit(self) -> str:
        """Why bytes are not frames, and the remedy, as far as it shows; "" if it does not."""
        ...

    def restart(self) -> None:
        """Begin an enumeration: frame numbers get the next epoch, the clock starts again."""
        ...

    def feed(self, data: bytes, arrival_ns: int) -> Frames:
        """The frames in bytes that were read until `arrival_ns`. Raises SensorMismatch."""
        ...
