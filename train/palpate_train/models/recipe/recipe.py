"""The default recipe: from the sweeps of a training set to a finished model.

    training sweeps, and augmented copies of them
       |   features:    filters, distribution, spectrum, loads and relations, in closed form
       v
    candidates:         sums of discriminants, each of some of the features
       |   judged:      by groups that their heads did not see; then fewer filters
       v
    stages:             trained convolutions as well, if there are many sweeps of
       |                each material, too many of the held-out ones get a
       |                wrong label, and stages do not make that worse
       v
    pruned:             a trunk with only the features that a discriminant sees
       |   finished:    heads in float and int8, calibration, contact positions
       v
    Fit

Without stages a fit takes seconds and does not need PyTorch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core.errors import FormatError
from palpate_train.answer import embedding
from palpate_train.answer.heads import HeadData, HeadPlan, condition_values
from palpate_train.data import extras
from palpate_train.data.augment import (
    COPIES,
    Augmentation,
    copies,
    default_augmentation,
    texture_scale,
)
from palpate_train.data.progress import StageLine
from palpate_train.data.run import Log, Run
from palpate_train.data.sets import Dataset, thinned
from palpate_train.data.splitters import WEIGHT, InnerPart, inner_parts
from palpate_train.metrics.score import interval
from palpate_train.models.linear_head import hold_out_or_all
from palpate_train.models.methods import AS_RECORDED, SkinUse
from palpate_train.models.recipe import (
    bank,
    choice,
    distribution,
    graph,
    relations,
    slow,
    spectrum,
    stage_heads,
)
from palpate_train.models.recipe.architectures import MAINS_HZ, STAGES, Architecture
from palpate_train.models.recipe.bank import Bank
from palpate_train.models.recipe.choice import (
    ENOUGH,
    Candidates,
    FeatureColumns,
    HeldOutScores,
    ScoredPlan,
)
from palpate_train.models.recipe.fitted import Fit, finished
from palpate_train.models.recipe.memory import MOST_SWEEPS
from palpate_train.models.recipe.sizes import UNLIMITED, ModelSize
from palpate_train.models.recipe.trunk import Trunk, describe
from palpate_train.onnx_tools.graph_builder import run
from palpate_train.onnx_tools.quantize import calibration_sweeps

Array = NDArray[Any]
LEAST_EACH, LEAST_SWEEPS = 25, 100
"""Smallest numbers of sweeps for training stages, of each material and of all. Stages overfit to a
few sweeps of a material and to a few batches."""
PARTS = "features", "choice of the model", "training of stages"
"""Parts of a fit, for its progress."""
STAGE_STEPS = 600
"""Steps of the training of stages where nobody says another number."""
FIXED = Architecture((), planned=len(STAGES.channels))
"""A trunk without stages that prepares counts as a trunk with STAGES does."""


@dataclass(frozen=True, eq=False)
class Settings:
    """The settings of a fit.

    steps: of the training of stages; 0, the usual, for no stages. On none of seven recorded sets by
    which nothing was chosen did they gain, and they took up to nine tenths of the time. size:
    limits the content of the model. use: of the skin. calibrate: whether the fit is finished with
    calibration and contacts, which a bundle needs and `evaluate` does not. displaced: whether
    displaced contacts are calibrated; they need the distance between taxels. varies: the groups
    that will have other values in service; without any, all that can be left out. most: largest
    number of sweeps that are used; of more, some are drawn, see sets.thinned. strangers: as in Fit.
    """

    steps: int = 0
    size: ModelSize = UNLIMITED
    use: SkinUse = AS_RECORDED
    calibrate: bool = True
    displaced: bool = True
    varies: tuple[str, ...] = ()
    most: int = MOST_SWEEPS
    strangers: Array | None = None


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that the steps of a fit share, each part computed when it is first needed."""

    sweeps: Dataset
    run: Run
    settings: Settings
    augmentation: Augmentation

    @classmethod
    def of(cls, sweeps: Dataset, run: Run, settings: Settings) -> Setup:
        """Raises FormatError if the window is too short, or if nothing can be held out."""
        groups = {"recording": sweeps.group("recording")} | sweeps.groups  # numbered before a split
        sweeps = thinned(replace(sweeps, groups=groups), settings.most)
        augmentation = default_augmentation(FIXED.zero_sum(sweeps.format.window))
        setup = cls(sweeps, run, settings, augmentation)
        _ = setup.parts  # refused before the features are computed, which takes minutes
        return setup

    @cached_property
    def copies(self) -> list[Dataset]:
        """Augmented copies of the sweeps."""
        return list(copies(self.sweeps, self.augmentation, self.run.seed, COPIES))

    @cached_property
    def fixed(self) -> FixedFeatures:
        """Step 1: the features that need no training."""
        self.part(1)(f"features of {len(self.sweeps)} sweeps")
        trunk = fixed_trunk(self.sweeps, self.run.seed, self.settings.use.mains_hz)
        scales = trunk.architecture.relations
        columns = FeatureColumns.of(trunk.layout(), Bank.of(trunk.weights).free, scales)
        return FixedFeatures(trunk, self.data(trunk), columns)

    @cached_property
    def parts(self) -> list[InnerPart]:
        """The parts by which candidates are judged."""
        return inner_parts(self.sweeps, varies=self.settings.varies)

    @cached_property
    def left_out(self) -> tuple[str, ...]:
        """The groups whose values the parts leave out."""
        return tuple(dict.fromkeys(part.group for part in self.parts))

    @cached_property
    def values(self) -> Array:
        """The value [N, C] of each condition of the parts, as HeadData has them."""
        groups = {name: self.sweeps.group(name) for name in self.left_out}
        return condition_values(groups, len(self.sweeps))

    @cached_property
    def held_out_scores(self) -> HeldOutScores:
        """The scores of heads of fixed features on the parts by which candidates are judged."""
        return self.scores(self.fixed.data, self.parts)

    @cached_property
    def conditions(self) -> tuple[str, ...]:
        """The groups of which each value can be left out, the hardest first: that whose sweeps the
        usual heads classify worst if they have not seen its value. Groups of two values come last:
        without one of them, heads learn nothing of how the other varies. Without any, recordings.
        """
        left_out = tuple(filter(self._judges, self.left_out)) or ("recording",)
        if len(left_out) < 2:
            return left_out
        scores = self.held_out_scores
        right = scores.right(scores.score(candidates(self.fixed, self).usual()))

        def order(name: str) -> tuple[bool, float]:
            of = scores.own & (scores.groups == name)
            return len(np.unique(self.sweeps.group(name))) < 3, float(right[of].mean())

        return tuple(sorted(left_out, key=order))

    def _judges(self, name: str) -> bool:
        """Whether two materials remain without any value of a group, to judge its sweeps by."""
        _, values = np.unique(self.sweeps.group(name), return_inverse=True)
        rests = [self.sweeps.labels[rest] for rest, _ in embedding.parts(values, values >= 0)]
        return all(len(np.unique(rest)) > 1 for rest in rests)

    @cached_property
    def judging(self) -> InnerPart:
        """The sweeps on which stages are not trained, and which judge them: some values of the
        hardest condition. The group is "nothing" if there are too few groups."""
        index = np.arange(len(self.sweeps))
        numbered = replace(self.sweeps, groups=self.sweeps.groups | {"index": index})
        _, held, by = hold_out_or_all(numbered, self.run.seed, self.conditions)
        return InnerPart(by, np.isin(index, held.group("index")))

    @cached_property
    def sides(self) -> tuple[Dataset, Dataset]:
        """The sweeps to train stages on, and those to judge them by."""
        if self.judging.group == "nothing":
            return self.sweeps, self.sweeps
        return self.sweeps.take(~self.judging.out), self.sweeps.take(self.judging.out)

    def wants_stages(self, size: ModelSize) -> bool:
        """Whether a model of this size may have stages, and there are enough sweeps for them."""
        each = np.unique(self.sweeps.labels, return_counts=True)[1]
        enough = len(self.sweeps) >= LEAST_SWEEPS and each.min() >= LEAST_EACH
        return bool(self.settings.steps and size.stages and enough and extras.installed("torch"))

    def may_train(self, size: ModelSize) -> bool:
        """Whether stages can be trained for a model of this size, and judged."""
        return self.wants_stages(size) and self.judging.group != "nothing"

    @cached_property
    def stages(self) -> tuple[Trunk, HeadData]:
        """Stages trained on the sweeps that are not held out, as a trunk of their own, and their
        features of all sweeps and copies."""
        trunk = _trained(self)
        return trunk, self.data(trunk)

    def data(self, trunk: Trunk, int8: bool = True) -> HeadData:
        """The features of all sweeps and copies."""
        return HeadData(
            trunk.features(self.sweeps, int8),
            self.sweeps.labels,
            lambda: np.concatenate([trunk.features(one, int8) for one in self.copies]),
            np.tile(np.arange(len(self.sweeps)), COPIES),
            self.values,
            self.sweeps.groups.get(WEIGHT),
        )

    def scores(self, data: HeadData, parts: list[InnerPart]) -> HeldOutScores:
        """The scores of heads of these features on these parts."""
        classes, copied = len(self.sweeps.materials), self.settings.use.reattached
        return HeldOutScores([data] * len(parts), parts, classes, copied)

    def part(self, number: int) -> Log:
        """The log of one part of the fit. The third part, the stages, takes most of the time; it is
        left out if the first two suffice."""
        parts = 3 if self.wants_stages(self.settings.size) else 2
        return lambda line: self.run.log(StageLine.of(number, parts, PARTS[number - 1], line))


