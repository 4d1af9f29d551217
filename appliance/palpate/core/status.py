"""The outcomes of a sweep: a Status for each, with the reason why it has no label."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType


class Status(StrEnum):
    """The outcome of a sweep, in sentences, on GPIO lines and in files. PROTOCOL.md explains each;
    a test compares the lists."""

    OK = "ok"
    UNSURE = "unsure"
    UNDECIDED = "undecided"
    UNKNOWN = "unknown"
    SHORT = "short"
    LONG = "long"
    GAP = "gap"
    NO_CONTACT = "no-contact"
    SATURATED = "saturated"
    STUCK_TAXEL = "stuck-taxel"
    DEAD_TAXEL = "dead-taxel"
    SENSOR_LOST = "sensor-lost"
    NO_START = "no-start"
    NO_STOP = "no-stop"
    NOT_READY = "not-ready"
    EDGES_LOST = "edges-lost"
    ABORTED = "aborted"
    RECORDED = "recorded"
    CONFLICT = "conflict"
    NO_SLIDE = "no-slide"
    FAILED = "failed"

    @property
    def classified(self) -> bool:
        """True if a label was computed."""
        return self in (Status.OK, Status.UNSURE, Status.UNDECIDED)

    @property
    def faulty(self) -> bool:
        """True if there is a window, but its counts show that the skin did not measure a slide as
        it should. Nothing is learnt from such a sweep."""
        return self in (
            Status.NO_CONTACT,
            Status.SATURATED,
            Status.STUCK_TAXEL,
            Status.DEAD_TAXEL,
            Status.NO_SLIDE,
        )


REASONS: Mapping[Status, str] = MappingProxyType(
    {
        Status.UNKNOWN: "it differs from all trained and enrolled materials",
        Status.SHORT: "the stop edge came before a window's length had passed",
        Status.LONG: "no stop edge came in time",
        Status.GAP: "too many frames in a row are missing; check the skin's cable",
        Status.NO_CONTACT: "no taxel is loaded; check that the finger touches the object",
        Status.SATURATED: "too many raw counts at full scale; press less",
        Status.STUCK_TAXEL: "a loaded taxel shows a constant count; check the skin",
        Status.DEAD_TAXEL: "a taxel between loaded taxels is dead; check the skin",
        Status.SENSOR_LOST: "the skin was lost during the sweep; check its cable",
        Status.NO_START: "a stop edge without a start; check the GPIO line START",
        Status.NO_STOP: "a second start edge came; check the GPIO line STOP",
        Status.NOT_READY: "a start edge while READY was low; the robot must wait for READY",
        Status.EDGES_LOST: "trigger edges were lost; check the GPIO lines of the trigger",
        Status.ABORTED: "by command, or because the box was stopping",
        Status.RECORDED: "sweeps are recorded, not classified",
        Status.NO_SLIDE: "the finger rests in a part of the window; slide through all of it",
        Status.FAILED: "the box could not compute an answer; sweep again",
        Status.CONFLICT: "it contradicts the sweeps before it; signal NEW OBJECT for each object",
    }
)
"""The reason why a sweep has no label, and the remedy; PROTOCOL.md has the details."""
