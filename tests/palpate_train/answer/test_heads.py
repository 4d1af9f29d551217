"""The discriminant against scikit-learn's covariance, also with too few sweeps."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.answer import heads
from tests.factories.later import Later

covariances = Later("sklearn.covariance")


def drawn(n: int, size: int, classes: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Correlated features [n, size] of materials whose means differ, and labels that all occur."""
    rng = np.random.default_rng(n + size)
    labels = rng.permutation(np.arange(n) % classes)
    x = (
        rng.standard_normal((n, size)) @ rng.standard_normal((size, size))
        + 3 * rng.standard_normal((classes, size))[labels]
    )
    return x, labels


@pytest.mark.parametrize(("n", "size"), [(60, 10), (60, 59), (60, 60), (40, 200)])
def test_it_is_the_inverse_of_ledoit_and_wolfs_covariance(n: int, size: int):
    """Solved among sweeps or among features, the weights are those of the covariance itself."""
    x, labels = drawn(n, size)
    means = np.stack([x[labels == k].mean(axis=0) for k in range(4)])
    scatter = x - means[labels]
    spread = scatter.std(axis=0)
    covariance = (
        covariances.ledoit_wolf(scatter / spread, assume_centered=True)[0]
        * spread[:, None]
        * spread
    )
    wanted = np.linalg.solve(covariance, (means - means.mean(axis=0)).T).T
    weight, bias = heads.fit_discriminant(x, labels, 4)
    np.testing.assert_allclose(weight, wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max())
    logits = x @ weight.T + bias
    away = ((x[:, None] - means) @ np.linalg.inv(covariance) * (x[:, None] - means)).sum(axis=2)
    differences = logits - logits.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(
        differences,
        -(away - away.mean(axis=1, keepdims=True)) / 2,
        atol=1e-2 * np.abs(differences).max(),
    )


@pytest.mark.parametrize(("n", "size"), [(60, 10), (40, 200)])
def test_values_of_a_condition_widen_the_scatter_to_one_more(n: int, size: int):
    """Squares of the means 2 / (G - 1) times more."""
    x, labels = drawn(n, size)
    under = np.where(labels == 0, 5, np.random.default_rng(3).integers(0, 3, n))
    means = np.stack([x[labels == k].mean(axis=0) for k in range(4)])
    scatter = x - means[labels]
    spread = scatter.std(axis=0)
    z = scatter / spread
    added = np.zeros((size, size))
    for k in range(1, 4):
        for value in range(3):
            of = z[(labels == k) & (under == value)]
            added += 2 / (3 - 1) * len(of) * np.outer(of.mean(axis=0), of.mean(axis=0))
    share = covariances.ledoit_wolf(z, assume_centered=True)[1]
    covariance = (1 - share) * (z.T @ z + added) / n
    covariance += share * np.trace(z.T @ z + added) / n / size * np.eye(size)
    covariance *= spread[:, None] * spread
    wanted = np.linalg.solve(covariance, (means - means.mean(axis=0)).T).T
    weight, _ = heads.fit_discriminant(x, labels, 4, under[:, None])
    np.testing.assert_allclose(weight, wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max())


def test_a_feature_that_moves_with_a_condition_counts_less():
    """Another force would move it again."""
    rng = np.random.default_rng(1)
    labels, force = np.arange(240) % 3, np.arange(240) // 3 % 2
    x = rng.standard_normal((240, 4))
    x[:, 3] = x[:, 2] + 0.1 * x[:, 3]  # a covariance that is not shrunk away
    x[:, :2] += 2.0 * labels[:, None]
    x[:, 0] += 3.0 * force * (labels - 1)
    moving, still = np.abs(heads.fit_discriminant(x, labels, 3)[0]).max(axis=0)[:2]
    wider = np.abs(heads.fit_discriminant(x, labels, 3, force[:, None])[0]).max(axis=0)
    assert wider[0] / wider[1] < 0.6 * moving / still
    one = np.zeros((240, 1), int)
    np.testing.assert_array_equal(
        heads.fit_discriminant(x, labels, 3, one)[0], heads.fit_discriminant(x, labels, 3)[0]
    )


def test_recordings_are_no_condition_and_a_material_without_sweeps_is_never_named():
    """Conditions are those that a user may vary; the missing logit lies below all others."""
    groups = {"recording": np.arange(4), "force": np.array([5, 7, 5, 9])}
    assert heads.condition_values(groups, 4).tolist() == [[0], [1], [0], [2]]
    assert heads.condition_values({"recording": np.arange(4)}, 4).shape == (4, 0)
    x, labels = drawn(40, 5)
    weight, bias = heads.fit_discriminant(x, np.where(labels == 2, 4, labels), 5)
    assert set((x @ weight.T + bias).argmax(axis=1)) <= {0, 1, 3, 4}
    assert bias[2] == heads.ABSENT
    assert not weight[2].any()


def test_logits_stay_above_a_missing_material_and_one_sweep_is_too_few():
    """Above ABSENT, however large the weights; the message counts the sweeps."""
    x, labels = drawn(60, 59)
    weight, bias = heads.fit_discriminant(1e-3 * x + 1e3, labels, 5)
    assert (x.astype(np.float64) @ weight.T + bias).shape == (60, 5)
    logits = (1e-3 * x + 1e3) @ weight.T.astype(np.float64) + bias
    assert (logits.max(axis=1) > heads.ABSENT).all()
    assert set(logits.argmax(axis=1)) <= {0, 1, 2, 3}
    with pytest.raises(FormatError, match="3 sweeps"):
        heads.fit_discriminant(np.eye(3), np.arange(3), 3)


def test_features_without_scatter_leave_finite_heads():
    """A silent feature and a copy change nothing; without any scatter the nearest mean wins."""
    x, labels = drawn(60, 6)
    weight, bias = heads.fit_discriminant(np.hstack([x, x[:, :1], np.ones((60, 1))]), labels, 4)
    assert np.isfinite(weight).all()
    plain_weight, plain_bias = heads.fit_discriminant(x, labels, 4)
    plain = x @ plain_weight.T + plain_bias
    more = np.hstack([x, x[:, :1], np.ones((60, 1))]) @ weight.T + bias
    assert np.mean(plain.argmax(axis=1) == more.argmax(axis=1)) > 0.95
    labels = np.repeat([0, 1], 3)
    x = np.repeat([[0.0, 1.0], [2.0, 1.0]], 3, axis=0)
    weight, bias = heads.fit_discriminant(x, labels, 2)
    assert (x @ weight.T + bias).argmax(axis=1).tolist() == labels.tolist()


@pytest.mark.parametrize("size", [10, 200])
def test_weights_count_for_means_and_scatter(size: int):
    """0 is as if absent, equal weights change nothing."""
    x, labels = drawn(60, size)
    under = (np.arange(60) % 3)[:, None]
    kept = np.arange(60) % 5 > 0
    for weights, same in ((np.full(60, 3.0), slice(None)), (kept.astype(float), kept)):
        found = heads.fit_discriminant(x, labels, 4, under, weights)
        wanted = heads.fit_discriminant(x[same], labels[same], 4, under[same])
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
    heavy = np.where(kept, 1.0, 1e6)
    found, wanted = (
        heads.fit_discriminant(x, labels, 4, None, weights) for weights in (heavy, 1.0 * ~kept)
    )
    alike = np.corrcoef(found[0].ravel(), wanted[0].ravel())[0, 1]
    assert alike > 0.9
