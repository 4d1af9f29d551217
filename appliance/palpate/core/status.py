"""The outcomes of a sweep: one table with all that is said about each, for robots and people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple

UNSURE = 0.5
"""Least probability for status ok where neither settings nor the bundle give one."""
LEAST_PROBABILITY = 1e-12
"""Lower bound of probabilities in a fusion, so that one sweep with a probability of 0 cannot veto
all others."""


class Status(StrEnum):
    """The outcome of a sweep, in the order of the codes. PROTOCOL.md explains each."""

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
        return self in (Status.OK, Status.UNSURE, Status.UNDECIDED)

    @property
    def faulty(self) -> bool:
        """True if the counts show that the skin did not measure a slide: nothing is learnt."""
        fault = (Status.SATURATED, Status.STUCK_TAXEL, Status.DEAD_TAXEL)
        return self in (Status.NO_CONTACT, *fault, Status.NO_SLIDE)


USE, AGAIN, ASIDE = "use the label", "sweep again", "set the object aside"
HALT, NOTHING = "stop and call a person", "nothing"


class Reason(StrEnum):
    """Why a rule of the answer refuses a sweep, or what it remarks; DETAILS has the words."""

    TAXELS = "taxels"
    UNLOADED = "unloaded"
    TOO_FAR = "too-far"
    NO_PATTERN = "no-pattern"
    NOISE = "noise"
    RESTS = "rests"
    UNTRIED = "untried"
    UNLIKE_ALL = "unlike-all"
    UNLIKE_ALL_AGAIN = "unlike-all-again"
    NO_NUMBER = "no-number"
    ANOTHER_OBJECT = "another-object"
    REST_NEEDED = "rest-needed"
    UNCHECKED = "unchecked"
    STILL = "still"
    NOT_A_SLIDE = "not-a-slide"


_UNLIKE = "squared distance {distance:.4g} from {label}, limit {limit:.4g}"
DETAILS: Mapping[Reason, str] = MappingProxyType(
    {
        Reason.TAXELS: "{taxels}",
        Reason.UNLOADED: "strongest taxel {counts:.1f} raw counts",
        Reason.TOO_FAR: "named up to {farthest_mm:.1f} mm",
        Reason.NO_PATTERN: "no pattern passes from taxel to taxel, as with a finger that rests",
        Reason.NOISE: "the counts move like noise, not as over a slide",
        Reason.RESTS: "hardly any vibration in part {parts} of {of}, less than {label} gives",
        Reason.UNTRIED: "{what}",
        Reason.UNLIKE_ALL: _UNLIKE,
        Reason.UNLIKE_ALL_AGAIN: _UNLIKE + "; as sweep {sweep}",
        Reason.NO_NUMBER: "the model gives no number",
        Reason.ANOTHER_OBJECT: "another object: {label} after {before}",
        Reason.REST_NEEDED: "the rest of the sweep is needed",
        Reason.UNCHECKED: "{what}",
        Reason.STILL: "no taxel changes: check the cable",
        Reason.NOT_A_SLIDE: "{why}",
    }
)
"""The words of each reason, with places for its numbers."""


@dataclass(frozen=True, slots=True)
class Remark:
    """A reason with its numbers, by their names in DETAILS."""

    reason: Reason
    numbers: Mapping[str, Any] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The words for people."""
        return DETAILS[self.reason].format_map(self.numbers)


class Words(NamedTuple):
    """What is said about a status. code: for Modbus. colour: of the page's card: good, warn, bad or
    plain. word, advice: for an operator, on the page. robot: what the robot's program does. reason:
    why there is no label, and the remedy, for logs; "" with a label."""

    code: int
    colour: str
    word: str
    advice: str
    robot: str
    reason: str


# fmt: off
_ROWS = {  # by status: colour, word, advice, robot, reason
    Status.OK: ("good", "", "", USE, ""),
    Status.UNSURE: ("warn", "Unsure", "Sweep again.", "sweep the same object once more", ""),
    Status.UNDECIDED: ("warn", "Undecided", "More sweeps will not help: set the object aside.",
        ASIDE, ""),
    Status.UNKNOWN: ("warn", "Unknown", "Not like any taught material.", ASIDE,
        "it differs from all trained and enrolled materials"),
    Status.SHORT: ("bad", "Too short", "Slide for longer.", AGAIN,
        "the stop edge came before a window's length had passed"),
    Status.LONG: ("bad", "Too long", "No stop signal came: check the robot.", AGAIN,
        "no stop edge came in time"),
    Status.GAP: ("bad", "Gaps", "Frames are missing: check the skin's cable.", AGAIN,
        "too many frames in a row are missing; check the skin's cable"),
    Status.NO_CONTACT: ("bad", "No contact", "The finger did not touch the object.", AGAIN,
        "no taxel is loaded; check that the finger touches the object"),
    Status.SATURATED: ("bad", "Too much force", "Press less.", AGAIN,
        "too many raw counts at full scale; press less"),
    Status.STUCK_TAXEL: ("bad", "Skin faulty", "A taxel is stuck: check the skin.", HALT,
        "a loaded taxel shows a constant count; check the skin"),
    Status.DEAD_TAXEL: ("bad", "Skin faulty", "A taxel is dead: check the skin.", HALT,
        "a taxel between loaded taxels is dead; check the skin"),
    Status.SENSOR_LOST: ("bad", "Skin lost", "Check the skin's cable.", HALT,
        "the skin was lost during the sweep; check its cable"),
    Status.NO_START: ("bad", "No start", "A stop signal came alone: check the wire START.", HALT,
        "a stop edge without a start; check the GPIO line START"),
    Status.NO_STOP: ("bad", "No stop", "A second start signal came: check the wire STOP.", HALT,
        "a second start edge came; check the GPIO line STOP"),
    Status.NOT_READY: ("bad", "Too early", "The robot must wait until the box is ready.", AGAIN,
        "a start edge while READY was low; the robot must wait for READY"),
    Status.EDGES_LOST: ("bad", "Signals lost", "Check the wires of START and STOP.", HALT,
        "trigger edges were lost; check the GPIO lines of the trigger"),
    Status.ABORTED: ("plain", "Aborted", "By command, or because the box was stopping.", AGAIN,
        "by command, or because the box was stopping"),
    Status.RECORDED: ("plain", "Recorded", "The box records now, and names nothing.", NOTHING,
        "sweeps are recorded, not classified"),
    Status.CONFLICT: ("warn", "Contradiction",
        "Not like the sweeps before it: is this a new object?", AGAIN,
        "it contradicts the sweeps before it; signal NEW OBJECT for each object"),
    Status.NO_SLIDE: ("bad", "No slide", "The finger rested: slide all the way.", AGAIN,
        "the finger rests in a part of the window; slide through all of it"),
    Status.FAILED: ("bad", "Failed", "The box could not compute this sweep: sweep again.", AGAIN,
        "the box could not compute an answer; sweep again"),
}
# fmt: on
WORDS: Mapping[Status, Words] = MappingProxyType(
    {status: Words(code, *_ROWS[status]) for code, status in enumerate(Status, 1)}
)
"""The table. Client, pages, bridges, logs and documents are made from it, or tested against it."""
REASONS: Mapping[Status, str] = MappingProxyType(
    {status: words.reason for status, words in WORDS.items() if words.reason}
)
"""The reason why a sweep has no label, and the remedy; PROTOCOL.md has the details."""
