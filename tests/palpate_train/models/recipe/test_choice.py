"""Heads that add discriminants, and the choice among candidates by held-out parts."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.answer.objects import softmax
from palpate_train.answer.heads import HeadData, HeadPart, HeadPlan, fit_discriminant
from palpate_train.data.splitters import InnerPart
from palpate_train.models.recipe import choice
from palpate_train.models.recipe.choice import Candidates, FeatureColumns, HeldOutScores

GOOD, NOISE, TRAP = (0, 1), (2, 3), (4,)
"""Features that name the material everywhere; features without information; a feature that names it
in one group and misleads in the others."""


def known(n: int = 240, seed: int = 0) -> tuple[HeadData, list[InnerPart]]:
    """Three materials in three equal groups, a copy of each, a part for each group."""
    rng = np.random.default_rng(seed)
    labels, group = np.arange(n) % 3, np.arange(n) // (n // 3)
    angle = 2 * np.pi * labels / 3
    x = rng.standard_normal((n, 5))
    x[:, GOOD] += 2.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x[:, TRAP] = ((labels + group) % 3)[:, None] + 0.01 * x[:, TRAP]
    copied = x + 0.1 * rng.standard_normal(x.shape)
    given = HeadData(
        x.astype(np.float32),
        labels,
        lambda: copied.astype(np.float32),
        np.arange(n),
        group[:, None],
    )
    return given, [InnerPart("place", group == value) for value in range(3)]


def candidates(
    kinds: Sequence[Sequence[int]],
    magnitudes: Sequence[int],
    shares: Sequence[int],
    levels: Sequence[int] = (),
    bands: Sequence[int] = (),
    copies: bool = False,
    loads: Sequence[int] = (),
    grouped: bool = True,
    relations: Sequence[Sequence[int]] = ((),),
    slow: Sequence[int] = (),
) -> Candidates:
    """The candidates of a trunk with these features."""
    views = magnitudes, shares, levels, loads, relations, slow, bands
    parts = [np.array(part, int) for part in views]
    columns = FeatureColumns(*parts[:2], tuple(map(np.array, kinds)), *parts[2:])
    return Candidates(columns, copies, grouped)


def scores() -> HeldOutScores:
    """The scores of `known`."""
    given, parts = known()
    return HeldOutScores([given] * 3, parts, 3)


def test_a_plan_is_the_sum_of_its_discriminants():
    """One matrix equals the sum of discriminants times factors; copies only on request."""
    given, _ = known()
    plan = HeadPlan((HeadPart(GOOD, False, factor=2.0), HeadPart((1, 2), True, factor=0.5)))
    weight, bias = plan.fit(given, 3)
    x, y, under = given.features, given.labels, given.conditions
    apart = fit_discriminant(x[:, GOOD], y, 3, under)
    both = np.concatenate([x, given.copied])[:, 1:3]
    with_copies = fit_discriminant(both, np.tile(y, 2), 3, np.tile(under, (2, 1)))
    want = 2 * (given.features[:, GOOD] @ apart[0].T + apart[1])
    want += 0.5 * (given.features[:, 1:3] @ with_copies[0].T + with_copies[1])
    np.testing.assert_allclose(given.features @ weight.T + bias, want, rtol=1e-4, atol=1e-3)
    assert plan.columns().tolist() == [0, 1, 2]
    kept = np.array([0, 1, 2, 4])
    less = given.seen(kept)
    np.testing.assert_array_equal(plan.renumbered(kept).fit(less, 3)[0][:, :3], weight[:, :3])
    cooler = plan.cooled(4.0).fit(given, 3)
    np.testing.assert_allclose(cooler[0] * 4, weight, rtol=1e-5)
    assert HeadPlan.read(plan.json()) == plan


def test_a_part_takes_the_copies_of_its_sweeps_alone():
    """Each copy stays with its sweep."""
    given, _ = known()
    kept = np.arange(240) % 2 == 0
    less = given.take(kept)
    assert len(less.labels) == len(less.copied) == 120
    np.testing.assert_array_equal(less.features[less.source], given.features[kept])
    np.testing.assert_array_equal(less.copied, given.copied[kept])
    np.testing.assert_array_equal(less.conditions, given.conditions[kept])


@pytest.mark.parametrize(("slow", "joins"), [(NOISE, True), (TRAP, False)])
def test_slow_waves_join_unless_they_harm(slow: tuple[int, ...], joins: bool):
    """Noise joins; a trap for two of three groups stays out."""
    given, parts = known(600)
    rng, x = np.random.default_rng(1), given.features.copy()
    x[:, GOOD] += 0.8 * rng.standard_normal((600, 2))
    x[:, TRAP] += rng.standard_normal((600, 1))
    at = HeldOutScores([replace(given, features=x, of_copies=lambda: x)] * 3, parts, 3)
    *others, last = choice.choose(at, candidates([[0, 1]], GOOD, GOOD, slow=slow), print).plan.parts
    assert (last.columns == slow) is joins
    assert last.weight == (sum(part.weight for part in others) if joins else 1)
    put_back = candidates([[0, 1]], GOOD, GOOD, slow=slow, copies=True)
    assert not put_back.beside(put_back.usual())


@pytest.mark.parametrize(("n", "few"), [(60, True), (600, False)])
def test_a_few_sweeps_take_relations_and_ask_more_of_slow_waves(n: int, few: bool):
    """Some of 60 get a wrong label: relations join them without showing a gain. Slow waves of noise
    raise the loss and join 600 alone."""
    given, parts = known(n)
    rng, x = np.random.default_rng(1), given.features.copy()
    x[:, GOOD] += 0.8 * rng.standard_normal((n, 2))
    at = HeldOutScores([replace(given, features=x, of_copies=lambda: x)] * 3, parts, 3)
    offered = partial(candidates, [[0, 1]], GOOD, GOOD)
    related = choice.choose(at, offered(relations=[[2]]), print).plan
    assert (2 in related.columns()) is few
    slow = choice.choose(at, offered(slow=NOISE), print).plan
    assert (NOISE[0] in slow.columns()) is not few
    assert not offered(relations=[[2]], copies=True).unshown(offered().usual())


def test_what_is_better_in_every_group_is_chosen():
    """Bands that name most; not the feature that is best within a group alone."""
    given, parts = known(600)
    x = given.features.copy()
    x[:, GOOD] += np.random.default_rng(1).standard_normal((600, 2))
    x[:, NOISE] += 3 * ((given.labels + np.arange(600) // 200) % 3)[:, None]
    at = HeldOutScores([replace(given, features=x, of_copies=lambda: x)] * 3, parts, 3)
    chosen = choice.choose(at, candidates([[0, 1]], NOISE, NOISE, bands=GOOD), print)
    assert all(set(GOOD) <= set(part.columns) for part in chosen.plan.parts)
    assert at.paired(chosen, at.score([HeadPart(NOISE, False)])).better
    at = scores()
    losses = [at.loss(at.score([HeadPart(columns, False)])) for columns in (GOOD, NOISE, TRAP)]
    assert losses[0] < 0.2 < losses[1]
    assert losses[0] < losses[2]
    chosen = choice.choose(at, candidates([[0, 1]], GOOD, NOISE, bands=TRAP), print)
    assert (
        sum(TRAP[0] in part.columns for part in chosen.plan.parts) <= 1
    )  # where the usual one sees the spectrum
    assert at.accuracy(chosen) > 0.9


def test_the_usual_one_stays_where_nothing_is_clearly_better():
    """All magnitudes and all features, without copies; loss alone does not count."""
    at = scores()
    chosen = choice.choose(at, candidates([[0, 1]], GOOD, NOISE), print)
    assert chosen.plan == at.score([HeadPart(GOOD, False), HeadPart((*GOOD, *NOISE), False)]).plan
    one = at.score([HeadPart(GOOD, False)])
    wrong = one.logits.argmax(axis=1) != at.labels
    surer = replace(one, losses=one.losses + 5.0 * wrong)
    assert at.loss(surer) > at.loss(one)
    assert not at.paired(one, surer).better


def test_fewer_filters_where_held_out_parts_show_no_loss():
    """Of equal responses a half, a quarter and so on stay, at least `least`."""
    given, parts = known(600)
    rng = np.random.default_rng(2)
    same = given.features[:, :1] @ np.ones((1, 16)) + given.features[:, 1:2] @ np.tile(
        [[1.0, -1.0]], 8
    )
    x = np.hstack([same + 1e-3 * rng.standard_normal(same.shape), given.features[:, [2]]]).astype(
        np.float32
    )
    none = partial(np.empty, (0, 17), np.float32), np.empty(0, int)
    own = HeadData(x, given.labels, *none, np.empty((600, 0), int))
    at, number = HeldOutScores([own] * 3, parts, 3), np.append(np.arange(16), -1)
    full = at.score([HeadPart(tuple(range(17)), False)])
    tried: list[str] = []
    # every other of these has the same sign: a half is not enough to name the materials
    assert choice.with_fewer_filters(at, full, number, tried.append, 4) == full
    assert tried == ["choosing: 8 filters"]
    pairs = np.append(np.arange(16) // 2, -1)
    less = choice.with_fewer_filters(at, full, pairs, print, 2)
    assert less.plan.parts[0].columns == (0, 1, 8, 9, 16)
    assert at.accuracy(less) > at.accuracy(full) - 0.01


def test_few_sweeps_and_a_few_errors_show_nothing():
    """A hundred correct ones may be luck; many more errors are worse, none is not."""
    given, parts = known(99)
    at = HeldOutScores([given] * 3, parts, 3)
    sure = at.score([HeadPart(GOOD, False)])
    assert not at.paired(sure, sure).holds
    many, parts = known(600)
    at = HeldOutScores([many] * 3, parts, 3)
    sure = at.score([HeadPart(GOOD, False)])
    assert at.paired(sure, sure).holds
    assert not at.paired(at.score([HeadPart(NOISE, False)]), sure).holds
    at = scores()
    one = at.score([HeadPart(GOOD, False)])
    wrong = np.roll(one.logits, 1, axis=1)

    def spoiled_by(n: int) -> choice.ScoredPlan:
        logits = one.logits.copy()
        right = np.flatnonzero(one.logits.argmax(axis=1) == at.labels)
        logits[right[:: len(right) // n][:n]] = wrong[right[:: len(right) // n][:n]]
        return replace(one, logits=logits)

    assert at.paired(spoiled_by(40), one).worse
    assert not at.paired(one, one).worse
    assert not at.paired(one, spoiled_by(40)).worse


def test_no_group_loses_for_the_gain_of_another():
    """Wrong answers under a new force are not made up by right ones at a new place."""
    given, parts = known(600)
    forces = [InnerPart("force", part.out) for part in parts]
    at = HeldOutScores([given] * 6, [*parts, *forces], 3)
    full = at.score([HeadPart(GOOD, False)])
    force, right = at.groups == "force", at.right(full)
    better = np.where(force[:, None], full.logits, np.eye(3)[at.labels])
    less = replace(full, logits=better)
    assert at.paired(less, full).holds
    lost = np.flatnonzero(force & right)[:6]  # a hundredth of the group
    better[lost] = -np.eye(3)[at.labels[lost]]
    assert at.accuracy(less) > at.accuracy(full)
    assert not at.paired(less, full).holds


def test_no_sweep_is_judged_by_a_head_that_saw_its_part():
    """A head that overfits scores far from perfect on held-out sweeps."""
    given, parts = known()
    rng = np.random.default_rng(1)
    own = HeadData(
        rng.standard_normal((240, 400)).astype(np.float32),
        given.labels,
        partial(np.empty, (0, 400)),
        np.empty(0, int),
        np.empty((240, 0), int),
    )
    at = HeldOutScores([own] * 3, parts, 3)
    assert at.accuracy(at.score([HeadPart(tuple(range(400)), False)])) < 0.5
    assert at.labels.tolist() == given.labels.tolist()


def test_copies_of_held_out_sweeps_count_as_much_as_these():
    """If copies are scored, a head that fails on copies loses to one that does not."""
    given, parts = known()
    copied = given.copied.copy()
    copied[:, GOOD[0]] = 0
    blind = (
        np.hstack([given.features, given.features[:, GOOD]]),
        np.hstack([copied, given.copied[:, GOOD]]),
    )
    both = replace(given, features=blind[0], of_copies=lambda: blind[1])
    fails, stands = [HeadPart(GOOD, False)], [HeadPart((5, 6), False)]
    in_place, moved = (
        HeldOutScores([both] * 3, parts, 3),
        HeldOutScores([both] * 3, parts, 3, copied=True),
    )
    assert in_place.own.all()
    assert in_place.accuracy(in_place.score(fails)) == in_place.accuracy(in_place.score(stands))
    assert moved.own.sum() == len(given.labels) == (~moved.own).sum()
    assert moved.weights[moved.own].sum() == pytest.approx(0.5)
    assert moved.paired(moved.score(stands), moved.score(fails)).better
    assert not moved.paired(moved.score(fails), moved.score(stands)).holds
    own = moved.score(fails).logits[moved.own].argmax(axis=1) == moved.labels[moved.own]
    assert own.mean() == pytest.approx(in_place.accuracy(in_place.score(fails)))


def test_the_temperature_is_the_best_for_held_out_sweeps():
    """No other divisor of the logits has a lower loss; every group counts the same."""
    at = scores()
    judged = at.score([HeadPart(GOOD, False), HeadPart(NOISE, True)])

    def loss(temperature: float) -> float:
        p = np.log(softmax(judged.logits / temperature))
        right, any_ = p[np.arange(240), at.labels], p.mean(axis=1)
        return float(-((1 - 1 / 242) * right + any_ / 242) @ at.weights)  # Platt's correction

    plain = -np.log(softmax(judged.logits)[np.arange(240), at.labels]) @ at.weights
    assert plain == pytest.approx(at.loss(judged))
    assert loss(1) <= min(loss(0.97), loss(1.03))
    assert at.weights.sum() == pytest.approx(1)


def test_candidates_are_what_the_features_allow():
    """The usual candidate, magnitudes, without spectrum; then with copies, and so on. Where copies
    are wanted, all see them."""
    tried: list[str] = []
    choice.choose(scores(), candidates([[0], [1]], [0, 1], [2, 3], bands=[4]), tried.append)
    assert len(tried) == len(set(tried)) == 2 + 1 + 2 + 1
    said = [line.removeprefix("choosing: ") for line in (*tried[:3], *tried[-2:])]
    assert said[0].split(", ") == ["magnitudes", "shares", "distribution"]
    assert said[1:3] == ["magnitudes", "without spectrum"]
    assert said[3:] == ["the spectrum alone", "with the spectrum beside"]
    tried.clear()
    chosen = choice.choose(scores(), candidates([[0]], [0, 1], [2, 3]), tried.append)
    assert len(tried) == 2 + 1
    assert {part.columns for part in chosen.plan.parts} == {(0,), (0, 2)}
    tried.clear()
    heads = candidates([[0], [1]], [0, 1], [2, 3], bands=[4], copies=True)
    chosen = choice.choose(scores(), heads, tried.append)
    assert all(part.copies for part in chosen.plan.parts)
    assert "choosing: without copies" in tried
    assert len(tried) == len(set(tried)) == 2 + 2 + 2 + 1


@pytest.mark.parametrize("drawn", [False, True])
def test_copies_are_drawn_and_chosen_where_sweeps_alone_do_not_suffice(drawn: bool):
    """Each place disturbs sweeps in its own way, which copies show in training; without
    disturbances nothing is drawn."""
    Array = NDArray[np.float64]
    given, parts = known()
    rng, signal = np.random.default_rng(3), 2 * np.eye(3)[given.labels]
    place = np.eye(3)[np.arange(240) // 80] * drawn

    def disturbed(strength: Array) -> Array:
        shown = strength * rng.standard_normal((240, 3))
        x = np.hstack([signal + 6 * shown.sum(axis=1)[:, None] * [1.0, 0.5, -1.0], shown])
        return x + 0.1 * rng.standard_normal(x.shape)

    changed = disturbed(np.ones((240, 3)))
    own = replace(given, features=disturbed(place), of_copies=lambda: changed)
    at = HeldOutScores([own] * 3, parts, 3)
    chosen = choice.choose(at, candidates([range(6)], range(6), range(6)), print)
    assert own.drawn is drawn
    assert any(part.copies for part in chosen.plan.parts) is drawn


def test_the_usual_one_sees_each_kind_three_times():
    """Magnitudes; shares and spectrum; distribution and spectrum; none twice."""
    given, parts = known()
    x = np.hstack([given.features[:, [0]]] * 6 + [given.features[:, [1]]] * 6)
    rng = np.random.default_rng(0)
    own = replace(
        given,
        features=(x + 0.1 * rng.standard_normal(x.shape)).astype(np.float32),
        of_copies=partial(np.zeros, (240, 12)),
    )
    at = HeldOutScores([own] * 3, parts, 3)
    heads = candidates([[0], [1]], [0, 1], [2, 3], levels=range(4, 8), bands=range(8, 12))
    chosen = choice.choose(at, heads, print)
    wanted = [(0,), (1,)]
    wanted += [(kind, kind + 2, 8, 9, 10, 11) for kind in (0, 1)] + [
        (kind, *range(4, 12)) for kind in (0, 1)
    ]
    assert [part.columns for part in chosen.plan.parts] == wanted


def spoiled(*noise: int) -> HeldOutScores:
    """The features `noise` name the material in two groups, and another in the first."""
    given, parts = known()
    rng = np.random.default_rng(1)
    x = given.features.copy()
    group = np.arange(len(x)) // (len(x) // 3)
    for column in noise:
        x[:, column] = (given.labels + (group == 0)) % 3 + 0.01 * rng.standard_normal(len(x))
    copied = x + 0.1 * rng.standard_normal(x.shape).astype(np.float32)
    return HeldOutScores([replace(given, features=x, of_copies=lambda: copied)] * 3, parts, 3)


def test_views_and_copies_stay_away_where_they_harm():
    """Where a view helps within a group alone, or another feature names the copies."""
    heads = candidates([[0, 1]], [0, 1], [0, 1], levels=[2, 3])
    harmed = choice.choose(spoiled(2, 3), heads, print)
    assert not {2, 3} & set(harmed.plan.columns().tolist())
    kept = choice.choose(scores(), candidates([[0]], [0], [0], levels=[1]), print)
    assert 1 in kept.plan.columns()
    given, parts = known()
    rng = np.random.default_rng(2)
    mixed = given.features[rng.permutation(len(given.features))] * 3
    at = HeldOutScores([replace(given, of_copies=lambda: mixed)] * 3, parts, 3)
    heads = candidates([[0, 1]], [0, 1], [0, 1], copies=True)
    assert not any(part.copies for part in choice.choose(at, heads, print).plan.parts)


def test_loads_join_where_held_out_groups_show_it():
    """Not in one session, and not where they mislead in the next."""

    def with_loads(seed: int = 3) -> tuple[HeldOutScores, FeatureColumns]:
        """Scores of sweeps with one weak filter (0), and loads (1, 2) that name materials."""
        given, parts = known(seed=seed)
        x = given.features[:, [3, 0, 1]].copy()
        x[:, 0] += 0.4 * given.features[:, 0]
        own = replace(given, features=x, of_copies=lambda: x)
        columns = candidates([[0]], [0], [0], loads=[1, 2]).columns
        return HeldOutScores([own] * 3, parts, 3), columns

    at, columns = with_loads()
    joined = choice.choose(at, Candidates(columns, False, True), print)
    assert {1, 2} <= set(joined.plan.columns().tolist())
    alone = choice.choose(at, Candidates(columns, False, False), print)
    assert not {1, 2} & set(alone.plan.columns().tolist())
    heads = candidates([[0, 1]], [0, 1], [0, 1], loads=[2, 4])
    chosen = choice.choose(spoiled(2), heads, print)
    assert not {2, 4} & set(chosen.plan.columns().tolist())


def test_weights_count_and_factors_from_before_do_not():
    """Half the weight halves the logits in the sum; the same score at any old factor."""
    at = scores()
    one, other = HeadPart(GOOD, False), HeadPart(NOISE, False)
    even, less = (at.score([one, replace(other, weight=weight)]).plan for weight in (1.0, 0.5))
    ratio = [plan.parts[1].factor / plan.parts[0].factor for plan in (even, less)]
    assert ratio[1] == pytest.approx(ratio[0] / 2)
    given, parts = known()
    for factor in (1.0, 1e-3):
        at = HeldOutScores([given] * 3, parts, 3)
        both = at.score([HeadPart(GOOD, False, factor), HeadPart(NOISE, False, 7 * factor)])
        fresh = HeldOutScores([given] * 3, parts, 3).score(
            [HeadPart(GOOD, False), HeadPart(NOISE, False)]
        )
        assert both.plan == fresh.plan


def test_discriminants_are_scaled_alike():
    """A mostly wrong one costs hardly anything; a missing material's logit sets no scale."""
    at = scores()
    good, noise = HeadPart(GOOD, False), HeadPart(NOISE, False)
    alone, both = at.accuracy(at.score([good])), at.score([good, noise])
    assert at.accuracy(both) > alone - 0.02
    sizes = [np.abs(at.score([part]).logits).mean() for part in (good, noise)]
    assert sizes[0] > 10 * sizes[1]  # at its best temperature chance is never sure
    ratio = both.plan.parts[0].factor / both.plan.parts[1].factor
    given, _ = known()
    weights = [part.fit(given, 3)[0] for part in (good, noise)]
    assert ratio * np.abs(weights[0]).max() > np.abs(weights[1]).max()
    given, parts = known()
    lacking = replace(given, labels=np.where(given.labels == 2, 0, given.labels))
    one, other = HeadPart(GOOD, False), HeadPart(NOISE, False)
    plans = [HeldOutScores([lacking] * 3, parts, k).score([one, other]).plan for k in (2, 3)]
    factors = [[part.factor for part in plan.parts] for plan in plans]
    np.testing.assert_allclose(factors[0], factors[1], rtol=0.05)


