"""Figures of a report on a bundle that need trainings: the learning curve, and whether a material
that was left out of training is noticed.

The trainings use the bundle's method with its usual settings. Finished trainings are kept, as by
`evaluate`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate.core.statistics import DRAWS
from palpate_train.data import sets
from palpate_train.data.progress import Progress
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import evaluate, uncertainty
from palpate_train.evaluate.evaluate import Plan, Result, Where
from palpate_train.evaluate.fold import Fold
from palpate_train.evaluate.uncertainty import Case
from palpate_train.models import methods
from palpate_train.models.methods import SHIPPED, Effort
from palpate_train.models.recipe.fitted import Fit

Json = dict[str, Any]
Log = Callable[[str], None]
SIZES = (2, 4, 8, 16, 32, 64, 128, 256)
"""Sweeps of each material at the points of a learning curve; points beyond the available sweeps are
left out."""
SPLIT = "split:set=0->1"
"""Trains on the first of two joined sets and tests on the second."""


def run(
    made: Mapping[str, Any],
    train: Dataset,
    test: Dataset,
    where: Where,
    log: Log,
    effort: Effort = methods.FULL_EFFORT,
) -> Json:
    """`trained`: the trained method. `curve`: points of the learning curve. `doubled`: what twice
    as many sweeps would bring, see `doubled`. `left_out`: figures for each material left out of
    training. `why_not`: the reason if there are no such figures. made: from the bundle's manifest.
    Raises FormatError if the sets do not fit together."""
    method = made.get("method", SHIPPED if "chosen" in made else "")
    if not method:
        return {"why_not": "the bundle was fitted with settings of its own, which no method has"}
    test = aligned(test, train)
    figures: Json = {
        "trained": {
            "method": method,
            "set": train.source,
            "sweeps": len(train),
            "effort": effort.share,
        }
    }
    whole: Case | None = None
    if len(train.materials) > 2:
        try:
            whole = uncertainty.trained(train, test, method, where, log, effort)
            figures["left_out"] = uncertainty.left_out(whole, train.materials)
        except FormatError as e:  # a method that knows no novelty
            figures["why_not"] = str(e)
    figures["curve"] = curve(method, train, test, where, log, effort, whole)
    if len(figures["curve"]) > 2:
        figures["doubled"] = doubled(figures["curve"])
    return figures


def whole(fit: Fit) -> Dataset:
    """All sweeps of a fit: the training sweeps, then the held-out ones."""
    parts = (fit.train, fit.held)
    groups = {
        name: np.concatenate([part.groups[name] for part in parts]) for name in fit.train.groups
    }
    samples, labels = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("samples", "labels")
    )
    return replace(fit.train, samples=samples, labels=labels, groups=groups, unloaded=None)


def curve(
    method: str,
    train: Dataset,
    test: Dataset,
    where: Where,
    log: Log,
    effort: Effort,
    whole: Case | None = None,
) -> list[Json]:
    """Accuracy on `test` after training on some sweeps of each material: `each`, `share`, `low`,
    `high`, `n`. The last point is of all sweeps of `train`, by the training `whole` if there is
    one, and its `each` is the mean."""
    both = sets.join([train, test])
    counts = np.bincount(train.labels, minlength=len(train.materials))
    points = []
    sizes = [*(size for size in SIZES if size < counts.min()), 0]
    progress = Progress(len(sizes), log)
    for each in sizes:
        progress.begin(f"learning curve, {each or round(counts.mean())} sweeps of each material")
        plan = Plan((method,), (SPLIT,), (uncertainty.SEED,), effort=effort, each=each)
        results: Iterable[Result] = evaluate.evaluate(both, plan, where, log)
        if whole and not each:
            fold = Fold(len(train) + np.arange(len(test)), whole.logits, 0.0, 0.0, 0.0)
            results = [Result(method, SPLIT, False, uncertainty.SEED, both, [fold], {})]
        for result in results:
            if result.refused:
                continue  # too few sweeps for it; with more there is a point
            found = result.json()
            points.append(
                {
                    "each": each or float(counts.mean()),
                    "share": found["window"]["right"] / found["window"]["total"],
                    "low": found["interval"][0],
                    "high": found["interval"][1],
                    "n": found["window"]["total"],
                }
            )
    return points


def doubled(points: Sequence[Json]) -> list[float]:
    """The gain of accuracy by twice as many sweeps as at the last point of a learning curve, at
    least three points, and its 95 % interval.

    The error falls as a power of the number of sweeps (Hestness et al. 2017). The power is that of
    a line through the logarithms, and the interval is of curves that are drawn anew (parametric
    bootstrap).
    """
    each = np.log2([p["each"] for p in points])
    n = np.array([p["n"] for p in points])
    right = np.array([p["share"] for p in points])
    drawn = np.random.default_rng(0).binomial(n, right, (DRAWS, len(n))) / n
    errors = 1 - np.concatenate([right[None], drawn])
    logs = np.log2(np.maximum(errors, 0.5 / n))
    away = each - each.mean()
    power = np.minimum(logs @ away / (away @ away), 0)
    gains = errors[:, -1] * (1 - 2**power)
    return [round(float(x), 4) for x in (gains[0], *np.quantile(gains[1:], [0.025, 0.975]))]


def aligned(test: Dataset, train: Dataset) -> Dataset:
    """The sweeps of `test` with a material of `train`, with the materials in the order of `train`.

    Raises FormatError if the formats differ.
    """
    if test.format != train.format:
        raise FormatError(
            f"{train.source} is of {train.format}, {test.source} of {test.format}; name "
            "sets of one form"
        )
    numbers = np.array(
        [train.materials.index(name) if name in train.materials else -1 for name in test.materials]
    )
    known = test.take(numbers[test.labels] >= 0)
    return replace(known, labels=numbers[known.labels], materials=train.materials)
