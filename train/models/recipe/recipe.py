"""The default recipe: a trunk and its heads, chosen by held-out groups of the training sweeps. In:
a Dataset. Out: a Fit.

Bank, distribution and spectrum are fixed, so that choosing among them takes seconds and no PyTorch.
Trained stages join what was chosen, where PyTorch is installed and sweeps are many, unless that
names nearly everything. What the heads do not use is left out of the trunk.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appliance.core.errors import FormatError
from train.calibration.heads import HeadData, HeadPart, HeadPlan
from train.data.sets import Dataset
from train.data.splitters import InnerPart, inner_parts
from train.metrics.score import interval
from train.models.linear_head import hold_out_or_all
from train.models.methods import Log, no_log
from train.models.recipe import bank, choice, distribution, graph, spectrum
from train.models.recipe.architectures import ARCHITECTURES, MAINS_HZ, Architecture
from train.models.recipe.augment import (
    COPIES,
    Augmentation,
    copies,
    default_augmentation,
    texture_scale,
)
from train.models.recipe.bank import Bank
from train.models.recipe.choice import HeldOutScores, ScoredPlan
from train.models.recipe.fitted import Fit, finished
from train.onnx_tools.graph_builder import run
from train.onnx_tools.quantize import calibration_sweeps

Array = NDArray[Any]
STAGES = ARCHITECTURES["50k"]
"""The stages that are trained."""
LEAST_SWEEPS = 200
"""For training stages: fewer than a few batches give stages that know them by heart."""
ENOUGH = 0.99
"""Accuracy on held-out parts that leaves stages too little to mend for what they take of a bundle
and of its time."""
FIXED = Architecture((), planned=len(STAGES.channels), fewest=0)
"""A trunk without stages that prepares counts as one with STAGES does."""


@dataclass(frozen=True)
class Settings:
    """What a user may set. steps: of the training of stages; 0 to try none. augmentation: None for
    the usual one. choose: whether anything is chosen; else all zero-sum filters are seen by one
    discriminant. unfinished: a file that keeps the training of stages from time to time, from which
    it goes on with the same bits. reattached: the skin will be taken off and put back after these
    recordings, so that all heads see augmented copies, which look so. mains_hz: see
    Architecture. calibrate: whether the fit is calibrated, which a bundle needs and `evaluate` does
    not."""

    steps: int = 600
    augmentation: Augmentation | None = None
    choose: bool = True
    unfinished: Path | None = None
    reattached: bool = False
    mains_hz: float = MAINS_HZ
    calibrate: bool = True


@dataclass(frozen=True)
class Trunk:
    """A trunk without heads, for sweeps of one set. weights: of stages and bank, as
    graph.trunk_graph takes them."""

    sweeps: Dataset
    scale: float
    weights: Mapping[str, Array]
    architecture: Architecture
    ranges: graph.Ranges

    def features(self, sweeps: Dataset, int8: bool = True) -> Array:
        """What the heads see of `sweeps`, float32 [n, F]."""
        ranges = self.ranges if int8 else None
        return run(
            graph.trunk_graph(sweeps.format, self.scale, self.weights, self.architecture, ranges),
            sweeps.samples,
        )

    def layout(self) -> dict[str, slice]:
        """See graph.layout."""
        return graph.layout(self.sweeps.format, self.weights, self.architecture)


def fit(sweeps: Dataset, seed: int, settings: Settings = Settings(), log: Log = no_log) -> Fit:
    """Choose and fit on `sweeps`, of which each material must occur; a fifth of the groups is what
    stages never see.

    Raises FormatError where the window is shorter than a filter, every taxel is constant, or
    materials have too few recordings to hold some out.
    """
    augmentation = settings.augmentation or default_augmentation(
        FIXED.zero_sum(sweeps.format.window)
    )
    out, by = _held_out(sweeps, seed)
    may_train = (
        settings.steps and len(sweeps) >= LEAST_SWEEPS and by != "nothing" and find_spec("torch")
    )
    told = partial(_tell, log, 3 if may_train else 2)
    told(1, f"features of {len(sweeps)} sweeps and {COPIES} copies of each")
    fixed = fixed_trunk(sweeps, seed, settings.mains_hz)
    changed = list(copies(sweeps, augmentation, seed, COPIES))
    known, classes = _known(fixed, sweeps, changed), len(sweeps.materials)
    parts = inner_parts(sweeps)
    scores = HeldOutScores([known] * len(parts), parts, classes, settings.reattached)
    judged, stages = _choose(scores, fixed, settings, partial(told, 2)), None
    train, held = (sweeps.take(~out), sweeps.take(out)) if by != "nothing" else (sweeps, sweeps)
    if may_train and scores.accuracy(judged) < ENOUGH:
        stages = _stages(
            train, fixed.scale, seed, replace(settings, augmentation=augmentation), partial(told, 3)
        )
        both = _side_by_side(_known(stages, sweeps, changed), known)
        scores = HeldOutScores([both], [InnerPart(by, out)], classes, settings.reattached)
        judged = _beside_stages(scores, judged, fixed, settings, partial(told, 3))
    trunk, plan = _pruned(fixed, stages, judged.plan)
    heads: dict[str, Array] = {}
    for name, int8 in (("head", False), ("int8", True)):
        weight, bias = plan.fit(_known(trunk, sweeps, changed, int8).given(), classes)
        heads |= {
            f"{name}.weight": weight - weight.mean(axis=0),
            f"{name}.bias": bias - bias.mean(),
        }
    about = {
        "seed": seed,
        "recipe": {
            "scene": vars(augmentation),
            "steps": settings.steps,
            "keep_means": False,
            "reattached": settings.reattached,
            "mains_hz": settings.mains_hz,
        },
        "held_out_by": by,
        "chosen": describe(trunk, plan),
        "validation": _validation(scores, judged),
    }
    made = Fit(
        {**trunk.weights, **heads},
        trunk.scale,
        trunk.architecture,
        trunk.ranges,
        train,
        held,
        about,
        plan=plan.uncooled(),
    )
    return finished(made) if settings.calibrate else made


def _tell(log: Log, parts: int, part: int, line: str) -> None:
    """Show how far a fit is: `part` of `parts`. The last of three takes nearly all of the time, and
    says how much is left; it does not come where the first two are enough."""
    log(f"part {part} of {parts}, {line}")


def fixed_trunk(sweeps: Dataset, seed: int, mains_hz: float = MAINS_HZ) -> Trunk:
    """The trunk with the whole bank, the distribution and the spectrum.

    Raises FormatError where the window is shorter than a filter, or every taxel of every sweep is
    constant.
    """
    format, rng = sweeps.format, np.random.default_rng(seed)
    some = calibration_sweeps(sweeps.samples[rng.permutation(len(sweeps))])
    if not np.ptp(sweeps.samples, axis=1).any():
        raise FormatError(
            "every taxel of every sweep is constant; check the skin, nothing can be learnt from this"
        )
    scale = texture_scale(sweeps.samples)
    architecture = replace(
        FIXED, spectrum=spectrum.count(format) > 0, pools=2, distribution=True, mains_hz=mains_hz
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


def _choose(scores: HeldOutScores, trunk: Trunk, settings: Settings, log: Log) -> ScoredPlan:
    """choice.choose for a trunk with the whole bank; the usual candidate where there is no
    choosing."""
    layout, filters = trunk.layout(), Bank.of(trunk.weights)
    *pools, levels, bands = (
        np.arange(layout[name].start, layout[name].stop) if name in layout else np.empty(0, int)
        for name in ("sizes", "shares", "levels", "bands")
    )
    kinds = [which for free in (False, True) if len(which := np.flatnonzero(filters.free == free))]
    if not settings.choose:
        return scores.score(choice.filter_groups([np.flatnonzero(~filters.free)], pools))
    chosen = choice.choose(scores, kinds, pools, levels, bands, log, settings.reattached)
    return choice.with_fewer_filters(
        scores, chosen, _filter_numbers(trunk), bank.LEAST_FILTERS, log
    )


def _beside_stages(
    scores: HeldOutScores, judged: ScoredPlan, fixed: Trunk, settings: Settings, log: Log
) -> ScoredPlan:
    """What was chosen with a discriminant of trained stages, with as few filters as then do.

    For a skin that will be reattached stages and the spectrum are enough unless held-out sweeps and
    their copies show that more is better: what corrupts sweeps moves filters more. Sweeps in place
    alone would not do as judges: they do not show what a view is good for in a condition that
    nobody recorded.
    """
    size, full = sum(STAGES.channels), scores.score(_with_stages(judged.plan))
    if not settings.choose:
        return full
    if settings.reattached:
        log("choosing: stages and the spectrum alone")
        lean = scores.score(_stages_alone(fixed.layout().get("bands", slice(0, 0))))
        if not scores.better(full, lean):
            return lean
    numbers = np.append(np.full(size, -1), _filter_numbers(fixed))
    return choice.with_fewer_filters(scores, full, numbers, bank.LEAST_FILTERS, log)


def _stages_alone(bands: slice) -> list[HeadPart]:
    """A discriminant of each stage and the spectrum, whose features `bands` come after those of
    stages; all see copies."""
    size, ends = sum(STAGES.channels), np.cumsum(STAGES.channels).tolist()
    spectrum = range(size + bands.start, size + bands.stop)
    return [
        HeadPart((*range(end - channels, end), *spectrum), True)
        for channels, end in zip(STAGES.channels, ends, strict=True)
    ]


def _filter_numbers(trunk: Trunk) -> Array:
    """Of each feature the number of the filter that gives it, -1 where none does."""
    layout = trunk.layout()
    numbers = np.full(max(part.stop for part in layout.values()), -1)
    for name in ("sizes", "shares"):
        if name in layout:
            numbers[layout[name]] = np.arange(layout[name].stop - layout[name].start)
    return numbers


def _known(
    trunk: Trunk, sweeps: Dataset, changed: Sequence[Dataset], int8: bool = True
) -> HeadData:
    features = [trunk.features(one, int8) for one in (sweeps, *changed)]
    source = np.tile(np.arange(len(sweeps)), len(changed))
    return HeadData(features[0], sweeps.labels, np.concatenate(features[1:]), source)


def _held_out(sweeps: Dataset, seed: int) -> tuple[Array, str]:
    """Which sweeps [N] stages never see, and by which group; see linear_head.hold_out_or_all."""
    numbered = replace(sweeps, groups=sweeps.groups | {"index": np.arange(len(sweeps))})
    _, held, by = hold_out_or_all(numbered, seed)
    return np.isin(np.arange(len(sweeps)), held.group("index")), by


def _side_by_side(stages: HeadData, fixed: HeadData) -> HeadData:
    """The same sweeps with the features of both, those of stages first."""
    return replace(
        fixed,
        features=np.hstack([stages.features, fixed.features]),
        copied=np.hstack([stages.copied, fixed.copied]),
    )


def _with_stages(plan: HeadPlan) -> list[HeadPart]:
    """`plan` with a discriminant of trained stages, whose features come before all others; it sees
    copies, as stages do.

    What differs so much in kind errs on other sweeps: the two together stand a condition that
    nobody recorded better than either alone, which no held-out part shows. So nothing is asked."""
    size = sum(STAGES.channels)
    fixed = [
        replace(part, columns=tuple(np.add(part.columns, size).tolist())) for part in plan.parts
    ]
    return [HeadPart(tuple(range(size)), True), *fixed]


def _stages(sweeps: Dataset, scale: float, seed: int, settings: Settings, log: Log) -> Trunk:
    """Stages trained on `sweeps`, as a trunk of their own."""
    from train.models.recipe import stages  # here: the rest of the recipe needs no PyTorch

    recipe = stages.FitRecipe(steps=settings.steps, augmentation=settings.augmentation)
    architecture = replace(STAGES, mains_hz=settings.mains_hz)
    weights, ranges = stages.train_stages(
        sweeps, scale, seed, recipe, log, architecture, settings.unfinished
    )
    return Trunk(sweeps, scale, weights, architecture, ranges)


def _pruned(fixed: Trunk, stages: Trunk | None, plan: HeadPlan) -> tuple[Trunk, HeadPlan]:
    """The trunk with only what the plan's discriminants see, and the plan for it."""
    size, layout, used = sum(STAGES.channels) if stages else 0, fixed.layout(), plan.columns()
    fixed_used = used[used >= size] - size
    filters, shares, levels, bands = (
        fixed_used[(fixed_used >= layout[name].start) & (fixed_used < layout[name].stop)]
        - layout[name].start
        if name in layout
        else np.empty(0, int)
        for name in ("sizes", "shares", "levels", "bands")
    )
    architecture = replace(
        stages.architecture if stages else fixed.architecture,
        pools=(len(filters) > 0) + (len(shares) > 0),
        distribution=len(levels) > 0,
        spectrum=len(bands) > 0,
    )
    weights = dict(stages.weights) if stages else {}
    weights |= Bank.of(fixed.weights).take(filters).weights() if architecture.pools else {}
    weights |= distribution.Levels.of(fixed.weights).weights() if architecture.distribution else {}
    ranges = replace(fixed.ranges, responses=stages.ranges.responses) if stages else fixed.ranges
    return Trunk(fixed.sweeps, fixed.scale, weights, architecture, ranges), plan.renumbered(used)


