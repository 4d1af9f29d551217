"""Temperature scaling on logits whose true temperature is known."""

import numpy as np
import pytest

from appliance.inference.classifier import softmax
from train.metrics.temperature import platt_temperature, sufficient_temperature


def drawn(n: int, groups: int, seed: int = 0, scale: float = 2.0):
    """Calibrated logits [n, 3], labels drawn from their softmax, groups."""
    rng = np.random.default_rng(seed)
    logits = scale * rng.standard_normal((n, 3))
    labels = (softmax(logits).cumsum(axis=1) < rng.random((n, 1))).sum(axis=1)
    return logits, labels, np.arange(n) % groups


@pytest.mark.parametrize("times", [3.0, 6.0])
def test_a_head_that_is_too_sure_is_cooled(times: float):
    """Calibrated logits times `times`: that temperature, or one within an error of it, and never a
    higher one."""
    logits, labels, groups = drawn(3000, 30)
    found = sufficient_temperature(times * logits, labels, groups)
    assert 0.8 * times < found < 1.05 * times


def test_a_calibrated_head_stays_as_it_is():
    """Where nothing shows that the head is too sure, the temperature is 1: so too where all sweeps
    are right by far."""
    temperatures = [sufficient_temperature(*drawn(300, 10, seed)) for seed in range(20)]
    assert np.mean(np.array(temperatures) == 1) > 0.8
    assert max(temperatures) < 1.3
    labels = np.arange(60) % 3
    assert sufficient_temperature(100 * np.eye(3)[labels], labels, np.arange(60) % 6) == 1


def test_sweeps_that_are_right_by_far_do_not_ask_for_a_temperature():
    """Of 300 with a margin of 30 one is wrong, by a margin of 1: a little over half the temperature
    that Platt's correction gives."""
    labels = np.arange(300) % 3
    logits = 30 * np.eye(3)[labels]
    logits[0] = [0, 1, 0]
    assert sufficient_temperature(logits, labels, np.arange(300) % 10) < 0.6 * platt_temperature(
        logits, labels
    )


def test_sweeps_that_fail_together_count_as_one():
    """All that speaks for a temperature comes from one group of thirty: no evidence. The same from
    every group is some."""
    labels = np.zeros(300, int)
    logits = np.tile([6.0, 0.0], (300, 1))
    logits[:10] = [0.0, 6.0]
    together, apart = np.repeat(np.arange(30), 10), np.arange(300) % 30
    apart_temperature = sufficient_temperature(logits, labels, apart)
    assert sufficient_temperature(logits, labels, together) < apart_temperature
    assert apart_temperature > 1.2


def test_with_one_group_each_sweep_is_its_own():
    """One group has no spread between groups; the sweeps' own is taken."""
    logits, labels, groups = drawn(1000, 1)
    assert sufficient_temperature(4 * logits, labels, groups) == sufficient_temperature(
        4 * logits, labels, np.arange(1000)
    )
