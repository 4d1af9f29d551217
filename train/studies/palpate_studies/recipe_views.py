"""The study `recipe`: the cost of each view of the recipe, and the views that sets ask for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from palpate.core.sweep_set import Array
from palpate.inference.session import session
from palpate_studies.development_experiment import CASES
from palpate_studies.study import NO_DATA, StudyRun
from palpate_train.data import sets
from palpate_train.data.augment import default_augmentation
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.export import measure
from palpate_train.metrics import score
from palpate_train.models.recipe import graph, recipe, relations
from palpate_train.models.recipe.architectures import STAGES, Architecture
from palpate_train.models.recipe.bank import POOLS, Bank
from palpate_train.models.recipe.recipe import FIXED, Settings
from palpate_train.models.recipe.trunk import Trunk
from palpate_train.onnx_tools.graph_builder import slim, with_head

Json = dict[str, Any]
TIMED = "sim:T-REAL/level-blind:1001:2"
"""The format in which views are timed: that of the skin of the paper."""
SEED = 1
FILTERS = 256
"""Number of filters whose cost is measured."""


def results(run: StudyRun) -> Json:
    """`views` with their cost, and `sets` with the views that the recipe chose there."""
    sweeps = sets.load(TIMED)
    return {
        "format": str(sweeps.format),
        "views": list(costs(sweeps)),
        "sets": list(choices(run)),
        "left_out": run.left_out,
        "seeds": [SEED],
    } | score.provenance()


def costs(sweeps: Dataset) -> Iterator[Json]:
    """The time of a sweep in a graph with one view alone, all in turns, its bytes and its features.

    The graph prepares the counts as the whole model does, and it ends with a head.
    """
    trunks, k = alone(sweeps), len(sweeps.materials)
    models = {}
    for name, trunk in trunks.items():
        features = graph.trunk_graph(
            sweeps.format, trunk.scale, trunk.weights, trunk.architecture, trunk.ranges
        )
        size = max(part.stop for part in trunk.layout().values())
        models[name] = size, slim(with_head(features, np.zeros((k, size)), np.zeros(k)))
    calls = {name: _call(model.SerializeToString()) for name, (_, model) in models.items()}
    took = measure.timed(calls, sweeps.samples)
    for name, (size, model) in models.items():
        yield {
            "view": name,
            "features": size,
            "us": round(1e3 * float(np.median(took[name])), 1),
            "bytes": len(model.SerializeToString()),
        }


def _call(model: bytes) -> Callable[[Array], Any]:
    runner = session(model)
    return lambda counts: runner.run(None, {"sweep": counts[None]})


def alone(sweeps: Dataset) -> Mapping[str, Trunk]:
    """A trunk for each view alone."""
    every = recipe.fixed_trunk(sweeps, SEED)
    bank = Bank.of(every.weights)
    spread = np.linspace(0, len(bank) - 1, FILTERS).astype(int)
    filters = dict(every.weights) | bank.take(spread).weights()
    plain = replace(FIXED, mains_hz=every.architecture.mains_hz)
    views = {
        "filters": replace(plain, pools=("magnitudes",)),
        "shares": replace(plain, pools=POOLS),
        "distribution": replace(plain, distribution=True),
        "spectrum": replace(plain, spectrum=True),
        "few relations": replace(plain, relations=relations.SHORT),
        "relations": replace(plain, relations=every.architecture.relations),
        "loads": replace(plain, loads=True),
        "slow waves": replace(plain, slow=True),
    }
    trunks = {
        name: replace(every, weights=filters, architecture=architecture)
        for name, architecture in views.items()
    }
    return trunks | {"stages": _stages(sweeps, every)}


def _stages(sweeps: Dataset, every: Trunk) -> Trunk:
    """Stages that are hardly trained, which costs a sweep the same time."""
    augmentation = default_augmentation(FIXED.zero_sum(sweeps.format.window))
    from palpate_train.models.recipe import stages  # only here: PyTorch

    weights, ranges = stages.train_stages(sweeps, every.scale, Run(SEED), 2, augmentation, STAGES)
    return Trunk(sweeps, every.scale, weights, STAGES, ranges)


def choices(run: StudyRun) -> Iterator[Json]:
    """The views of the recipe's fit to each development set, all sweeps of it."""
    seen: set[str] = set()
    for name, case in CASES.items():
        title = name.partition(",")[0]
        if title in seen:
            continue
        seen.add(title)
        sweeps = case.load(run.data)
        if sweeps is None:
            run.left_out[title] = NO_DATA
            continue
        sweeps = sweeps.without_means() if case.means_removed else sweeps
        run.log(f"views of {title}")
        made = recipe.fit(sweeps, Run(SEED), Settings(calibrate=False))
        yield {
            "set": title,
            "real": case.real,
            "sweeps": len(sweeps),
            "views": views_of(made.architecture),
            "chosen": made.about["chosen"],
        }


def views_of(architecture: Architecture) -> list[str]:
    """The names of the views that a trunk has."""
    there = {
        "filters": "magnitudes" in architecture.pools,
        "shares": "shares" in architecture.pools,
        "distribution": architecture.distribution,
        "spectrum": architecture.spectrum,
        "relations": architecture.relations > 0,
        "loads": architecture.loads,
        "slow waves": architecture.slow,
        "stages": len(architecture.channels) > 0,
    }
    return [name for name, has in there.items() if has]
