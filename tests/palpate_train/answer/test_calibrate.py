"""Calibration: the effect of copies with faults, and everything that they must not change."""

import json
from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.early import Early
from palpate.answer.objects import softmax
from palpate.core.status import UNSURE
from palpate_train.answer.calibrate import Calibration, fit_calibration
from palpate_train.answer.fit_contact import AugmentedCopies
from palpate_train.answer.fit_early import EarlyRule
from palpate_train.data.run import Run
from palpate_train.models.recipe import recipe
from palpate_train.models.recipe.fitted import ONE_IN, calibration_inputs
from tests.factories.calibration_inputs import plain_inputs
from tests.factories.sweep_sets import easy


def world(n: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features [N, 10, 4] of three materials at eight places, labels [N], places [N]."""
    labels, places = np.tile(np.repeat(np.arange(3), n), 8), np.repeat(np.arange(8), 3 * n)
    means = 9 * np.eye(3, 4)
    x = (
        means[labels][:, None]
        + np.random.default_rng(1).standard_normal((len(labels), 1, 4))
        + np.zeros((1, 10, 1))
    )
    return x, labels, places


def test_a_disturbed_sweep_of_a_known_material_stays_known():
    """After copies of one in ten with the fault, other such sweeps are known; the rest stays."""
    # The fault: noise in the last feature, in which materials do not differ
    noise = np.array([0.0, 0.0, 0.0, 12.0])
    x, y, at = world()
    known = y < 2
    one = np.arange(known.sum()) % ONE_IN == 0
    factors = np.random.default_rng(2).uniform(-1, 1, (one.sum(), 1, 1))
    more = [np.concatenate([of[known], of[known][one]]) for of in (x, y, at)]
    more[0][known.sum() :] += factors * noise
    faulty = np.arange(len(more[0])) >= known.sum()
    plain = fit_calibration(
        plain_inputs(x[known], y[known], at[known], np.ones(known.sum(), bool), 1)
    )
    sturdy = fit_calibration(plain_inputs(*more, ~faulty, 1, faulty=faulty))
    shaken = x[known][:, -1] + noise / 2
    kept = [
        np.mean(done.embedding.novelty(shaken) <= done.limits.loose) for done in (plain, sturdy)
    ]
    assert kept[0] < 0.3
    assert kept[1] > 0.8
    assert np.mean(sturdy.embedding.novelty(x[~known][:, -1]) <= sturdy.limits.loose) < 0.05
    np.testing.assert_array_equal(
        sturdy.weight * sturdy.temperature, plain.weight * plain.temperature
    )
    assert (sturdy.held["recording"].numbers < known.sum()).all()


@pytest.mark.parametrize("beside", [True, False], ids=["place", "recordings"])
def test_a_condition_that_nothing_carries_over_does_not_make_all_answers_unsure(beside: bool):
    """38 materials that are in other features in each session: what is right elsewhere is sure."""
    rng, labels = np.random.default_rng(4), np.tile(np.arange(38), 18)
    session, place = np.repeat(np.arange(3), 6 * 38), np.repeat(np.arange(18), 38) % 6
    x = 12 * np.eye(114)[38 * session + labels] + rng.standard_normal((len(labels), 114))
    given = plain_inputs(np.repeat(x[:, None], 4, axis=1), labels, session, place < 6)
    hard = {"session": session} | ({"place": place} if beside else {})
    made = fit_calibration(replace(given, conditions=hard, recordings=place))
    assert np.mean(made.held["session"].probabilities.argmax(axis=1) == labels) < UNSURE
    sure = softmax(made.logits(x)).max(axis=1) >= UNSURE
    assert sure.mean() > 0.95


@pytest.mark.slow
def test_disturbed_sweeps_are_of_those_that_were_trained_on():
    """One in ten has a changed copy of its material and group; no copy judges."""
    fit = recipe.fit(easy(16), Run(1), recipe.Settings())
    given = calibration_inputs(fit)
    prefixes, labels, groups = given.prefixes, given.labels, given.groups
    held, faulty = given.held, given.faulty
    assert (
        len(prefixes) == len(labels) == len(groups) == len(fit.train) + len(fit.held) + faulty.sum()
    )
    assert faulty.sum() == -(-len(fit.train) // ONE_IN)
    assert not (held & faulty).any()
    assert not set(groups[faulty]) & set(groups[held])
    assert not any((prefixes[~faulty] == row).all(axis=(1, 2)).any() for row in prefixes[faulty])


@pytest.mark.parametrize("early", [None, Early((0.9,) * 9, 2)], ids=["no-rule", "rule"])
@pytest.mark.parametrize("reattached", [False, True], ids=["no-copies", "copies"])
def test_a_calibration_survives_its_file(early: Early | None, reattached: bool):
    """Arrays and figures, as JSON, give the same calibration, with each rule or without."""
    x, y, at = world()
    given = plain_inputs(x, y, at, at >= 6, 1)
    if reattached:
        copied = AugmentedCopies(x[:, -1], y, np.arange(len(y)), at >= 6)
        given = replace(given, copied=copied)
    made = replace(fit_calibration(given), rule=EarlyRule(early, "why", 0.5, 0.1, 7))
    assert (made.displacement is not None) == reattached
    again = Calibration.of(made.arrays(), json.loads(json.dumps(made.figures())))
    assert again.figures() == made.figures()
    assert again.arrays().keys() == made.arrays().keys()
    for name, values in made.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], values)