@dataclass(frozen=True)
class FixedFeatures:
    """The fixed trunk with the features of all sweeps and copies, and where these are."""

    trunk: Trunk
    data: HeadData
    columns: FeatureColumns

    def limited(self, size: ModelSize) -> FixedFeatures:
        """Only the features that a model of this size may see. Raises FormatError if there are
        none."""
        columns = self.columns.limited(size)
        if not (columns.kinds or len(columns.bands)):
            raise FormatError(
                f"windows of {self.trunk.sweeps.format.window} frames are too short for a "
                "spectrum, and this size has nothing else; use a size with filters"
            )
        return replace(self, columns=columns)


@dataclass(frozen=True)
class HeadChoice:
    """The chosen heads, and the scores by which they were chosen."""

    scores: HeldOutScores
    chosen: ScoredPlan

    def validation(self) -> dict[str, Any]:
        """Accuracy on held-out parts of heads that did not see them, with its 95 % interval by
        part; copies do not count."""
        own = self.scores.own
        right = (self.chosen.logits.argmax(axis=1) == self.scores.labels)[own]
        low, high = interval(right, self.scores.clusters[own])
        accuracy = round(float(right.mean()), 4)
        return {"accuracy": accuracy, "n": len(right), "low": low, "high": high}


def fit(sweeps: Dataset, run: Run, settings: Settings = Settings()) -> Fit:
    """A model for the materials of `sweeps`, which must all occur. A fifth of the groups is
    held out from stages and calibration.

    Raises FormatError if the window is shorter than a filter, if every taxel is constant, or if
    materials have too few recordings to hold some out.
    """
    return fit_size(Setup.of(sweeps, run, settings), settings.size)


