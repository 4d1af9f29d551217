"""How the box is, told at the end of each turn of its loop. In: nothing. Out: Health, and what whoever watches must have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Health:
    """How the box is at the end of a turn.

    time_ns: host monotonic. skin: its state (PROTOCOL.md). trouble: why it does not stream, "" where it does. streams:
    frames have come, and come. The counts are those of the STA sentence.
    """

    time_ns: int
    skin: str
    trouble: str
    streams: bool
    sweeping: bool
    answered: int
    frames: int
    lost_frames: int
    garbage_bytes: int
    enumerations: int
    dropped: int
    bundle: str
    source: str

    @property
    def text(self) -> str:
        """In words, for a person."""
        skin = f"skin {self.skin}: {self.trouble}" if self.trouble else f"skin {self.skin}"
        return f"{skin}. Sweeps answered: {self.answered}"


class HealthObserver(Protocol):
    """Whoever watches over the program: a turn that does not end is noticed by its silence."""

    def turn(self, health: Health) -> None:
        """A turn of the loop is over: frames came in or the skin's absence was told, edges were polled, answers are out."""
        ...

    def stopping(self) -> None:
        """The loop has ended; what is open is being answered."""
        ...
