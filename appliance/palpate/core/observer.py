"""Events of the loop for its observers (captures, recordings, status, the service manager), and the
state of the box at the end of a turn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from palpate.core.types import Edge, Frames, Sweep, Verdict

Facts = Mapping[str, Callable[[], object]]
"""Additional facts of status and feed, by name. A text is shown to a person."""


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


class Observer:
    """Base of all observers; each overrides the methods that it needs. No method may raise or wait:
    a full disk may cost the record, but must not stop the classifying. Slow work belongs into
    `sweep` or `turn`, when all answers of the turn are out."""

    def frames(self, frames: Frames) -> None:
        """Frames have come, at least one."""

    def triggered(self, t_ns: int, edges: Sequence[Edge]) -> None:
        """Edges have settled, by `t_ns`."""

    def command(self, t_ns: int, line: str) -> None:
        """A command, as it stands in a sentence, is about to be carried out."""

    def answered(self, verdict: Verdict) -> None:
        """The robot was sent this verdict on the serial line."""

    def sweep(self, sweep: Sweep, verdict: Verdict, circumstances: Mapping[str, Any]) -> None:
        """A sweep was answered, with all others of the turn. See Box.circumstances."""

    def turn(self, health: Health) -> None:
        """A turn has ended: frames were read, edges were polled, answers are out."""

    def stopping(self) -> None:
        """The loop has ended; an open sweep will still be answered."""
