"""The state of the box at the end of a turn of its loop."""

from __future__ import annotations

from typing import NamedTuple


class Health(NamedTuple):
    """State of the box at the end of a turn.

    time_ns: host monotonic. skin: sensor state (PROTOCOL.md). trouble: the reason why the skin does
    not stream, "" if it does. streams: frames are arriving. ready: a sweep can be taken now, as the
    GPIO line READY shows. The counts since the program started are as in the STA sentence: of
    the sensor from `frames` to `enumerations` and from `stale_frames` to `fifo_overflows` (see
    SensorCounters), of the serial line `dropped`, of the trigger `glitches`, `lost_edges` and
    `storms` (see EdgeCounters). loss_known: the skin counts its frames; if not, `lost_frames`
    counts only the losses that can be inferred. degraded: taxels that are broken over the stream
    and bridged ("silent taxel 2.3"), "" for none. foreign_frames: of other nodes on the skin's bus.
    due_ns: see Trigger.due_ns.
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
    stale_frames: int
    overflows: int
    fifo_overflows: int
    glitches: int
    lost_edges: int
    storms: int
    loss_known: bool = True
    ready: bool = False
    degraded: str = ""
    foreign_frames: int = 0
    due_ns: int = 0

    @property
    def text(self) -> str:
        """One line for a person."""
        skin = f"skin {self.skin}: {self.trouble}" if self.trouble else f"skin {self.skin}"
        skin += f", {self.degraded}" if self.degraded else ""
        return f"{skin}. Sweeps answered: {self.answered}"
