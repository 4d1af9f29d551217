"""Limits of known materials by the cost of two mistakes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.answer.unknown import Known
from palpate.core.errors import BundleError, FormatError
from palpate.sweeps.sweep_folder import NOT_THIS
from palpate_train.answer import stranger_limits
from palpate_train.answer.stranger_limits import COSTS, LeftOut, limits, nearest_other

MATERIALS = 4


def left_out(
    n: int = 60, seed: int = 0, apart: float = 2.0, inflated: float = 0.0, parts: int = 5
) -> LeftOut:
    """Known and unknown sweeps whose logarithms lie `apart`, `inflated` against the model."""
    rng = np.random.default_rng(seed)
    labels, values = np.arange(n) % MATERIALS, np.arange(n) // MATERIALS % parts
    known, strangers = rng.normal(0.0, 0.5, (2, n))
    strangers += apart
    logs = known + inflated, strangers + inflated, strangers, known - 3
    return LeftOut(*map(np.exp, logs), labels, values, parts)


@given(st.floats(0.01, 100), st.floats(1.01, 10), st.integers(0, 5))
@settings(max_examples=30, deadline=None)
def test_a_dearer_stranger_never_widens_a_limit(cost: float, times: float, seed: int):
    """Each limit falls as the cost of a stranger rises, and the three are in order."""
    sweeps = {"force": left_out(seed=seed, apart=1.0)}
    cheap, dear = limits(sweeps, cost), limits(sweeps, cost * times)
    for name in COSTS:
        assert getattr(dear, name) <= getattr(cheap, name)
    assert cheap.strict <= cheap.balanced <= cheap.loose


def test_both_mistakes_are_rare_and_all_conditions_count():
    """Nearly all known sweeps, few others; a second condition far away widens the limit."""
    figures = limits({"force": left_out(400)}).figures
    assert figures["balanced"]["answered"][0] > 0.93
    assert figures["balanced"]["named"][0] < 0.07
    assert not figures["guess"]
    near, far = left_out(), left_out(inflated=1.0, parts=20)
    assert limits({"a": near, "b": far}).balanced > limits({"a": near}).balanced


@given(st.integers(2, 40), st.integers(0, 3))
@settings(max_examples=20, deadline=None)
def test_few_sweeps_promise_no_more_than_they_show(each: int, seed: int):
    """Beyond the farthest of n known sweeps there is a share that shrinks with n, but is not 0."""
    sweeps = left_out(each * MATERIALS, seed, parts=2)
    logs = sweeps.corrected()[0]
    by_material = [logs[sweeps.labels == k] for k in range(MATERIALS)]
    kept = stranger_limits._share_below(np.array([logs.max()]), by_material)[0]
    assert 0.5 < kept < 1


@pytest.mark.parametrize("parts", [2, 3, 10])
def test_a_cross_fit_is_corrected_for_what_it_lacks(parts: int):
    """By all of the inflation with two parts, else by less."""
    inflated, plain = left_out(inflated=1.5, parts=parts), left_out(parts=parts)
    known = [one.corrected()[0] for one in (inflated, plain)]
    np.testing.assert_allclose(known[0] - known[1], 1.5 - 1.5 / (parts - 1), atol=1e-9)


@pytest.mark.parametrize(
    ("n", "materials", "least", "most"),
    [(160, 4, 0.65, 0.8), (400, 4, 0.45, 0.6), (120, 3, 0.85, 0.95), (400, 2, 0.85, 0.95)],
)
def test_known_sweeps_are_kept_at_any_cost(n: int, materials: int, least: float, most: float):
    """Half at a million times the cost, more of few sweeps, most of few materials; nearly all where
    no material was left out."""
    sweeps = left_out(n, apart=-3.0)
    judged = replace(sweeps, labels=np.arange(n) % materials)
    figures = limits({"force": judged}, 1e6).figures
    assert least <= figures["balanced"]["answered"][0] <= most
    assert figures["strict"]["answered"][0] >= 0.45
    sweeps = left_out()
    none = np.full_like(sweeps.known, np.nan)
    found = limits({"force": replace(sweeps, strangers=none, finished=none)})
    assert found.strict == found.loose >= np.quantile(sweeps.known, 0.97)
    assert "named" not in found.figures["balanced"]


def test_neither_a_cross_fit_nor_junk_closes_the_box():
    """The limit holds nearly all sweeps of training, and most where junk is nearer."""
    inflated = left_out(inflated=2.0, parts=2)
    far = replace(inflated, learned=inflated.known * 0.8)
    assert np.mean(far.learned <= limits({"force": far}).loose) > 0.98
    assert np.mean(far.learned <= limits({"force": inflated}).loose) < 0.5
    assert (far.corrected()[0] >= np.log(far.learned)).all()
    junk = {"mixed": np.full(60, np.exp(-4.0))}
    found = limits({"force": left_out(160)}, 1e6, junk)
    assert 0.8 <= found.figures["balanced"]["answered"][0] <= 0.95


@pytest.mark.parametrize("cost", [0.0, -1.0, np.nan, np.inf])
def test_no_cost_is_refused(cost: float):
    """A cost is a number above 0."""
    with pytest.raises(FormatError, match="cost"):
        limits({"force": left_out()}, cost)


@pytest.mark.parametrize("sweeps", [{}, {"force": np.nan}])
def test_no_known_sweep_is_refused(sweeps: dict[str, float]):
    """Without a known sweep there is no limit."""
    none = {name: np.full(8, value) for name, value in sweeps.items()}
    given = {k: LeftOut(v, v, v, v, np.zeros(8, int), np.zeros(8, int), 2) for k, v in none.items()}
    with pytest.raises(FormatError, match="no known sweep"):
        limits(given)


def test_distances_of_zero_and_the_nearest_other_mean():
    """One sweep or sweeps at their mean are finite; the own mean does not count."""
    one = np.zeros(1)
    found = limits({"force": LeftOut(one, one, one, one, one.astype(int), one.astype(int), 2)})
    assert 0 < found.strict <= found.loose < np.inf
    means = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 5.0]])
    found = nearest_other(means + 0.0, np.arange(3), means, lambda k: np.stack([np.eye(2)] * 2))
    assert found.tolist() == [9.0, 9.0, 25.0]
    assert np.isnan(nearest_other(means, np.zeros(3, int), means[:1], lambda k: means[:0])).all()


def test_the_user_reads_both_shares():
    """A line for known sweeps with the condition, a line for the others, each with its number of
    sweeps, which count once for all conditions; how much one material differs from another; a guess
    is called one."""
    guess = left_out()
    few = replace(guess, labels=guess.labels % 2)
    for sweeps, guessed in ((guess, False), (few, True)):
        found = {stranger_limits.FIGURES: limits({"force": sweeps}).figures}
        known, strangers = stranger_limits.lines(found)
        assert f"of {np.isfinite(sweeps.known).sum()} known" in known
        assert "new force" in known
        assert f"of {np.isfinite(sweeps.strangers).sum()} sweeps" in strangers
        assert ("guess" in strangers) == guessed
    near = replace(guess, strangers=np.where(guess.labels == 1, 1e-3, guess.strangers))
    figures = limits({"force": near, "speed": near}).figures
    least, most = figures["balanced"]["of one"]
    assert least < figures["balanced"]["named"][0] < most == 1
    assert figures["known"] == figures["strangers"] == len(guess.labels)
    told = stranger_limits.lines({stranger_limits.FIGURES: figures})[1]
    assert f", of one material {100 * least:.0f} to 100 %" in told
    assert stranger_limits.lines({}) == []


def test_limits_that_fall_are_refused():
    """A manifest whose strict limit is the widest is refused."""
    with pytest.raises(BundleError, match="limits"):
        Known(3.0, 2.0, 4.0, 1.0)


@pytest.mark.parametrize("name", ["strict", "balanced"])
@pytest.mark.parametrize("kind", ["rests", NOT_THIS])
def test_other_things_between_known_and_unknown_materials_narrow_a_limit(name: str, kind: str):
    """Where no unknown material is near, junk or sweeps of something else decide; known sweeps stay
    within. Only the latter are told, by their number."""
    sweeps, rng = {"force": left_out(400, apart=12.0)}, np.random.default_rng(1)
    alone = limits(sweeps)
    beside = limits(sweeps, junk={kind: np.exp(rng.normal(1.2, 0.2, 60))})
    assert getattr(beside, name) < getattr(alone, name)
    assert beside.figures[name]["answered"][0] > 0.8
    told = stranger_limits.lines({stranger_limits.FIGURES: beside.figures}, name)
    assert any("60" in line for line in told) == (kind == NOT_THIS)


def test_each_condition_has_a_curve_with_three_points():
    """Both shares rise along it; a condition that scatters more lets fewer known sweeps pass. A
    single one has them too."""
    assert limits({"force": left_out()}).figures["by condition"].keys() == {"force"}
    found = limits({"force": left_out(400), "speed": left_out(400, inflated=1.0, parts=20)})
    by_condition = found.figures["by condition"]
    assert by_condition.keys() == {"force", "speed"}
    for of in by_condition.values():
        curve, points = np.array(of["curve"]), np.array([of[name][0] for name in COSTS])
        assert (np.diff(curve, axis=0) >= 0).all()
        assert (np.diff(points, axis=0) >= 0).all()
    assert by_condition["speed"]["balanced"][0][0] < by_condition["force"]["balanced"][0][0]
