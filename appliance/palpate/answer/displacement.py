"""The rule for contacts that are displaced from those of training."""

from __future__ import annotations

from dataclasses import dataclass

from palpate.answer.pipeline import Context, JudgeInputs, Refusal, Stage
from palpate.core.schema import Positive, check
from palpate.core.status import Reason, Remark
from palpate.core.types import Status


@dataclass(frozen=True, slots=True)
class DisplacementRule:
    """Rule for sweeps whose contact is displaced from `Manifest.contact`. Raises BundleError for a
    number out of range.

    limit: as Known.balanced, for the distances of displaced sweeps. temperature: divisor of logits
    that are calibrated for sweeps without displacement. unsure: least probability for status ok;
    above 1 a single displaced sweep is never ok. farthest_mm: displacement from which on a sweep
    gets no label, because no training copy is displaced as far; None if unknown.
    """

    limit: Positive
    temperature: Positive
    unsure: Positive
    farthest_mm: Positive | None = None

    def __post_init__(self) -> None:
        check(self, "displacement")

    def judges(self, given: JudgeInputs) -> list[Stage]:
        """Whether the contact is within reach."""
        return [] if self.farthest_mm is None else [WithinReach(self.farthest_mm)]


class WithinReach:
    """Refuses a contact that is displaced further than any training copy, `farthest_mm`."""

    def __init__(self, farthest_mm: float) -> None:
        self._farthest_mm = farthest_mm

    def apply(self, context: Context) -> Refusal | None:
        """Refuse a sweep that is too far off."""
        if context.displacement.mm > self._farthest_mm:
            return Refusal(
                Status.UNKNOWN, Remark(Reason.TOO_FAR, {"farthest_mm": self._farthest_mm})
            )
        return None
