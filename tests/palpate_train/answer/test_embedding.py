"""Novelty on Gaussians of known truth: the embedding is LDA, the limit keeps its share."""

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.answer import embedding
from palpate_train.metrics import tolerances
from tests.factories.later import Later

discriminant_analysis = Later("sklearn.discriminant_analysis")


def gaussians(n: int, means, seed: int = 0, mix=None):
    """n sweeps of each of `means` [K, F] with covariance mix mix' -> features, labels."""
    rng, means = np.random.default_rng(seed), np.asarray(means, float)
    labels = np.repeat(np.arange(len(means)), n)
    noise = rng.standard_normal((len(labels), means.shape[1]))
    return means[labels] + (noise if mix is None else noise @ mix), labels


@pytest.mark.parametrize("fixed", [0, 3])
def test_the_embedding_is_lda(fixed: int):
    """Logits are those of shrinkage LDA up to a common term; the covariance is 1."""
    mix = np.random.default_rng(1).standard_normal((7, 7))
    x, y = gaussians(200, np.random.default_rng(2).standard_normal((4, 7)) @ mix, mix=mix)
    one = embedding.embed(x, y, fixed)
    assert one.means.shape == (4, 3 + fixed)
    lda = discriminant_analysis.LinearDiscriminantAnalysis(
        solver="lsqr", shrinkage="auto", store_covariance=True
    ).fit(x, y)
    want = x @ lda.coef_.T + lda.intercept_
    have = one.logits(x)
    assert np.allclose(
        have - have.mean(1, keepdims=True), want - want.mean(1, keepdims=True), atol=1e-3
    )
    half = -((one(x)[:, None] - one.means) ** 2).sum(axis=2) / 2
    assert np.allclose(
        half - half.mean(1, keepdims=True), have - have.mean(1, keepdims=True), atol=1e-3
    )
    assert np.allclose(
        one.projection.T @ lda.covariance_ @ one.projection, np.eye(3 + fixed), atol=1e-3
    )


def test_untrained_features_are_kept_and_come_back():
    """With `fixed` the distance is the full Mahalanobis distance, and differences return."""
    x, y = gaussians(300, [[0, 0, 0], [6, 0, 0]])
    unknown = np.array([[0.0, 0.0, 20.0]])
    assert embedding.embed(x, y, 0).novelty(unknown)[0] < 10
    assert embedding.embed(x, y, 1).novelty(unknown)[0] > 300
    x, y = gaussians(200, np.random.default_rng(2).standard_normal((4, 20)))
    one = embedding.embed(x, y, 5)
    z = one(x)
    np.testing.assert_allclose((z[0] - z[1]) @ one.untrained, (x[0] - x[1])[-5:], atol=1e-2)
    assert (embedding.embed(x, y, 18).untrained == np.eye(20)).all()


@pytest.mark.parametrize("fixed", [0, 2])
def test_directions_towards_other_things_count(fixed: int):
    """What differs from all materials in another direction is far away; materials are not, and a
    model without one of them looks there, too."""
    x, y = gaussians(60, 6 * np.eye(3, 12))
    other = np.full(12, 0.0)
    other[4] = 20
    plain = embedding.in_two_views(x, y, fixed)
    one = embedding.in_two_views(x, y, fixed, other[None])
    assert plain.novelty(other[None])[0] < 150 < 300 < one.novelty(other[None])[0]
    assert np.quantile(one.novelty(x), 0.9) < 2 * np.quantile(plain.novelty(x), 0.9)
    assert one.beyond.shape == (len(one.offset), 1)
    without = embedding.shapes_without(one, one(x), y)(0)
    away = one(other[None])[:, None] - one.means[1:]
    assert embedding.shaped_distances(away, without).min() > 300


def test_each_material_has_its_own_shape_in_untrained_features():
    """Far from a material that hardly varies, whatever others do; few sweeps share a shape."""
    x, y = gaussians(400, [[0, 0, 0], [60, 0, 0]])
    x[y == 0, 2] *= 0.1
    one = embedding.embed(x, y, 1)
    narrow, wide = one.novelty(np.array([[0, 0, 2.0], [60, 0, 2.0]]))
    assert narrow > 20 * wide
    assert np.allclose(
        np.abs(one.shapes[1]), 1 / np.sqrt(2), rtol=0.2
    )  # its variance is twice the common one
    few = embedding.embed(*gaussians(2, [[0, 0, 0], [60, 0, 0]]), 3)
    assert np.isfinite(few.shapes).all()
    assert (
        np.linalg.eigvalsh(few.shapes.astype(float) @ few.shapes.astype(float).swapaxes(1, 2)) < 2
    ).all()
    assert embedding.embed(x, y).shapes.shape == (2, 0, 0)


def test_the_distance_is_the_sum_of_two_views():
    """Two untrained features and the trained direction; an unknown material shows in either."""
    x, y = gaussians(400, [[0, 0, 0, 0, 0, 0], [20, 0, 0, 0, 0, 0]])
    one = embedding.in_two_views(x, y, 2)
    r = one.means.shape[1]
    assert one.shapes.shape == (2, r, r)
    assert one.novelty(x).mean() == pytest.approx(r, rel=0.05)
    near = np.zeros((1, 6))
    away = [one.novelty(near + 8 * np.eye(6)[feature])[0] for feature in (0, 5)]
    assert away == pytest.approx([64, 64], rel=0.2)
    assert one.novelty(near + 8 * np.eye(6)[2])[0] < 5
    assert embedding.in_two_views(x, y).shapes.shape == (2, 0, 0)


