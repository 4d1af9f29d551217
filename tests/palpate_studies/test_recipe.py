"""The study `recipe`: the cost of views, the views of sets, and their table."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate_studies import recipe_views, tables
from palpate_studies.study import StudyCase, StudyRun
from palpate_train.data import sets
from palpate_train.evaluate.evaluate import Where
from palpate_train.export import measure
from palpate_train.models.recipe.architectures import Architecture
from palpate_train.models.recipe.bank import POOLS

RESULTS: dict[str, Any] = {
    "views": [
        {"view": name, "features": 10 + i, "us": 20.5 + i, "bytes": 3000 + i}
        for i, name in enumerate((*tables.VIEWS, "few relations"))
    ],
    "sets": [
        {"set": "7 fabrics", "views": ["spectrum", "stages"], "chosen": "…"},
        {"set": "tubes", "views": ["spectrum"], "chosen": "…"},
    ],
}


@pytest.mark.slow
def test_each_view_has_a_cost_of_its_own(monkeypatch: pytest.MonkeyPatch):
    """Each is timed in a graph of its features; more lags of relations are more features."""
    turns = []
    timed = measure.timed

    def once(calls: Any, sweeps: np.ndarray) -> dict[str, np.ndarray]:
        turns.append(list(calls))
        return timed(calls, sweeps, 1, 1)

    monkeypatch.setattr(measure, "timed", once)
    sweeps = sets.load("sim:T-REAL/level-blind:1001:1")
    short = replace(sweeps, samples=sweeps.samples[:12, :400], labels=sweeps.labels[:12], groups={})
    found = {view["view"]: view for view in recipe_views.costs(short)}
    assert turns == [list(found)]
    assert set(tables.VIEWS) | {"few relations"} == set(found)
    assert all(view["us"] > 0 for view in found.values())
    assert found["loads"]["features"] >= 16
    assert found["filters"]["features"] * 2 == found["shares"]["features"]
    assert found["few relations"]["features"] < found["relations"]["features"]
    assert found["loads"]["bytes"] < found["stages"]["bytes"]


@pytest.mark.slow
def test_each_set_is_fitted_once(monkeypatch: pytest.MonkeyPatch):
    """Cases of the same sweeps are one set; a set that is not there is left out with the reason."""
    tubes = StudyCase(("sim:T-REAL/level-blind:1001:2",), only=("position<=2",))
    cases = {"tubes, a": tubes, "tubes, b": tubes, "fabrics, a": StudyCase(("x",), real=True)}
    monkeypatch.setattr(recipe_views, "CASES", cases)
    run = StudyRun(Where(), lambda line: None)
    (one,) = recipe_views.choices(run)
    assert (one["set"], one["real"], one["sweeps"]) == ("tubes", False, 36)
    assert one["views"]
    assert list(run.left_out) == ["fabrics"]


def test_views_are_read_from_the_trunk_and_needed():
    """Each part of an architecture is one; the table needs the cost of each."""
    assert recipe_views.views_of(Architecture((), spectrum=True)) == ["spectrum"]
    every = Architecture((4,), 8, 2, 0, True, POOLS, True, True, 3, True)
    assert recipe_views.views_of(every) == list(tables.VIEWS)
    with pytest.raises(KeyError, match="stages"):
        tables.recipe({"views": [v for v in RESULTS["views"] if v["view"] != "stages"], "sets": []})


def test_the_table_has_a_row_for_each_view_with_its_sets():
    """Cost, condition and sets of each view; a view that no set has says so."""
    head, line, *rows = tables.recipe(RESULTS).split("\n")
    assert head.count("|") == line.count("|") == rows[0].count("|") == 7
    assert [row.split("|")[1].strip() for row in rows] == list(tables.VIEWS)
    assert "| 13, 23.5 µs, 3 KB |" in rows[3]
    assert rows[3].endswith("| all 2 |")
    assert rows[-1].endswith("| 7 fabrics |")
    assert rows[0].endswith("| no set |")
