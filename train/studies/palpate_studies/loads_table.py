"""Gain and cost of the loads of taxels, in both worlds of the simulator, as the box answers."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.provenance import commit
from palpate.inference.classifier import Classifier
from palpate_train.data import sets
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.export import quantized_bundle
from palpate_train.metrics import bundle_score
from palpate_train.models.methods import SkinUse
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.recipe import Settings
from palpate_train.models.recipe.sizes import UNLIMITED
from palpate_train.onnx_tools.graph_builder import run

Json = dict[str, Any]
WORLDS = {"laboratory": "", "level-blind": "/level-blind"}
POSITIONS = (1, 4, 7)
"""Those that are left out in turn, of nine."""
SEED, ATTACHMENTS = 1, "1-36"
REATTACHED = SkinUse(reattached=True)


def rows(log: Callable[[str], None]) -> Iterator[Json]:
    """Fits of one session in closed form, with and without loads as a candidate, for sweeps after
    the skin was put back and for positions that were left out.

    label: share of sweeps that the network classifies correctly; right, wrong: of sweeps that the
    box does, in per cent. `with` is None where the fit did not choose loads.
    """
    for world, named in WORLDS.items():
        trained = sets.load(f"sim:T-REAL{named}:{SEED}")
        attached = sets.load(f"sim:T-HARD{named}:{ATTACHMENTS}:1")
        yield _row(world, "skin put back", [(trained, attached)], log)
        place = trained.group("position")
        left_out = [(trained.take(place != p), trained.take(place == p)) for p in POSITIONS]
        yield _row(world, "new position", left_out, log)


def _row(
    world: str, condition: str, parts: list[tuple[Dataset, Dataset]], log: Callable[[str], None]
) -> Json:
    shown, hidden, chosen = [], [], False
    for train, test in parts:
        log(f"loads, {world}, {condition}")
        made = _fit(train, loads=True)
        shown.append(answers(made, test))
        hidden.append(shown[-1])
        if made.architecture.loads:
            chosen, hidden[-1] = True, answers(_fit(train, loads=False), test)
    return {
        "world": world,
        "condition": condition,
        "sweeps": sum(len(test) for _, test in parts),
        "with": _mean(shown) if chosen else None,
        "without": _mean(hidden),
    }


def _fit(sweeps: Dataset, loads: bool) -> Fit:
    size = replace(UNLIMITED, loads=loads)
    return recipe.fit(sweeps, Run(SEED), Settings(size=size, use=REATTACHED))


def answers(made: Fit, test: Dataset) -> Json:
    """What the network and the box of a fit say to sweeps: bools [n] of label, right, wrong."""
    with tempfile.TemporaryDirectory() as aside:
        folder = Path(aside) / "bundle"
        quantized_bundle.export(made, folder, "loads", "1", commit(), proven=False)
        box = Classifier(bundle.load(folder), SystemClock(), slides=False)
        became = bundle_score.outcomes_of(box, test)
    network = run(quantized_bundle.graphs(made)[1], test.samples).argmax(axis=1) == test.labels
    return {"label": network, "right": became["right"], "wrong": became["wrong"]}


def _mean(parts: list[Json]) -> Json:
    return {
        name: round(100 * float(np.concatenate([part[name] for part in parts]).mean()), 1)
        for name in parts[0]
    }
