"""The sizes of the recipe limit the content of a model."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data import sets
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.models import methods
from palpate_train.models.methods import Effort
from palpate_train.models.recipe import bank, palpate, recipe
from palpate_train.models.recipe.choice import FeatureColumns
from palpate_train.models.recipe.fitted import Fit
from palpate_train.models.recipe.sizes import SIZES, UNLIMITED, ModelSize
from palpate_train.onnx_tools.graph_builder import run, with_head
from tests.factories.sweep_sets import easy


@cache
def tubes() -> Dataset:
    """Few simulated sweeps at nine positions."""
    return sets.load("sim:T-REAL/level-blind:1:2")


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZES)
def test_a_fit_contains_at_most_its_size(name: str):
    """Its trunk has no view that the size excludes, and it names sweeps at held-out positions."""
    size = SIZES[name]
    made = recipe.fit(tubes(), Run(1), recipe.Settings(size=size, calibrate=False))
    found = made.architecture
    filters = len(bank.Bank.of(made.weights).free) if found.pools else 0
    assert size.filters is None or filters <= size.filters
    assert size.scales is None or found.relations <= size.scales
    assert size.distribution or not found.distribution
    assert size.slow or not found.slow
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
        np.arange(60, 63),
        np.arange(58, 60),
    )
    few = columns.limited(ModelSize(filters=4, scales=2, distribution=False, slow=False))
    assert few.magnitudes.tolist() == [0, 3, 7, 11, 12, 14, 16, 19]
    assert few.shares.tolist() == [20, 23, 27, 31, 32, 34, 36, 39]
    assert [kind.tolist() for kind in few.kinds] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert few.relations.tolist() == [[46, 47, 48], [49, 50, 51]]
    assert not len(few.slow)
    assert (len(few.levels), few.loads.tolist(), few.bands.tolist()) == (0, [44, 45], [58, 59])
    assert few.filters()[few.magnitudes].tolist() == list(range(8))
    every = columns.limited(UNLIMITED)
    assert all(
        np.array_equal(getattr(every, name), getattr(columns, name))
        for name in ("magnitudes", "shares", "levels", "loads", "relations", "slow", "bands")
    )


@pytest.mark.slow
def test_a_size_without_filters_needs_windows_with_a_spectrum():
    """The error says what to do; a size with filters can be fitted."""
    short = replace(tubes(), samples=tubes().samples[:, 700:730])
    settings = recipe.Settings(calibrate=False)
    with pytest.raises(FormatError, match="30 frames"):
        recipe.fit(short, Run(1), replace(settings, size=SIZES["bands"]))
    assert recipe.fit(short, Run(1), replace(settings, size=SIZES["64"])).architecture.pools


def test_each_size_is_a_method():
    """Points of one family; the effort shortens the training of stages."""
    made = {m.name: m.effort for m in palpate.methods(Effort(share=0.01))}
    assert {f"palpate-{name}" for name in SIZES} < made.keys() < methods.every().keys()
    steps = "6 iterations of stages"
    assert {name for name, effort in made.items() if effort == steps} == {"palpate-stages"}
    assert set(made.values()) == {steps, ""}


@pytest.mark.slow
def test_a_fit_of_the_spectrum_alone_survives_its_file(tmp_path: Path):
    """Nothing in its graph is int8, both precisions agree, an easy set is learned."""
    made = recipe.fit(easy(), Run(1), recipe.Settings(size=SIZES["bands"]))
    assert (made.architecture, made.bands) == (replace(recipe.FIXED, spectrum=True), 5)
    assert sorted(made.weights) == ["head.bias", "head.weight", "int8.bias", "int8.weight"]
    made.save(tmp_path / "fit.npz")
    again = Fit.load(tmp_path / "fit.npz")
    assert (again.architecture, again.ranges, again.bands) == (made.architecture, made.ranges, 5)
    for prefixes in (False, True):
        assert again.trunk(prefixes=prefixes) == made.trunk(prefixes=prefixes)
        assert again.trunk(int8=False, prefixes=prefixes) == again.trunk(prefixes=prefixes)
    model = with_head(again.trunk(), *again.int8_head())
    done = {n.op_type for n in model.graph.node}
    assert not {"Conv", "QuantizeLinear", "DequantizeLinear", "MatMulInteger"} & done
    other = easy(seed=9)
    assert np.mean(run(model, other.samples).argmax(1) == other.labels) > 0.9
