"""The studies on real fabrics, one condition left out at a time. `fabrics`: many methods, with and
without each taxel's mean; `shots`: few sweeps of each material."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from palpate.core.errors import FormatError
from palpate_studies.study import NO_DATA, StudyCase, StudyRun
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import evaluate
from palpate_train.evaluate.evaluate import Plan
from palpate_train.metrics.score import interval, provenance, score_entry
from palpate_train.models.methods import SHIPPED
from palpate_train.onnx_tools import parity

Json = dict[str, Any]
FABRICS = "fabricslide/fabricslide.npz"
SEVEN = ("direction=0", "force<=180")
FOUR = ("material=BeigeCotton,BrownCotton,Canvas,Linen",)
PROTOCOLS = (
    (SEVEN, ("leave:force", "leave:speed", "leave:rep")),
    (FOUR, ("leave:force", "leave:speed", "leave:direction")),
)
"""The two selections of the set that have all combinations of their conditions, and the protocols
of each."""
SEED = 1
EACH = (3, 5, 10, 20)
"""Training sweeps of each material in the study `shots`."""
SHOT_PEERS, SHOT_PROTOCOL = ("minirocket", "ds-cnn"), "leave:force"


def results(names: Sequence[str], how: StudyRun) -> list[Json]:
    """The results of `names`, in the order of the page.

    Methods that cannot use these sweeps are in how.left_out. Raises FormatError where the real
    sweeps are missing.
    """
    found: list[Json] = []
    for only, protocols in PROTOCOLS:
        sweeps = _load(only, how)
        for removed in (True, False):
            plan = Plan(names, protocols, (SEED,), removed, how.effort)
            for result in evaluate.evaluate(sweeps, plan, how.where, how.log):
                if result.refused:
                    how.left_out[result.method] = result.refused
                else:
                    found.append(result.json() | {"only": list(only)})
    return sorted(found, key=_place)


def shots(how: StudyRun) -> Json:
    """Ours and SHOT_PEERS trained on few sweeps of each material, which each seed draws; without
    means. Raises FormatError as `results` does, and if a method is refused."""
    sets = {only: _load(only, how) for only, _ in PROTOCOLS}
    rows = [_shots_of(sweeps, each, how, only) for each in EACH for only, sweeps in sets.items()]
    about = {"sets": [FABRICS], "format": str(sets[SEVEN].format), "seeds": list(how.seeds)}
    return about | {"rows": rows} | provenance()


def _shots_of(sweeps: Dataset, each: int, how: StudyRun, only: Sequence[str]) -> Json:
    """Accuracy of each method over all seeds, and by how much ours is ahead of each peer on the
    same sweeps."""
    names = (SHIPPED, *SHOT_PEERS)
    plan = Plan(names, (SHOT_PROTOCOL,), how.seeds, True, how.effort, each)
    found = {}
    for one in evaluate.evaluate(sweeps, plan, how.where, how.log):
        if one.refused:
            raise FormatError(f"{one.method}, {each} sweeps each: {one.refused}")
        found[one.method, one.seed] = sweeps.labels[one.test] == one.logits.argmax(1)
        clusters = sweeps.group(SHOT_PROTOCOL.removeprefix("leave:"))[one.test]
    if len(found) < len(names) * len(how.seeds):
        raise FormatError(f"with {each} sweeps of a material folds are missing; leave out --kept")
    clusters = np.tile(clusters, len(how.seeds))
    right = {name: np.concatenate([found[name, seed] for seed in how.seeds]) for name in names}
    scores = {
        name: score_entry(of) | {"interval": interval(of, clusters)} for name, of in right.items()
    }
    gaps = {name: parity.loss(right[SHIPPED], right[name], clusters) for name in SHOT_PEERS}
    ahead = {
        name: [round(x, 4) for x in (gap.lost, gap.low, gap.high)] for name, gap in gaps.items()
    }
    about = {"only": list(only), "protocol": SHOT_PROTOCOL, "means_removed": True, "each": each}
    return about | {"materials": list(sweeps.materials), "methods": scores, "ahead": ahead}


def _load(only: tuple[str, ...], how: StudyRun) -> Dataset:
    sweeps = StudyCase((FABRICS,), only=only, real=True).load(how.data)
    if sweeps is None:
        raise FormatError(f"fabrics are {NO_DATA}")
    return sweeps


def _place(result: Json) -> tuple[bool, int, int]:
    """The rank of a result's test, in the order of the page."""
    part = [list(only) for only, _ in PROTOCOLS].index(result["only"])
    return not result["means_removed"], part, PROTOCOLS[part][1].index(result["protocol"])
