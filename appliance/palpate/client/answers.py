"""Answers and states of the box as objects, read from the fields of RES, FIN, STA and ANS sentences
(PROTOCOL.md, part 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, get_type_hints

from palpate.core import sentences
from palpate.core.errors import FormatError
from palpate.core.status import WORDS, Status

ANSWER_FIELDS, STATE_FIELDS = 12, 11
"""Fields that each RES and each STA has; others follow."""


def _number(text: str) -> float:
    """Raises ValueError for NaN and infinity, which no other program could read in JSON."""
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} is not a number")
    return number


def _first(kind: type, fields: Sequence[str], number: int) -> dict[str, Any]:
    """The first fields of a sentence by name, of the types in `kind`. Raises ValueError if they are
    too few or of another type."""
    hints: dict[str, Any] = get_type_hints(kind) | {"sweeping": "1".__eq__}
    hints |= {name: _number for name, hint in hints.items() if hint is float}
    names = list(hints)[:number]
    return {n: hints[n](text) for n, text in zip(names, fields[:number], strict=True)}


def _malformed(kind: str, fields: Sequence[str], why: object) -> FormatError:
    return FormatError(f"{kind},{','.join(fields)}: {why}; is the client older than the box?")


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to one sweep, with the fields of RES. Probability and margin are 0 to 1.

    time_s: of the box's monotonic clock. lost: number of lost frames in the window. loss_known:
    whether lost frames can be seen. missed: number of answers lost just before this answer,
    counted by the numbers of the sweeps. measured_mm_s, direction: of the slide as the box measured
    it, `rows+`, `rows-`, `cols+` or `cols-` for the direction; None and "" if it was not measured.
    finger: of an answer of one finger, else "". fingers: the answers that a hand's answer was fused
    from, as far as they arrived; empty of a box with one skin.
    """

    sweep: int
    time_s: float
    status: Status
    label: str
    probability: float
    margin: float
    fused: int
    lost: int
    latency_ms: float
    bundle: str = ""
    source: str = ""
    share: float = 1.0
    detail: str = ""
    loss_known: bool = True
    missed: int = 0
    measured_mm_s: float | None = None
    direction: str = ""
    finger: str = ""
    fingers: tuple[Answer, ...] = ()

    @classmethod
    def of(cls, fields: Sequence[str]) -> Answer:
        """The answer in the fields of a RES sentence. Raises FormatError if they are invalid."""
        try:
            first = _first(cls, fields, ANSWER_FIELDS)
            return cls(
                **first,
                detail=",".join(fields[12:13]),
                loss_known=fields[13:14] != ["1"],
                measured_mm_s=_number(fields[14]) if "".join(fields[14:15]) else None,
                direction="".join(fields[15:16]),
            )
        except ValueError as e:
            raise _malformed("RES", fields, e) from e

    @classmethod
    def of_finger(cls, fields: Sequence[str]) -> Answer:
        """The answer in the fields of a FIN sentence. Raises FormatError as `of` does."""
        return replace(cls.of(fields[1:]), finger="".join(fields[:1]))

    @classmethod
    def read(cls, line: str) -> Answer | None:
        """The answer in a line; None if it is another sentence or damaged. Raises FormatError as
        `of` does."""
        heard = sentences.read(line.encode("ascii", "replace"))
        return cls.of(heard.fields) if heard.kind == "RES" and heard.summed else None

    @property
    def known(self) -> bool:
        """Whether the label can be used."""
        return self.status is Status.OK

    @property
    def unsure(self) -> bool:
        """Whether there is a label, but one more sweep of the same object is needed."""
        return self.status is Status.UNSURE

    @property
    def faulty(self) -> bool:
        """Whether nothing was learned about the object, because of a fault of the sweep, the skin
        or the wiring."""
        return not self.status.classified and self.status not in (Status.UNKNOWN, Status.RECORDED)

    @property
    def early(self) -> bool:
        """Whether the answer came while the finger was sliding. The finger may stop, and no other
        answer follows."""
        return self.share < 1

    @property
    def what_to_do(self) -> str:
        """The reason for the status and its remedy, with the box's detail."""
        text = WORDS[self.status].reason or WORDS[self.status].robot
        return f"{text} ({self.detail})" if self.detail else text


@dataclass(frozen=True, slots=True)
class BoxState:
    """The state of the box, with the fields of STA; it counts since the start of its program.

    degraded: broken taxels that the box bridges, "" for none.
    """

    time_s: float
    skin: str
    sweeping: bool
    answered: int
    frames: int
    lost_frames: int
    garbage_bytes: int
    enumerations: int
    dropped: int
    bundle: str
    source: str
    degraded: str = ""

    @classmethod
    def of(cls, fields: Sequence[str]) -> BoxState:
        """The state in the fields of STA or of the answer to STATE. Raises FormatError if they are
        invalid."""
        try:
            first = _first(cls, fields, STATE_FIELDS)
            return cls(**first, degraded=",".join(fields[18:19]))
        except ValueError as e:
            raise _malformed("STA", fields, e) from e

    @property
    def ready(self) -> bool:
        """Whether a sweep can begin."""
        return self.skin == "streaming" and not self.sweeping


@dataclass(frozen=True, slots=True)
class BoxIdentity:
    """Identity of the box: name, version and id of the bundle, the format of its sweeps, and the
    readout board."""

    name: str
    version: str
    bundle: str
    format: str
    skin: str

    @classmethod
    def of(cls, fields: Sequence[str]) -> BoxIdentity:
        """The fields of the answer to ID. Raises FormatError if there are too few."""
        if len(fields) < 5:
            raise _malformed("ID", fields, f"{len(fields)} fields instead of 5")
        return cls(*fields[:5])
