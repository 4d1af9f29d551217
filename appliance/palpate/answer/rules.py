"""The only list of the rules that a bundle may have, each with its parameters.

The module of the parameters has a twin, `fit_MODULE` in `palpate_train.answer`, that finds them.
Parameters with `judges` give stages that follow the network.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

from palpate.answer.contact import ContactPositions
from palpate.answer.correlation import Correlations
from palpate.answer.displacement import DisplacementRule
from palpate.answer.disturbance import Disturbances
from palpate.answer.early import Early
from palpate.answer.pipeline import JudgeInputs, Stage
from palpate.answer.slide import SpeedRange
from palpate.answer.taxels import Bridging
from palpate.answer.unknown import Known
from palpate.answer.vibration import SlideLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """The parameters of each rule, None for one that the bundle lacks, in the order in which rules
    judge and are left out on trial.

    disturbances: noise, load, speed, lost frames and hum. displacement: contacts elsewhere. speeds:
    range in training. sliding: limits between slides and rests. correlations: between slides
    and noise. bridging: broken taxels that the model tolerates. known: unknown materials. contact:
    positions in training.
    """

    early: Early | None = None
    disturbances: Disturbances | None = None
    displacement: DisplacementRule | None = None
    speeds: SpeedRange | None = None
    sliding: SlideLimits | None = None
    correlations: Correlations | None = None
    bridging: Bridging | None = None
    known: Known | None = None
    contact: ContactPositions | None = None

    def judges(self, given: JudgeInputs) -> list[Stage]:
        """The stages after the network."""
        rules = [getattr(self, field.name) for field in fields(Rules)]
        return [stage for rule in rules if hasattr(rule, "judges") for stage in rule.judges(given)]
