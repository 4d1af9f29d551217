"""The state of the box at the end of each turn of its loop (Health), and the interface of those who observe it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Health:
    """State of the box at the end of a turn.

    time_ns: host monotonic. skin: sensor state (PROTOCOL.md). trouble: why the skin does not stream, "" where it does.
    streams: frames are arriving. The counts are those of the STA sentence.
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
        """One line for a person."""
        skin = f"skin {self.skin}: {self.trouble}" if self.trouble else f"skin {self.skin}"
        return f"{skin}. Sweeps answered: {self.answered}"


class HealthObserver(Protocol):
    """Observes the loop, for example a watchdog, which notices a turn that does not end because no call comes."""

    def turn(self, health: Health) -> None:
        """A turn of the loop has ended: frames were read or the skin's absence reported, edges polled, answers sent."""
        ...

    def stopping(self) -> None:
        """The loop has ended; open sweeps are answered next."""
        ...
