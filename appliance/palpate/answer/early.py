"""Early answers: with status ok, while the finger still slides.

The bundle's graph has a head for each step of the window. `Early` holds the least probability at
which each head may answer.

Whole answers are the same without it; the card of a bundle says at which share of the sweep it
answers, and what that loses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate.answer.pipeline import Context, Refusal
from palpate.answer.unknown import EarlyDistances
from palpate.core.errors import BundleError
from palpate.core.schema import Positive, Within, check
from palpate.core.status import Reason, Remark
from palpate.core.types import Status


@dataclass(frozen=True, slots=True)
class Early:
    """Rule for answers before the sweep has ended. Raises BundleError for a number out of range.

    least: [D], least probability for an answer at each step; above 1 a step never answers. agree:
    number of steps in a row, including the newest, that must give the same label, and be of a known
    material. limits: [D], largest squared distance of a known material at each step; () if unknown
    materials are not detected before the end of a sweep.
    """

    least: Annotated[tuple[Positive, ...], Within(1, 1000)]
    agree: int
    limits: tuple[Positive, ...] = ()

    def __post_init__(self) -> None:
        check(self, "early")
        if not 1 <= self.agree <= len(self.least):
            raise BundleError(
                f"early.agree {self.agree} must be 1 to {len(self.least)}, the number of steps; "
                "export the bundle again"
            )
        if self.limits and len(self.limits) != len(self.least):
            raise BundleError(
                f"early.limits {list(self.limits)} must be {len(self.least)}, one for each step; "
                "export the bundle again"
            )


def decides(scores: NDArray[np.float64], rule: Early) -> bool:
    """Whether `scores` float64 [d + 1, K], the probabilities of steps 0 to d, allow an answer at
    step d.

    This needs the same label at the last `rule.agree` steps, and a probability of at least
    `rule.least[d]` at step d.
    """
    labels = scores[-rule.agree :].argmax(axis=1)
    agreed = len(labels) == rule.agree and (labels == labels[-1]).all()
    return bool(agreed and scores[-1].max() >= rule.least[len(scores) - 1])


class EarlyNetwork:
    """The network's answer to an unfinished sweep.

    network: gives the outputs `early` float32 [D, K] and, with `distances`, `early_embedding`
    float32 [D, r], of a window of raw counts. window: its frames. For the graph a window is
    completed by repeating its last frame; the heads up to this step do not depend on these.
    """

    def __init__(
        self,
        network: Callable[[NDArray[Any]], list[NDArray[np.float32]]],
        rule: Early,
        distances: EarlyDistances | None,
        window: int,
    ) -> None:
        self._network, self._rule, self._distances = network, rule, distances
        self._window, self._steps = window, len(rule.least)

    def apply(self, context: Context) -> Refusal | None:
        """Refuse a sweep whose rest is needed, or whose material is unknown at one of the steps
        that must agree."""
        taxels, agree = context.taxels, self._rule.agree
        step = round(context.sweep.share * (self._steps + 1))  # counted from 1
        rest = taxels[-1:].repeat(self._window - len(taxels), axis=0)
        logits, *embedded = self._network(np.concatenate([taxels, rest]))
        context.logits = logits[step - 1]
        if not decides(softmax(logits[:step]), self._rule):
            return Refusal(Status.UNSURE, Remark(Reason.REST_NEEDED))
        if self._distances and not self._distances.known(embedded[0][:step])[-agree:].all():
            return Refusal(Status.UNKNOWN)
        return None
