"""The only list of the rules that a bundle may have, each with its parameters, and the order of the
stages that they give.

The module of the parameters has a twin, `fit_MODULE` in `palpate_train.answer`, that finds them.
Parameters with `judges` give stages that follow the network.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

from palpate.answer.contact import ContactPositions, DisplacementRule, LocateContact
from palpate.answer.correlation import Correlations
from palpate.answer.disturbance import Disturbances, MeasureDisturbances
from palpate.answer.early import Early
from palpate.answer.hum import HumFilter
from palpate.answer.objects import Certain, GivesNumbers, ObjectSweeps
from palpate.answer.pipeline import Stage, StageInputs
from palpate.answer.slide import MeasureSlide, SlideLimits, SpeedRange
from palpate.answer.taxels import Bridging, TaxelWatch
from palpate.answer.unknown import Known


class Stages(NamedTuple):
    """cleaning: change the counts. measuring: the others before the network. judging: look at its
    answer."""

    cleaning: list[Stage]
    measuring: list[Stage]
    judging: list[Stage]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """The parameters of each rule, None if the bundle lacks the rule, in the order in which rules
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

    def stages(self, given: StageInputs, taxels: TaxelWatch, objects: ObjectSweeps) -> Stages:
        """The stages of an answer, in the order in which they look at a sweep."""
        able, disturbed = None, self.disturbances
        cleaning, measuring = list[Stage]([taxels]), list[Stage]()
        if disturbed and disturbed.hum:
            cleaning.append(HumFilter(given.format, disturbed.hum))
        if self.contact and given.contact is not None:
            measuring.append(LocateContact(self.contact, given.contact))
        pitch_mm = self.contact.pitch_mm if self.contact and given.speeds else None
        wanted = bool(pitch_mm or disturbed)
        if wanted or (self.sliding and self.sliding.pattern):
            slide = MeasureSlide(given.format, pitch_mm, bridged=wanted)
            measuring.append(slide)
            able = slide.height if slide.able else None
        if disturbed:
            measuring.append(MeasureDisturbances(unloaded=given.unloaded))
            if self.known:
                measuring.append(disturbed)
        given = replace(given, height=able, beyond=(disturbed or Disturbances()).beyond)
        rules = [getattr(self, field.name) for field in fields(Rules)]
        judges = [one for of in rules if hasattr(of, "judges") for one in of.judges(given)]
        displaced = max(given.least, self.displacement.unsure if self.displacement else 0.0)
        judging = [GivesNumbers(), *judges, objects, Certain(given.least, displaced)]
        return Stages(cleaning, measuring, judging)
