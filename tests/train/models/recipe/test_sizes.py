"""The sizes of the recipe: what a model may contain at most."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from appliance.core.errors import FormatError
from train.data import sets
from train.data.sets import Dataset
from train.models import methods
from train.models.recipe import bank, recipe
from train.models.recipe.choice import FeatureColumns
from train.models.recipe.sizes import SIZES, UNLIMITED, ModelSize


@cache
def tubes() -> Dataset:
    """Few simulated sweeps at nine positions."""
    return sets.load("sim:T-REAL/level-blind:1:2")


@pytest.mark.parametrize("name", SIZES)
def test_a_fit_contains_at_most_its_size(name: str):
    """Its trunk has no view that the size excludes, and it names sweeps at held-out positions."""
    size = SIZES[name]
    made = recipe.fit(tubes(), 1, recipe.Settings(steps=0, size=size, calibrate=False))
    found = made.architecture
    filters = len(bank.Bank.of(made.weights).free) if found.pools else 0
    assert size.filters is None or filters <= size.filters
    assert size.scales is None or found.relations <= size.scales
    assert size.distribution or not found.distribution
    assert not found.channels
    assert made.about["validation"]["accuracy"] > 0.9


def test_filters_of_a_size_are_spread_evenly_over_each_kind():
    """Four of the zero-sum filters and four of the free ones; other features stay as they are."""
    columns = FeatureColumns(
        np.arange(20),
        np.arange(20, 40),
        (np.arange(12), np.arange(12, 20)),
        np.arange(40, 44),
        np.arange(44, 46),
        np.arange(46, 58).reshape(4, 3),
        np.arange(58, 60),
    )
    few = columns.limited(ModelSize(filters=4, scales=2, distribution=False))
    assert few.magnitudes.tolist() == [0, 3, 7, 11, 12, 14, 16, 19]
    assert few.shares.tolist() == [20, 23, 27, 31, 32, 34, 36, 39]
    assert [kind.tolist() for kind in few.kinds] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert few.relations.tolist() == [[46, 47, 48], [49, 50, 51]]
    assert (len(few.levels), few.loads.tolist(), few.bands.tolist()) == (0, [44, 45], [58, 59])
    assert few.filters()[few.magnitudes].tolist() == list(range(8))
    every = columns.limited(UNLIMITED)
    assert all(
        np.array_equal(getattr(every, name), getattr(columns, name))
        for name in ("magnitudes", "shares", "levels", "loads", "relations", "bands")
    )


def test_a_size_without_filters_needs_windows_with_a_spectrum():
    """The error says what to do; a size with filters can be fitted."""
    short = replace(tubes(), samples=tubes().samples[:, 700:730])
    settings = recipe.Settings(steps=0, calibrate=False)
    with pytest.raises(FormatError, match="windows of 30 frames are too short for a spectrum"):
        recipe.fit(short, 1, replace(settings, size=SIZES["bands"]))
    assert recipe.fit(short, 1, replace(settings, size=SIZES["64"])).architecture.pools


def test_each_size_is_a_method():
    """They are the points of one family."""
    assert {f"palpate-{name}" for name in SIZES} <= methods.every().keys()