def test_a_size_without_filters_has_relations_and_spectrum_in_one_discriminant():
    """A weak spectrum beside them would only add its errors."""
    given, parts = known(seed=3)
    at = HeldOutScores([given] * 3, parts, 3)
    heads = candidates([], [], [], bands=[2], relations=[[0], [1]])
    assert [part.columns for part in choice.choose(at, heads, print).plan.parts] == [(0, 1, 2)]


def test_relations_join_where_held_out_groups_show_it():
    """In all groups: a few scales and all join; those that mislead elsewhere do not."""
    given, parts = known(seed=3)
    x = given.features[:, [3, 0, 1, 2, 4]].copy()
    x[:, 0] += 0.4 * given.features[:, 0]
    at = HeldOutScores([replace(given, features=x, of_copies=lambda: x)] * 3, parts, 3)
    heads = candidates([[0]], [0], [0], relations=[[1], [2], [3], [3]])
    joined = choice.choose(at, heads, print).plan.parts
    assert [part.columns for part in joined[-2:]] == [(1, 2, 3), (1, 2, 3, 3)]
    assert not {4} & set(
        choice.choose(at, candidates([[0]], [0], [0], relations=[[4]]), print)
        .plan.columns()
        .tolist()
    )


def test_relations_join_where_they_name_more_although_one_group_is_less_sure(
    monkeypatch: pytest.MonkeyPatch,
):
    """Clearly more right answers count; loads stay away, which a session may set."""
    given, parts = known(600)
    halves = [InnerPart("speed", np.arange(600) % 2 == half) for half in (0, 1)]
    at = HeldOutScores([given] * 5, [*parts, *halves], 3)
    usual = at.score([HeadPart(NOISE, False)])
    right = np.eye(3)[at.labels] * 4
    losses = usual.losses - np.where(at.groups == "speed", -0.05, 0.8)
    named = replace(usual, logits=right, losses=losses)
    assert at.paired(named, usual).better
    assert not at.paired(named, usual).helps
    score, heads = at.score, candidates([[0]], NOISE, NOISE, loads=[4])
    monkeypatch.setattr(
        at, "score", lambda heads: named if isinstance(heads, str) else score(heads)
    )
    for view, joins in (("related", True), ("loaded", False)):
        with monkeypatch.context() as patched:
            patched.setattr(Candidates, view, lambda self, best: {"more": "more"})
            if view == "related":
                patched.setattr(Candidates, "loaded", lambda self, best: {})
            assert (choice.choose(at, heads, print) is named) == joins