def fit_size(setup: Setup, size: ModelSize) -> Fit:
    """The model of this size. Raises FormatError if the windows are too short for it."""
    fixed = setup.fixed.limited(size)
    stages, judged = judged_size(fixed, setup, size)
    return finish(stages, judged, setup)


def judged_size(
    fixed: FixedFeatures, setup: Setup, size: ModelSize
) -> tuple[Trunk | None, HeadChoice]:
    """Steps 2 to 4 for a model of this size, to whose features `fixed` is limited."""
    judged = judge(candidates(fixed, setup), fixed, setup)
    enough = judged.scores.accuracy(judged.chosen) >= ENOUGH
    if enough or not setup.may_train(size):
        return None, judged
    return with_stages(judged, fixed, setup)


def candidates(fixed: FixedFeatures, setup: Setup) -> Candidates:
    """Step 2: the heads to choose from."""
    groups = bool((setup.held_out_scores.groups != "recording").any())
    reattached, size = setup.settings.use.reattached, setup.settings.size
    return Candidates(fixed.columns, reattached, groups and size.loads)


def judge(heads: Candidates, fixed: FixedFeatures, setup: Setup) -> HeadChoice:
    """Step 3: the best candidate by held-out groups, with as few filters as suffice."""
    scores = setup.held_out_scores
    chosen = choice.choose(scores, heads, setup.part(2))
    filters = fixed.columns.filters()
    return HeadChoice(scores, choice.with_fewer_filters(scores, chosen, filters, setup.part(2)))


