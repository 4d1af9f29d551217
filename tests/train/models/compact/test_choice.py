"""Heads that add discriminants, and the choice among candidates by held-out parts."""

from __future__ import annotations

import numpy as np
import pytest

from appliance.inference.classifier import softmax
from train.data.splitters import InnerPart
from train.models import discriminant
from train.models.compact import choice
from train.models.compact.choice import Court
from train.models.compact.heads import HeadData, HeadPart, HeadPlan

GOOD, NOISE, TRAP = (0, 1), (2, 3), (4,)
"""Features: that name the material everywhere; that say nothing; that name it in one group and lie in the others."""


POOLS, NONE = (np.arange(5),), np.arange(0)


def known(n: int = 240, seed: int = 0) -> tuple[HeadData, list[InnerPart]]:
    """Sweeps of three materials in three groups of equal size, with one copy of each, and a part for each group."""
    rng = np.random.default_rng(seed)
    labels, group = np.arange(n) % 3, np.arange(n) // (n // 3)
    angle = 2 * np.pi * labels / 3
    x = rng.standard_normal((n, 5))
    x[:, GOOD] += 2.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x[:, TRAP] = ((labels + group) % 3)[:, None] + 0.01 * x[:, TRAP]
    copied = x + 0.1 * rng.standard_normal(x.shape)
    given = HeadData(x.astype(np.float32), labels, copied.astype(np.float32), np.arange(n))
    return given, [InnerPart("place", group == value) for value in range(3)]


def court() -> Court:
    """Of `known`."""
    given, parts = known()
    return Court([given] * 3, parts, 3)


def test_a_plan_is_the_sum_of_its_discriminants():
    """As one matrix over all features, each with its factor; copies are seen where they are asked for."""
    given, _ = known()
    plan = HeadPlan((HeadPart(GOOD, False, 2.0), HeadPart((1, 2), True, 0.5)))
    weight, bias = plan.fit(given.given(), 3)
    apart = discriminant.fit(given.features[:, GOOD], given.labels, 3)
    x, y, copied, of = given.given()
    with_copies = discriminant.fit(np.concatenate([x, copied])[:, 1:3], np.append(y, of), 3)
    want = 2 * (given.features[:, GOOD] @ apart[0].T + apart[1])
    want += 0.5 * (given.features[:, 1:3] @ with_copies[0].T + with_copies[1])
    np.testing.assert_allclose(given.features @ weight.T + bias, want, rtol=1e-4, atol=1e-3)
    assert plan.columns().tolist() == [0, 1, 2]
    kept = np.array([0, 1, 2, 4])
    less = HeadData(given.features[:, kept], given.labels, given.copied[:, kept], given.source)
    np.testing.assert_array_equal(plan.renumbered(kept).fit(less.given(), 3)[0][:, :3], weight[:, :3])
    cooler = plan.cooled(4.0).fit(given.given(), 3)
    np.testing.assert_allclose(cooler[0] * 4, weight, rtol=1e-5)
    assert HeadPlan.read(plan.json()) == plan


def test_a_part_takes_the_copies_of_its_sweeps_alone():
    """Each copy stays with the sweep that it was made of."""
    given, _ = known()
    kept = np.arange(240) % 2 == 0
    less = given.take(kept)
    assert len(less.labels) == len(less.copied) == 120
    np.testing.assert_array_equal(less.features[less.source], given.features[kept])
    np.testing.assert_array_equal(less.copied, given.copied[kept])


def test_what_lies_in_another_group_is_not_chosen():
    """The feature that names every material within a group is the worst of all for a group that was not seen."""
    at = court()
    losses = [at.loss(at.judge([HeadPart(columns, False)])) for columns in (GOOD, NOISE, TRAP)]
    assert losses[0] < 0.2 < losses[1]
    assert losses[0] < losses[2]
    kinds = {"noise": [np.array(NOISE)], "trap": [np.array(TRAP)], "good": [np.array(GOOD)]}
    chosen = choice.choose(at, kinds, POOLS, NONE, print)
    assert chosen.plan.parts[0].columns == GOOD
    assert at.accuracy(chosen) > 0.9


def test_the_first_stays_where_nothing_is_clearly_better():
    """Of two that differ by chance the first is taken, in either order."""
    at, both = court(), {"good": [np.array(GOOD)], "more": [np.array((*GOOD, *NOISE))]}
    for order in (list(both), list(both)[::-1]):
        chosen = choice.choose(at, {name: both[name] for name in order}, POOLS, NONE, print)
        assert chosen.plan == at.judge([HeadPart(tuple(both[order[0]][0].tolist()), False)]).plan


def test_no_sweep_is_judged_by_a_head_that_saw_its_part():
    """A head that learns its sweeps by heart has nothing to say of others: far from right where it was not fitted."""
    given, parts = known()
    rng = np.random.default_rng(1)
    own = HeadData(
        rng.standard_normal((240, 400)).astype(np.float32), given.labels, np.empty((0, 400)), np.empty(0, int)
    )
    at = Court([own] * 3, parts, 3)
    assert at.accuracy(at.judge([HeadPart(tuple(range(400)), False)])) < 0.5
    assert at.sweeps.tolist() == list(range(240))


def test_the_temperature_is_the_best_for_held_out_sweeps():
    """No other divisor of its logits gives less loss; every group counts the same."""
    at = court()
    judged = at.judge([HeadPart(GOOD, False), HeadPart(NOISE, True)])

    def loss(temperature: float) -> float:
        p = softmax(judged.logits / temperature)[np.arange(240), at.labels]
        return float(-np.log(p) @ at.weights)

    assert loss(1) == pytest.approx(at.loss(judged))
    assert loss(1) <= min(loss(0.9), loss(1.1)) + 1e-3
    assert at.weights.sum() == pytest.approx(1)


def test_candidates_are_what_the_features_allow():
    """Every kind of filters, pooled in both ways and one; then the best with copies, with the spectrum, and that alone."""
    tried: list[str] = []
    kinds = {"zero-sum": [np.array([0])], "free": [np.array([1])], "both": [np.array([0]), np.array([1])]}
    chosen = choice.choose(court(), kinds, (np.array([0, 1]), np.array([2, 3])), np.array([4]), tried.append)
    assert len(tried) == len(set(tried)) == 6 + 5
    assert tried[:2] == ["choosing: zero-sum filters, magnitudes, shares", "choosing: zero-sum filters, magnitudes"]
    assert tried[-1] == "choosing: the spectrum alone, with copies"
    assert {part.columns for part in chosen.plan.parts} <= {(0,), (1,), (0, 2), (1, 3), (0, 4), (4,)}
    tried.clear()
    choice.choose(court(), {"zero-sum": [np.array([0])]}, POOLS, NONE, tried.append)
    assert len(tried) == 1 + 1