def describe(trunk: Trunk, plan: HeadPlan) -> str:
    """In words: what the trunk holds, and how many discriminants see copies."""
    filters = Bank.of(trunk.weights).free if trunk.architecture.pools else np.empty(0, bool)
    what = [
        f"{int((filters == free).sum())} {name} filters"
        for free, name in ((False, "zero-sum"), (True, "free"))
        if (filters == free).any()
    ]
    what += (
        ["magnitudes and shares" if trunk.architecture.pools > 1 else "magnitudes"]
        if len(filters)
        else []
    )
    what += ["distribution"] if trunk.architecture.distribution else []
    what += ["spectrum"] if trunk.architecture.spectrum else []
    what += (
        [f"stages of {', '.join(map(str, trunk.architecture.channels))} channels"]
        if trunk.architecture.channels
        else []
    )
    copied = sum(part.copies for part in plan.parts)
    return f"{', '.join(what)}; {len(plan.parts)} discriminants, {copied} with augmented copies"


def _validation(scores: HeldOutScores, judged: ScoredPlan) -> dict[str, Any]:
    """Accuracy on held-out parts of heads that did not see them, with its 95 % interval by part;
    copies do not count."""
    right = (judged.logits.argmax(axis=1) == scores.labels)[scores.own]
    low, high = interval(right, scores.clusters[scores.own])
    return {"accuracy": round(float(right.mean()), 4), "n": len(right), "low": low, "high": high}
