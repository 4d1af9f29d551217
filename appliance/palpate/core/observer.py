"""Events of the loop for its observers: captures, recordings, status, the service manager."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from palpate.core.health import Health
    from palpate.core.types import Edge, Frames, Sweep, Verdict

Facts = Mapping[str, Callable[[], object]]
"""Additional facts of status and feed, by name. A text is shown to a person."""


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
