"""The room of the log: what a person reads of the box, one line an event. In: verdicts, lines. Out: lines as systemd's
journal wants them, or a terminal.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from types import MappingProxyType

from appliance.core.types import Status, Verdict

WARNING = "<4>"
"""Begins a line that asks for a look: its level, as sd-daemon(3) has it. `journalctl -p warning` shows these alone."""
REASONS: Mapping[Status, str] = MappingProxyType(
    {
        Status.UNKNOWN: "it is like no material that was trained or enrolled",
        Status.SHORT: "the stop edge came before a window's length had passed",
        Status.LONG: "no stop edge came in time",
        Status.GAP: "too many frames in a row are missing; look at the skin's cable",
        Status.NO_CONTACT: "no taxel is loaded; see that the finger lies on the object",
        Status.SATURATED: "too many digits at full scale; press less",
        Status.STUCK_TAXEL: "a loaded taxel does not move; look at the skin",
        Status.DEAD_TAXEL: "a taxel between loaded ones is silent; look at the skin",
        Status.SENSOR_LOST: "the skin went away during the sweep; look at its cable",
        Status.NO_START: "a stop edge without a start; look at the start line",
        Status.NO_STOP: "a second start edge came; look at the stop line",
        Status.NOT_READY: "a start edge while READY was low; the robot must wait for READY",
        Status.EDGES_LOST: "trigger edges were lost; look at the trigger lines",
        Status.ABORTED: "by command, or because the box was stopping",
    }
)
"""Why a sweep has no label, and what to look at: PROTOCOL.md says it in full."""
_LEVEL = re.compile(r"\A<[0-7]>")


def attached(environ: Mapping[str, str] = os.environ, stream: int = 2) -> bool:
    """Whether a stream (its number) goes straight to the journal: systemd names it in JOURNAL_STREAM."""
    try:
        held = os.fstat(stream)
    except OSError:  # closed
        return False
    return environ.get("JOURNAL_STREAM") == f"{held.st_dev}:{held.st_ino}"


def spoken(line: str, in_journal: bool) -> str:
    """A line, which may begin with its level, as it is printed: the journal knows levels and who speaks, a terminal not.

    What a device says of itself may hold line breaks: they begin no line with a level of its own.
    """
    line = " ".join(line.splitlines())
    return line if in_journal else f"palpate: {_LEVEL.sub('', line)}"


def words(v: Verdict) -> str:
    """A verdict in words: "sweep 7: plastic rough, 98.7 % (1.2 ms)"."""
    if not v.status.classified:
        why = "; ".join(filter(None, (REASONS[v.status], v.detail)))
        return f"sweep {v.sweep}: no answer, {v.status}: {why}"
    what = v.label if v.status is Status.OK else f"{v.status}, perhaps {v.label}"
    fused = f" after {v.fused} sweeps" if v.fused > 1 else ""
    early = f", early at {v.share:.0%} of the window".replace("%", " %") if v.share < 1 else ""
    detail = f"; {v.detail}" if v.detail else ""
    return f"sweep {v.sweep}: {what}, {100 * v.probability:.1f} %{fused}{early} ({v.latency_ns / 1e6:.1f} ms){detail}"


class Journal:
    """Logs each verdict as one line. log: takes a line, which may begin with its level."""

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log

    def send(self, verdict: Verdict) -> None:
        """Log it; one without an answer, or of a finger that lies elsewhere than in training, is a warning."""
        fine = verdict.status.classified or verdict.status is Status.ABORTED
        self._log(("" if fine and not verdict.moved else WARNING) + words(verdict))