def test_one_group_that_shows_the_opposite_suffices_against_loads():
    """Loads that help by force and harm by speed stay away, even if the sum is a gain."""
    given, parts = known()
    halves = [InnerPart("speed", np.arange(240) % 2 == half) for half in (0, 1)]
    at = HeldOutScores([given] * 5, [*parts, *halves], 3)
    one = at.score([HeadPart(GOOD, False)])
    better = replace(one, losses=one.losses - np.where(at.groups == "speed", -0.05, 0.4))
    assert not at.paired(better, one).helps
    assert at.paired(
        replace(one, losses=one.losses - np.where(at.groups == "speed", 0, 0.4)), one
    ).helps


@pytest.mark.parametrize(
    ("won", "saved", "carries"),
    [
        ([30, 0, 0], 1.0, True),
        ([30, 0, 0], -1.0, False),
        ([3, 0, 0], 1.0, False),
        ([40, 0, -10], 1.0, False),
    ],
)
def test_one_part_may_show_what_carries_over(won: list[int], saved: float, carries: bool):
    """The outermost value alone, not against loss or by chance."""
    gain = np.concatenate([np.sign(n) * (np.arange(100) < abs(n)) for n in won]) / 300
    parts = np.repeat(np.arange(3), 100)
    groups = [(parts < 2, np.full(200, 1 / 300)), (parts == 2, np.full(100, 1 / 300))]
    found = choice.PairedDifference(gain, np.full(300, saved / 300), parts, groups)
    assert found.carries is carries
    assert not found.better


