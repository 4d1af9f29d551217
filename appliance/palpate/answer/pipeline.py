"""The way from a sweep to what is known of it: stages in one order, a file a rule.

A stage looks at the sweep and at what earlier stages have found, adds what it finds, and may refuse
the sweep; then no later stage sees it. Stages do not know each other; `rules` has their order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.answer.window import Window
from palpate.core.status import Remark
from palpate.core.types import Status, Sweep, SweepFormat

Array = NDArray[Any]


def _none() -> Array:
    return np.empty(0)


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a sweep gets no label: its status, and a remark with the subject of the status."""

    status: Status
    remark: Remark | None = None


@dataclass(frozen=True, slots=True)
class Displacement:
    """The displacement of a contact from the trained positions: its length, and a description for
    people, for example "moved 2.1 mm too far towards row 4"; 0 for a contact in place."""

    mm: float = 0.0
    text: str = ""

    @property
    def off(self) -> bool:
        """Whether the contact is not in place."""
        return self.mm > 0


@dataclass(frozen=True, slots=True)
class Slide:
    """How the finger slid in a window.

    speed_mm_s: to three digits; None if it could not be measured, with the reason in `why`.
    direction: of the finger, one of DIRECTIONS; None without a speed. height: of the highest sum,
    in standard deviations of a sum with random phases; 0 if nothing was computed. taxels_s: the
    speed in taxels a second, 0 without one.
    """

    speed_mm_s: float | None = None
    direction: str | None = None
    height: float = 0.0
    why: str | None = None
    taxels_s: float = 0.0


@dataclass(slots=True, eq=False)
class Context:
    """A sweep, with the findings of the stages so far.

    taxels: raw counts [T, R, C] or [T, R, C, A], as the network gets them: broken taxels bridged,
    without hum. tare: raw counts [R, C] or [R, C, A] of the unloaded skin. whole: whether all
    frames of the window are there. mean: counts of the checked window, in the shape of a frame.
    full: share of its counts at full scale. degraded: the broken taxels that were bridged, None
    for none. hum: amplitude that was removed, in counts. disturbed: values of the disturbances by
    name. logits, embedding: [K], [r], of the network. far: float32 [K], of a contact in place: the
    log of 1 + the squared distance to each label in units of the limit. doubtful: the same in units
    of the limit with disturbances, of a doubtful sweep that belongs to an object. probabilities:
    float64 [K], of this sweep. own: the same, of a sweep that belongs to an object. scores: float64
    [K], of all `fused` sweeps of the object. after: as in Verdict. final: no further sweep of the
    object is wanted. status, remark: of the answer.
    """

    sweep: Sweep
    taxels: Array
    tare: Array
    whole: bool
    status: Status = Status.OK
    remark: Remark | None = None
    mean: Array | None = None
    full: float = 0.0
    degraded: str | None = None
    hum: float = 0.0
    displacement: Displacement = Displacement()
    slide: Slide = Slide()
    disturbed: Mapping[str, float] = field(default_factory=dict)
    logits: Array = field(default_factory=_none)
    embedding: Array = field(default_factory=_none)
    far: Array = field(default_factory=_none)
    doubtful: Array = field(default_factory=_none)
    probabilities: NDArray[np.float64] = field(default_factory=_none)
    own: NDArray[np.float64] = field(default_factory=_none)
    scores: NDArray[np.float64] = field(default_factory=_none)
    fused: int = 0
    after: int = 0
    final: bool = False
    _window: Window | None = None

    @property
    def window(self) -> Window:
        """The taxels, with what several stages need of them."""
        if self._window is None or self._window.taxels is not self.taxels:
            self._window = Window(self.taxels)
        return self._window


@dataclass(frozen=True, slots=True)
class StageInputs:
    """Data that a rule may need with its parameters. labels: [K]. format: of the sweeps. contact:
    least load of a taxel in contact, None if it is unknown. unloaded: whether training knew the
    unloaded skin. speeds: whether answers have the speed. least: probability for status ok.
    decided: as of EnrolledLabels. beyond: see Disturbances. height: of the pattern in a sweep; None
    if slides on this skin cannot be measured."""

    labels: Sequence[str]
    format: SweepFormat
    contact: float | None
    unloaded: bool
    speeds: bool
    least: float
    decided: Callable[[Array], Array]
    beyond: Callable[[str, Mapping[str, float]], float] = lambda name, values: 0.0
    height: Callable[[Context], float] | None = None


class Stage(Protocol):
    """One rule of the answer."""

    def apply(self, context: Context) -> Refusal | None:
        """Add to `context` what this stage finds; the refusal if the sweep gets no label."""


def run(stages: Sequence[Stage], context: Context) -> Context:
    """Let the stages look at a sweep in their order, up to the first that refuses it."""
    for stage in stages:
        if refusal := stage.apply(context):
            context.status, context.remark = refusal.status, refusal.remark
            break
    return context
