"""Temperature scaling on logits whose true temperature is known."""

import numpy as np
import pytest

from palpate.answer.objects import softmax
from palpate_train.metrics.temperature import (
    platt_temperature,
    sufficient_temperature,
    weighted_platt_temperature,
)


def drawn(n: int, groups: int, seed: int = 0, scale: float = 2.0):
    """Calibrated logits [n, 3], labels drawn from their softmax, groups."""
    rng = np.random.default_rng(seed)
    logits = scale * rng.standard_normal((n, 3))
    labels = (softmax(logits).cumsum(axis=1) < rng.random((n, 1))).sum(axis=1)
    return logits, labels, np.arange(n) % groups


@pytest.mark.parametrize("times", [3.0, 6.0])
def test_a_head_that_is_too_sure_is_cooled(times: float):
    """Logits times `times` give that factor, or within an error below it."""
    logits, labels, groups = drawn(3000, 30)
    found = sufficient_temperature(times * logits, labels, groups)
    assert 0.8 * times < found < 1.05 * times


def test_evidence_is_needed_to_cool_a_head():
    """Without any the temperature is 1; a single group has the spread of its sweeps."""
    temperatures = [sufficient_temperature(*drawn(300, 10, seed)) for seed in range(20)]
    assert np.mean(np.array(temperatures) == 1) > 0.8
    assert max(temperatures) < 1.3
    labels = np.arange(60) % 3
    assert sufficient_temperature(100 * np.eye(3)[labels], labels, np.arange(60) % 6) == 1
    logits, labels, groups = drawn(1000, 1)
    assert sufficient_temperature(4 * logits, labels, groups) == sufficient_temperature(
        4 * logits, labels, np.arange(1000)
    )


@pytest.mark.parametrize("classes", [3, 38])
def test_a_head_that_is_less_sure_than_right_is_warmed(classes: int):
    """Logits too small by three; and gross errors, which cost more the more materials there are."""
    rng, labels = np.random.default_rng(1), np.arange(380) % classes
    logits = 3 * np.eye(classes)[labels] + rng.standard_normal((380, classes))
    right = np.mean(logits.argmax(axis=1) == labels)
    found = sufficient_temperature(logits / 3, labels, labels)
    assert found < 0.5
    assert softmax(logits / 3 / found).max(axis=1).mean() == pytest.approx(right, abs=0.05)
    logits[::4] = 30 * np.eye(classes)[(labels[::4] + 1) % classes]
    right = np.mean(logits.argmax(axis=1) == labels)
    found = sufficient_temperature(logits, labels, np.arange(380) // 4)
    assert softmax(logits / found).max(axis=1).mean() > right - 0.05


def test_one_wrong_sweep_or_group_asks_for_little():
    """One of 300 wrong by 1: about half; evidence of one group of thirty does not count."""
    labels = np.arange(300) % 3
    logits = 30 * np.eye(3)[labels]
    logits[0] = [0, 1, 0]
    assert sufficient_temperature(logits, labels, np.arange(300) % 10) < 0.6 * platt_temperature(
        logits, labels
    )
    labels = np.zeros(300, int)
    logits = np.tile([6.0, 0.0], (300, 1))
    logits[:10] = [0.0, 6.0]
    together, apart = np.repeat(np.arange(30), 10), np.arange(300) % 30
    apart_temperature = sufficient_temperature(logits, labels, apart)
    assert sufficient_temperature(logits, labels, together) < apart_temperature
    assert apart_temperature > 1.2


@pytest.mark.parametrize(("scale", "low", "high"), [(3.0, 2.5, 3.5), (0.2, 0.1, 0.3)])
def test_a_weighted_temperature_is_found_above_and_below_one(scale: float, low: float, high: float):
    """Calibrated logits times a factor give about that factor."""
    logits, labels, _ = drawn(3000, 30)
    found = weighted_platt_temperature(scale * logits, labels, np.full(3000, 1 / 3000))
    assert low < found < high


def test_logits_that_no_temperature_cools_get_the_highest():
    """All temperatures cost the same there: the answer is as unsure as it can be."""
    labels = np.arange(60) % 3
    found = weighted_platt_temperature(1e7 * np.eye(3)[labels], labels, np.full(60, 1 / 60))
    assert found > 50