@pytest.mark.parametrize("relations", [[[5, 6], [7, 8]], [[]]], ids=["skin", "one taxel"])
def test_shares_and_few_scales_take_the_place_of_magnitudes_that_mislead(relations: list):
    """Magnitudes name the material in one group alone, shares and relations in each. A single
    taxel has no relations."""
    given, parts = known(600)
    rng, own = np.random.default_rng(5), given.features[:, GOOD]
    views = [own + 2.5 * rng.standard_normal((600, 2)) for _ in range(4)]
    x = np.hstack([given.features[:, TRAP], *views]).astype(np.float32)
    at = HeldOutScores([replace(given, features=x, of_copies=lambda: x)] * 3, parts, 3)
    offered = candidates([[0]], [0], [1], levels=(3, 4), relations=relations)
    chosen = choice.choose(at, offered, print)
    assert 0 not in chosen.plan.columns()
    assert {1, 3, *relations[0][:1]} <= set(chosen.plan.columns().tolist())


@pytest.mark.parametrize("relations", [[[]], [[5, 6]]], ids=["one taxel", "skin"])
def test_a_spectrum_that_filters_outvote_counts_half_beside_those_of_one_taxel(relations: list):
    """Where that makes held-out sweeps surer and no label worse; a skin has relations for it."""
    given, parts = known(600)
    rng, own = np.random.default_rng(5), given.features[:, GOOD]
    weak = [own + 2.0 * rng.standard_normal((600, 2)) for _ in range(4)]
    x = np.hstack([*weak, own]).astype(np.float32)
    at = HeldOutScores([replace(given, features=x, of_copies=lambda: x)] * 3, parts, 3)
    offered = candidates([[0]], [0], [1], levels=[2], bands=[8, 9], relations=relations)
    tuned = offered.tuned(offered.usual())
    assert bool(tuned) is (relations == [[]])
    for heads in tuned.values():
        *others, alone = heads
        assert alone.columns == (8, 9)
        assert alone.weight == sum(part.weight for part in others)
        assert at.paired(at.score(heads), at.score(offered.usual())).gains
    assert not candidates([[0]], [0], [1]).tuned(offered.usual())


@pytest.mark.parametrize(
    ("won", "saved", "gains"),
    [(0.0, 1.0, True), (0.1, 1.0, True), (-0.1, 1.0, False), (0.1, 0.0, False)],
)
def test_a_spectrum_gains_with_the_loss_and_never_against_labels(
    won: float, saved: float, gains: bool
):
    """A lower loss alone may come from the size of logits."""
    parts = np.arange(90) % 3
    found = choice.PairedDifference(np.full(90, won / 90), np.full(90, saved / 90), parts, [])
    assert found.gains is gains


def test_a_tie_takes_the_larger_sum():
    """Where all held-out labels are right either way, slow waves join."""
    given, parts = known()
    clear = 20 * np.eye(3)[given.labels] + np.random.default_rng(6).standard_normal((240, 3))
    x = np.hstack([clear, clear]).astype(np.float32)
    at = HeldOutScores([replace(given, features=x, of_copies=lambda: x)] * 3, parts, 3)
    offered = candidates([[0, 1, 2]], [0, 1, 2], [0, 1, 2], slow=[3, 4, 5])
    assert at.wrong(at.score(offered.usual())) == 0
    assert {3, 4, 5} <= set(choice.choose(at, offered, print).plan.columns().tolist())
