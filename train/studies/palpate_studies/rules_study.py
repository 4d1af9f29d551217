"""The study `rules`: what each rule of the answer buys and costs, left out alone and in pairs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from palpate.bundle.contents import Bundle
from palpate.core.clock import SystemClock
from palpate.inference.classifier import Classifier
from palpate_train.answer import rules
from palpate_train.data.sets import Dataset
from palpate_train.export import trial
from palpate_train.metrics import bundle_score
from palpate_train.metrics.score import provenance

Json = dict[str, Any]
PAIRS = (
    ("vibration", "slide"),
    ("displacement", "disturbance"),
    ("hum", "disturbance"),
    ("unknown", "slide"),
)
"""Rules that refuse or mend some of the same sweeps."""
TURNS = 9
"""Number of times that each bundle answers the slides while its processor time is taken."""


def results(
    bundle: Bundle, tested: Dataset, moved: Dataset, each: int, log: Callable[[str], None]
) -> Json:
    """The answers with all rules, and without each; see `rows`. moved: slides at other places;
    each counts as displaced."""
    given = list(trial.sweeps_for(tested, bundle, 1, each))
    given.append(trial.Given(moved, trial.DISPLACED))
    return {
        "bundle": bundle.id,
        "sets": [tested.source, moved.source],
        "seeds": [1],
        "rows": list(rows(bundle, given, log)),
    } | provenance()


def rows(bundle: Bundle, given: list[trial.Given], log: Callable[[str], None]) -> Iterator[Json]:
    """For each rule that is left out, and each of PAIRS: `total`, `right` and `wrong` answers by
    kind of sweep, and processor time of an answer in milliseconds."""
    there = rules.present(bundle)
    alone: list[tuple[str, ...]] = [(), *((name,) for name in there)]
    every = alone + [pair for pair in PAIRS if set(pair) <= set(there)]
    less = {names: rules.without(bundle, names) for names in every}
    log("time")
    took = _took(list(less.values()), given[0].sweeps)
    total = dict.fromkeys((trial.SLIDES, trial.ALTERED, trial.DISPLACED, trial.NONE), 0)
    for one in given:
        total[one.kind] += len(one.sweeps)
    for names, ms in zip(every, took, strict=True):
        log(f"without {' and '.join(names)}" if names else "every rule")
        found = trial.counted(less[names], given)
        counts = {kind: found.get(kind, trial.Counts()) for kind in total}
        yield {
            "without": list(names),
            "total": total,
            "right": {kind: of.right for kind, of in counts.items()},
            "wrong": {kind: of.wrong for kind, of in counts.items()},
            "ms": ms,
        }


def _took(bundles: list[Bundle], sweeps: Dataset) -> list[float]:
    """Processor time of an answer of each bundle, in milliseconds: the median of TURNS, which the
    bundles take in turns after a first answer that does not count."""
    boxes = [Classifier(bundle, SystemClock(), slides=False) for bundle in bundles]
    took = np.empty((TURNS + 1, len(boxes)))
    for turn in took:
        for i, box in enumerate(boxes):
            begun = time.process_time()
            for _ in bundle_score.verdicts(box, sweeps):
                pass
            turn[i] = 1e3 * (time.process_time() - begun) / len(sweeps)
    return [round(float(ms), 3) for ms in np.median(took[1:], axis=0)]
