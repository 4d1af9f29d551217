"""What the box says, as objects. In: the fields of RES, STA and ANS sentences (PROTOCOL.md, part
2). Out: Answer, BoxState, BoxIdentity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from appliance.core import sentences
from appliance.core.errors import FormatError
from appliance.core.status import REASONS, Status

ADVICE = {
    Status.OK: "use the label",
    Status.UNSURE: "sweep the same object once more",
    Status.UNDECIDED: "sort the object out: it has been swept as often as is allowed",
}
"""What to do with an answer that has a label; for the others there is `status.REASONS`."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to one sweep, with the fields of RES. Probability and margin are 0 to 1.

    time_s: of the box's monotonic clock. lost: frames of the window that were lost. loss_known:
    whether lost frames can be seen. missed: how many answers before this one did not arrive, as the
    numbers of the sweeps show.
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

    @classmethod
    def of(cls, fields: Sequence[str]) -> Answer:
        """The answer in the fields of a RES sentence. Raises FormatError where they do not have its
        form."""
        try:
            (
                sweep,
                time_s,
                status,
                label,
                probability,
                margin,
                fused,
                lost,
                latency,
                bundle,
                source,
                share,
            ) = fields[:12]
            return cls(
                int(sweep),
                float(time_s),
                Status(status),
                label,
                float(probability),
                float(margin),
                int(fused),
                int(lost),
                float(latency),
                bundle,
                source,
                float(share),
                ",".join(fields[12:13]),
                fields[13:14] != ["1"],
            )
        except ValueError as e:
            raise FormatError(
                f"RES,{','.join(fields)}: {e}; is the client older than the box?"
            ) from e

    @classmethod
    def read(cls, line: str) -> Answer | None:
        """The answer in a line, None if it is another sentence or damaged. Raises FormatError as
        `of` does."""
        heard = sentences.read(line.encode("ascii", "replace"))
        return cls.of(heard.fields) if heard.kind == "RES" and heard.summed else None

    @property
    def known(self) -> bool:
        """The label can be used."""
        return self.status is Status.OK

    @property
    def unsure(self) -> bool:
        """There is a label, but one more sweep of the same object is needed."""
        return self.status is Status.UNSURE

    @property
    def faulty(self) -> bool:
        """Nothing was learned of the object: the sweep, the skin or the wiring was not as it must
        be."""
        return not self.status.classified and self.status not in (Status.UNKNOWN, Status.RECORDED)

    @property
    def early(self) -> bool:
        """It came while the finger was sliding: the finger may stop, and no other answer
        follows."""
        return self.share < 1

    @property
    def what_to_do(self) -> str:
        """The reason for the status and what to do, with the box's detail."""
        text = ADVICE[self.status] if self.status in ADVICE else REASONS[self.status]
        return f"{text} ({self.detail})" if self.detail else text


@dataclass(frozen=True, slots=True)
class BoxState:
    """The state of the box, with the fields of STA; counts are since its program has started."""

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

    @classmethod
    def of(cls, fields: Sequence[str]) -> BoxState:
        """The state in the fields of STA or of the answer to STATE. Raises FormatError where they
        have another form."""
        try:
            time_s, skin, sweeping, *counts = fields[:9]
            answered, frames, lost, garbage, enumerations, dropped = map(int, counts)
            bundle, source = fields[9:11]
            return cls(
                float(time_s),
                skin,
                sweeping == "1",
                answered,
                frames,
                lost,
                garbage,
                enumerations,
                dropped,
                bundle,
                source,
            )
        except ValueError as e:
            raise FormatError(
                f"STA,{','.join(fields)}: {e}; is the client older than the box?"
            ) from e

    @property
    def ready(self) -> bool:
        """A sweep can begin."""
        return self.skin == "streaming" and not self.sweeping


@dataclass(frozen=True, slots=True)
class BoxIdentity:
    """What answers: name, version and id of the bundle, the form of its sweeps, and the skin's
    board."""

    name: str
    version: str
    bundle: str
    format: str
    skin: str

    @classmethod
    def of(cls, fields: Sequence[str]) -> BoxIdentity:
        """The fields of the answer to ID. Raises FormatError where there are fewer."""
        if len(fields) < 5:
            raise FormatError(
                f"ID,{','.join(fields)}: {len(fields)} fields instead of 5; is the client older "
                "than the box?"
            )
        return cls(*fields[:5])
