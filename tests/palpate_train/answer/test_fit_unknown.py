"""The scatter of altered copies widens the shapes of materials where it does no harm."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray

from palpate.answer.unknown import shaped_distances
from palpate_train.answer.embedding import Embedding
from palpate_train.answer.fit_unknown import DisturbedSweeps, Scatters, choose

MEANS = np.array([[0.0, 0, 0, 0], [12, 0, 0, 0], [0, 12, 0, 0]])
"""Means of three materials, which differ in two of four directions."""
EMBEDDING = Embedding(np.eye(4)[:, :2], np.eye(4), np.zeros(4), MEANS, np.empty((3, 0, 0)))
"""The last two directions are features that were not trained."""
HUM, LIKE_ANOTHER = np.array([0.0, 0, 8, 0]), np.array([-6.0, 6, 0, 0])


def sweeps(rng: Generator, each: int = 60, **moves: NDArray[np.float64]) -> DisturbedSweeps:
    """Sweeps of covariance 1 and copies of all, moved by up to each of `moves`."""
    labels = np.repeat(np.arange(3), each)
    z = MEANS[labels] + rng.standard_normal((3 * each, 4))
    source = np.arange(len(z))
    copies = {name: (z + rng.random((len(z), 1)) * move, source) for name, move in moves.items()}
    return DisturbedSweeps(z, labels, copies)


@pytest.fixture
def rng() -> Generator:
    return np.random.default_rng(0)


def test_copies_are_kept_in_the_direction_of_their_change(rng: Generator):
    """Held-out copies are within the limit; unknown materials elsewhere are as far as before."""
    scatters = Scatters.of(sweeps(rng, hum=HUM), EMBEDDING)
    rule = choose(scatters, sweeps(rng, hum=HUM))
    assert rule
    before, after = rule.kept["hum"]
    assert before < 0.7
    assert after > 0.95
    assert rule.passed[1] <= rule.passed[0] + 0.01
    shapes = rule.shapes(scatters).astype(np.float64)
    unknown = MEANS[0] + [0, 0, 0, 8]
    assert shaped_distances(unknown - MEANS, shapes).min() > 1.5 * rule.limit


def test_an_alteration_that_looks_like_another_material_gets_less_weight(rng: Generator):
    """With a large weight for it, sweeps of a material that is left out would pass."""
    moves = {"hum": HUM, "other": LIKE_ANOTHER}
    rule = choose(Scatters.of(sweeps(rng, **moves), EMBEDDING), sweeps(rng, **moves))
    assert rule
    assert rule.passed[1] < 0.05
    assert rule.weights["other"] < rule.weights["hum"] or rule.weights["other"] <= 1


def test_shapes_keep_distances_and_are_shared(rng: Generator):
    """At r on average, as without a shape; without copies the scatter of the others."""
    scatters, judged = Scatters.of(sweeps(rng, hum=HUM), EMBEDDING), sweeps(rng, hum=HUM)
    rule = choose(scatters, judged)
    assert rule
    shapes = rule.shapes(scatters).astype(np.float64)
    distances = shaped_distances(judged.z[:, None] - MEANS, shapes)
    own = distances[np.arange(len(judged.z)), judged.labels]
    assert own.mean() == pytest.approx(4, rel=0.01)
    assert np.mean(own <= rule.limit) == pytest.approx(0.99, abs=0.011)
    given = sweeps(rng, hum=HUM)
    z, source = given.copies["hum"]
    few = given.labels[source] != 2
    found = Scatters.of(replace(given, copies={"hum": (z[few], source[few])}), EMBEDDING)
    assert np.isfinite(found.by_kind["hum"]).all()
    assert found.by_kind["hum"][2][2, 2] > 10


def test_few_sweeps_give_no_rule_and_no_change_no_weight(rng: Generator):
    """Seven sweeps of each or no copies; copies that change nothing are kept anyway."""
    scatters = Scatters.of(sweeps(rng, hum=HUM), EMBEDDING)
    assert choose(scatters, sweeps(rng, 7, hum=HUM)) is None
    assert choose(scatters, replace(sweeps(rng), copies={})) is None
    still = np.zeros(4)
    rule = choose(Scatters.of(sweeps(rng, still=still), EMBEDDING), sweeps(rng, still=still))
    assert rule
    assert rule.kept["still"][1] == pytest.approx(0.99, abs=0.015)


def test_what_shows_an_unknown_material_counts_more(rng: Generator):
    """Trained directions and untrained features; each where none is known as untrained."""
    far = np.array([[0.0, 0, 0, 0], [12, 0, 9, 0], [0, 12, 0, 9]])

    def weight(means: NDArray[np.float64]) -> float:
        given = sweeps(rng, 200, hum=HUM)
        moved = replace(given, z=given.z + (means - MEANS)[given.labels])
        return Scatters.of(moved, replace(EMBEDDING, means=means)).weight_of_trained(moved)

    assert weight(MEANS) > weight(far)
    all_trained = replace(EMBEDDING, directions=np.eye(4))
    scatters = Scatters.of(sweeps(rng, hum=HUM), all_trained)
    rule = choose(scatters, sweeps(rng, hum=HUM))
    assert rule
    for direction in np.eye(4)[[0, 1, 3]]:
        away = MEANS[0] - 9 * direction - MEANS
        assert shaped_distances(away, rule.shapes(scatters).astype(float)).min() > rule.limit