def with_stages(
    judged: HeadChoice, fixed: FixedFeatures, setup: Setup
) -> tuple[Trunk | None, HeadChoice]:
    """Step 4: trained stages and the heads with them; None and `judged` if these are better.

    If the skin will be reattached, or if there is nothing but the spectrum besides stages, each
    stage and the spectrum suffice, unless held-out sweeps and their copies show that more is
    better: a displaced contact changes the responses of filters more, and a spectrum alone is too
    weak. Sweeps of the recorded positions alone could not show it. Stages stay away where sweeps
    that they were not trained on are classified worse than without them.
    """
    log, plan = setup.part(3), judged.chosen.plan
    stages, responses = setup.stages
    scores = setup.scores(responses.beside(fixed.data), [setup.judging])
    beside = stage_heads.beside(plan)
    joined = full = scores.score(beside)
    columns = stage_heads.fixed_columns(fixed.columns, plan)
    if setup.settings.use.reattached or set(plan.columns()) <= set(columns):
        log("choosing: stages and the spectrum alone")
        lean = scores.score(stage_heads.alone(columns))
        joined = full if scores.paired(full, lean).better else lean
    log("choosing: without stages")
    if scores.paired(joined, scores.score(beside[1:])).worse:
        return None, judged
    if joined is full:
        filters = np.append(np.full(sum(STAGES.channels), -1), fixed.columns.filters())
        joined = choice.with_fewer_filters(scores, full, filters, log)
    return stages, HeadChoice(scores, joined)


def pruned(fixed: Trunk, stages: Trunk | None, plan: HeadPlan) -> tuple[Trunk, HeadPlan]:
    """Step 5: the trunk with only the features that discriminants of `plan` see, and the plan for
    it."""
    size, used = sum(STAGES.channels) if stages else 0, plan.columns()
    seen = {
        name: used[(used >= size + part.start) & (used < size + part.stop)] - size - part.start
        for name, part in fixed.layout().items()
    }
    seen = {name: numbers for name, numbers in seen.items() if len(numbers)}
    pools = tuple(name for name in bank.POOLS if name in seen)
    architecture = replace(
        stages.architecture if stages else fixed.architecture,
        pools=pools,
        distribution="levels" in seen,
        loads="loads" in seen,
        relations=len(seen.get("relations", ())) // relations.each(fixed.sweeps.format),
        slow="slow" in seen,
        spectrum="bands" in seen,
    )
    weights = dict(stages.weights) if stages else {}
    weights |= Bank.of(fixed.weights).take(seen[pools[0]]).weights() if pools else {}
    weights |= distribution.Levels.of(fixed.weights).weights() if architecture.distribution else {}
    ranges = replace(fixed.ranges, responses=stages.ranges.responses) if stages else fixed.ranges
    return Trunk(fixed.sweeps, fixed.scale, weights, architecture, ranges), plan.renumbered(used)


