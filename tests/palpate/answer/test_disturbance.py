"""Noise and load of a sweep, and the allowances of a bundle."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.disturbance import SAID, Allowance, Disturbances, load, noise

SLOWER = Allowance("speed", 2.0, 1.5, 4.0)
LOST = Allowance("lost", 0.0, 0.2, 2.0)


def test_noise_is_that_of_the_median_taxel():
    """Slow vibrations and a few noisy taxels do not count."""
    rng, times = np.random.default_rng(0), np.arange(1500)[:, None, None]
    quiet = rng.standard_normal((1500, 4, 4))
    assert noise(quiet) == pytest.approx(0, abs=0.1)
    assert noise(3 * quiet) == pytest.approx(2 * math.log(3), abs=0.1)
    slow = 20 * np.sin(2 * np.pi * 0.02 * times)
    assert noise(quiet + slow) == pytest.approx(0, abs=0.1)
    quiet[:, 0] *= 50
    assert noise(quiet) == pytest.approx(0, abs=0.2)


@pytest.mark.filterwarnings("error")
def test_windows_without_noise_have_the_least():
    """Constant counts, three frames, and counts that are not finite."""
    constant = np.ones((20, 2, 2), np.float32)
    least = noise(constant)
    assert least < -60
    assert noise(constant[:3]) == -math.inf
    constant[5] = np.inf
    assert noise(constant) == least


def test_load_is_the_sum_above_the_tare():
    """In either direction; of several axes only the normal one."""
    tare = np.full((2, 2), 10.0)
    assert load(tare + 5, tare) == pytest.approx(math.log(20))
    assert load(tare - 5, tare) == pytest.approx(math.log(20))
    three = np.stack([tare, tare, tare + 5], axis=-1)
    assert load(three, np.stack([tare] * 3, axis=-1)) == pytest.approx(math.log(20))
    assert math.isnan(load(np.full((2, 2), np.inf), tare))


@pytest.mark.parametrize(
    ("value", "size"), [(2.5, 0), (2.0, 0), (1.8, 0.2), (1.5, 0.5), (1.0, 0.5), (math.nan, 0)]
)
def test_a_size_counts_from_the_edge_of_training(value, size):
    """Up to the furthest value that was tried; an unknown value has none."""
    assert SLOWER.size(value) == pytest.approx(size)


def test_what_was_not_tried_is_said():
    """Also several at once; not for values that are not known."""
    allowed = Disturbances((SLOWER, LOST))
    assert allowed.untried({"speed": 1.6, "lost": 0.2}) == []
    assert allowed.untried({"speed": math.nan}) == []
    both = allowed.untried({"speed": 1.4, "lost": 0.3})
    assert both == ["a slower slide", "more lost frames"]


@pytest.mark.parametrize("name", SAID)
def test_each_disturbance_is_said_in_its_direction(name):
    """More and less of it, and neither up to what was tried."""
    more, less = Allowance(name, 0.0, 1.0, 1.0), Allowance(name, 0.0, -1.0, 1.0)
    assert (more.untried(1.0), less.untried(-1.0)) == (False, False)
    assert (more.untried(1.1), less.untried(-1.1)) == (True, True)
    assert (str(less), str(more)) == SAID[name]


def test_between_proven_and_tried_the_limit_alone_decides():
    """It grows no further, and the sweep is not refused for its speed."""
    further = Disturbances((replace(SLOWER, tried=1.2),))
    for speed in (1.5, 1.3):
        assert further.growth(further.sizes({"speed": speed})) == pytest.approx(3)
        assert further.untried({"speed": speed}) == []
    assert further.untried({"speed": 1.1}) == ["a slower slide"]


def test_the_limit_grows_by_the_disturbance_that_allows_most():
    """Two at once do not add up."""
    allowed = Disturbances((SLOWER, LOST))
    sizes = allowed.sizes({"speed": 1.8, "lost": 0.2})
    assert allowed.growth(sizes) == pytest.approx(1.8)
    assert Disturbances().growth(Disturbances().sizes({})) == 1