def test_two_sweeps_of_a_material_are_enough():
    """A constant feature gives no NaN; the next sweep is some hundred times as far at most."""
    x, y = gaussians(2, [[0, 0, 0], [5, 0, 0]])
    x[:, 2] = 1.0
    more, labels = gaussians(30, [[5, 0, 1]], seed=3)
    more[:, 2] = 1.0
    one = embedding.embed(np.vstack([x, more]), np.concatenate([y, labels + 1]), 2)
    assert np.isfinite(one.novelty(x)).all()
    silent = embedding.embed(np.zeros((8, 3)), np.repeat([0, 1], 4), 3)
    assert np.isfinite(silent.novelty(np.ones((1, 3)))).all()
    rng = np.random.default_rng(3)
    means, labels = 5 * rng.standard_normal((3, 200)), np.repeat(np.arange(3), 2)
    learned, new = (means[labels] + rng.standard_normal((6, 200)) for _ in range(2))
    found = embedding.embed(learned, labels, fixed=20)
    assert np.median(found.novelty(new)) < 300 * found.means.shape[1]


@pytest.mark.parametrize(
    ("labels", "why"),
    [([0, 0, 0], "one material"), ([0, 2, 2, 0], "label 1"), ([0, 1], "record more")],
)
def test_what_cannot_be_embedded_is_refused(labels, why: str):
    """One material, a label without sweeps, and one sweep of each material are refused."""
    with pytest.raises(FormatError, match=why):
        embedding.embed(
            np.random.default_rng(0).standard_normal((len(labels), 2)), np.array(labels)
        )


def test_the_limit_keeps_what_it_promises():
    """A limit of 99 sweeps keeps the stated share of new sweeps; of few it is the largest."""
    rng = np.random.default_rng(0)
    for asked in (0.95, tolerances.KEPT):
        kept = [
            np.mean(rng.chisquare(5, 500) <= embedding.limit(rng.chisquare(5, 99), asked))
            for _ in range(200)
        ]
        assert abs(np.mean(kept) - asked) < 0.006
    assert embedding.limit(np.array([1.0, 7.0, 3.0])) == 7.0
    with pytest.raises(FormatError, match="several positions"):
        embedding.limit(np.empty(0))


def test_the_limit_knows_positions_that_were_not_seen():
    """Positions shift their sweeps: across groups the limit keeps 95 % at new positions."""

    def drawn(places, seed):
        x, y = gaussians(5 * places, [[0, 0], [30, 0]], seed)
        at = np.tile(np.repeat(np.arange(places), 5), 2)
        return x + 3 * np.random.default_rng(seed + 1).standard_normal((places, 2))[at], y, at

    def unseen(x, y, at, judged):
        found = np.full(len(y), np.nan)
        for _, numbers, fitted, _ in embedding.cross_fitted(x, y, at, judged, 2):
            found[numbers] = fitted.novelty(x[numbers])
        return found

    (x, y, at), (new, _, _) = drawn(300, 0), drawn(400, 5)
    one, every = embedding.in_two_views(x, y, 2), np.ones(len(y), bool)
    across = embedding.limit(unseen(x, y, at, every), 0.95)
    assert 0.93 < np.mean(one.novelty(new) <= across) < 0.97
    # with few places the covariance is too small, and what fits itself is far too narrow
    mine = [of[at < 7] for of in (x, y, at, every)]
    narrow = embedding.in_two_views(*mine[:2], 2)
    itself, others = (embedding.limit(s, 0.95) for s in (narrow.novelty(mine[0]), unseen(*mine)))
    kept = [np.mean(narrow.novelty(new) <= at_most) for at_most in (itself, others)]
    assert kept[0] < 0.9 < kept[1]
    few = np.isin(at, (0, 1))
    assert (np.isfinite(unseen(x, y, at, few)) == few).all()
    with pytest.raises(FormatError, match="one group"):
        unseen(x, y, 0 * at, every)


def test_each_judge_judges_once_and_never_its_own_group():
    """Every judged sweep is in exactly one part, and no group is on both sides."""
    groups = np.random.default_rng(0).integers(0, 25, 200)
    judged = groups % 3 > 0
    seen = []
    for fit, numbers in embedding.parts(groups, judged):
        assert not set(groups[fit]) & set(groups[numbers])
        seen += numbers.tolist()
    assert sorted(seen) == np.flatnonzero(judged).tolist()


def test_auroc_of_a_known_separation():
    """Two normals two deviations apart: Phi(2 / sqrt 2); ties count half."""
    stats = Later("scipy.stats")
    rng = np.random.default_rng(0)
    have = embedding.auroc(rng.standard_normal(20000), 2 + rng.standard_normal(20000))
    assert abs(have - stats.norm.cdf(2 / np.sqrt(2))) < 0.003
    assert embedding.auroc(np.zeros(3), np.zeros(5)) == 0.5
    with pytest.raises(FormatError, match="both kinds"):
        embedding.auroc(np.zeros(3), np.empty(0))


def test_untrained_features_are_selected_and_not_multiplied():
    """Covariance 1; the last features decide in their own span."""
    mix = np.random.default_rng(1).standard_normal((20, 20))
    x, y = gaussians(200, np.random.default_rng(2).standard_normal((4, 20)) @ mix, mix=mix)
    one = embedding.embed(x, y, 5)
    assert one.directions.shape == (20, 3)
    assert one.selected == 5
    assert one.projection.shape == (20, 8)
    within = np.cov((one(x) - one.means[y]).T)
    np.testing.assert_allclose(within, np.eye(8), atol=0.15)
    few = embedding.embed(x, y, 18)
    assert few.selected == 0
    assert few.projection.shape == (20, 20)
