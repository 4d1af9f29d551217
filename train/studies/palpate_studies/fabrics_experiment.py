"""The study `fabrics`: methods on real fabrics, one condition left out at a time, with and without
each taxel's mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from palpate.core.errors import FormatError
from palpate_studies.study import NO_DATA, StudyCase, StudyRun
from palpate_train.evaluate import evaluate
from palpate_train.evaluate.evaluate import Plan

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


def results(names: Sequence[str], how: StudyRun) -> list[Json]:
    """The results of `names`, in the order of the page.

    Methods that cannot use these sweeps are in how.left_out. Raises FormatError where the real
    sweeps are missing.
    """
    found: list[Json] = []
    for only, protocols in PROTOCOLS:
        sweeps = StudyCase((FABRICS,), only=only, real=True).load(how.data)
        if sweeps is None:
            raise FormatError(f"fabrics are {NO_DATA}")
        for removed in (True, False):
            plan = Plan(names, protocols, (SEED,), removed, how.effort)
            for result in evaluate.evaluate(sweeps, plan, how.where, how.log):
                if result.refused:
                    how.left_out[result.method] = result.refused
                else:
                    found.append(result.json() | {"only": list(only)})
    return sorted(found, key=_place)


def _place(result: Json) -> tuple[bool, int, int]:
    """The rank of a result's test, in the order of the page."""
    part = [list(only) for only, _ in PROTOCOLS].index(result["only"])
    return not result["means_removed"], part, PROTOCOLS[part][1].index(result["protocol"])