def finish(stages: Trunk | None, judged: HeadChoice, setup: Setup) -> Fit:
    """Step 6: heads of the float and the int8 trunk, calibration and contacts."""
    settings, classes, heads = setup.settings, len(setup.sweeps.materials), {}
    fixed, chosen = setup.fixed, judged.chosen.plan
    trunk, plan = pruned(fixed.trunk, stages, chosen)
    known = setup.stages[1].beside(fixed.data) if stages else fixed.data
    columns = chosen.columns()
    seen = known.seen(columns)
    in_float = setup.data(trunk, False) if trunk.quantized else seen
    for name, data in (("head", in_float), ("int8", seen)):
        weight, bias = plan.fit(data, classes)
        heads[f"{name}.weight"] = weight - weight.mean(axis=0)
        heads[f"{name}.bias"] = bias - bias.mean()
    about = {
        "seed": setup.run.seed,
        "recipe": {
            "augmentation": vars(setup.augmentation),
            "steps": settings.steps,
            "reattached": settings.use.reattached,
            "mains_hz": settings.use.mains_hz,
        },
        "held_out_by": setup.judging.group,
        "conditions": list(setup.conditions),
        "chosen": describe(trunk, plan),
        "validation": judged.validation(),
    }
    made = Fit(
        {**trunk.weights, **heads},
        *(trunk.scale, trunk.architecture, trunk.ranges, *setup.sides, about),
        plan=plan.uncooled(),
        strangers=settings.strangers,
    )
    if not settings.calibrate:
        return made
    drawn = fixed.data.drawn and setup.judging.group != "nothing"
    copied = known.seen(columns).take(~setup.judging.out) if drawn else None
    return finished(made, copied, settings.displaced)


def fixed_trunk(sweeps: Dataset, seed: int, mains_hz: float = MAINS_HZ) -> Trunk:
    """The trunk with the whole bank, the distribution and the spectrum.

    Raises FormatError if the window is shorter than a filter, or if every taxel of every sweep is
    constant.
    """
    format, rng = sweeps.format, np.random.default_rng(seed)
    some = calibration_sweeps(sweeps.samples[rng.permutation(len(sweeps))])
    if not np.ptp(sweeps.samples, axis=1).any():
        raise FormatError("every taxel of every sweep is constant; check the skin")
    scale = texture_scale(sweeps.samples)
    architecture = replace(
        FIXED,
        spectrum=spectrum.count(format) > 0,
        pools=bank.POOLS,
        distribution=True,
        loads=True,
        relations=relations.scales(format),
        slow=slow.count(format) > 0,
        mains_hz=mains_hz,
    )
    kinds = (False,) if architecture.zero_sum(format.window) else (False, True)
    drawn = bank.draw(format, rng, kinds)
    seen: list[Array] = [np.empty(0)] * len(drawn)
    for numbers, model in graph.bank_responses(format, scale, architecture, drawn):
        for number, values in zip(numbers, run(model, some).swapaxes(0, 2), strict=True):
            seen[number] = values.ravel()
    ranges = graph.Ranges(graph.count_range(some, architecture), ())
    weights = (
        bank.fitted(drawn, seen, rng).weights() | distribution.fitted(some, scale, rng).weights()
    )
    return Trunk(sweeps, scale, weights, architecture, ranges)


def _trained(setup: Setup) -> Trunk:
    """See Setup.stages."""
    with extras.needed_for("the training of stages"):
        from palpate_train.models.recipe import stages

    settings, sweeps = setup.settings, setup.sides[0]
    scale = texture_scale(setup.sweeps.samples)
    architecture = replace(STAGES, mains_hz=settings.use.mains_hz)
    weights, ranges = stages.train_stages(
        sweeps,
        scale,
        replace(setup.run, log=setup.part(3)),
        settings.steps,
        setup.augmentation,
        architecture,
    )
    return Trunk(sweeps, scale, weights, architecture, ranges)
