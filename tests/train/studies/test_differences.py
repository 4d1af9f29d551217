"""Means and differences of estimates, against intervals that are known."""

from __future__ import annotations

import numpy as np
import pytest

from appliance.core.statistics import wilson
from train.studies import differences


def test_a_difference_of_two_shares_is_newcombes():
    """The first example of his table II: 56 of 70 less 48 of 80 is .2, by method 10 from .0524 to
    .3339."""
    one, other = ((right / n, *wilson(right, n)) for right, n in ((56, 70), (48, 80)))
    assert differences.difference(one, other) == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)


def test_the_interval_of_a_difference_holds_what_it_says():
    """For two shares drawn 2,000 times, at least 93 % of the intervals hold the true difference,
    and not all."""
    rng, inside = np.random.default_rng(0), []
    for one, other in zip(
        rng.binomial(80, 0.9, 2000) / 80, rng.binomial(80, 0.7, 2000) / 80, strict=True
    ):
        estimates = [(float(share), *wilson(80 * share, 80)) for share in (one, other)]
        _, low, high = differences.difference(*estimates)
        inside.append(low <= 0.2 <= high)
    assert 0.93 < np.mean(inside) < 0.97


def test_groups_of_a_mean_err_independently():
    """Four equal intervals: alone half as wide, as one group as wide as each; the ends keep their
    sides."""
    one = (0.8, 0.7, 0.84)
    alone = differences.mean({str(i): [one] for i in range(4)})
    together = differences.mean({"a": [one] * 4})
    assert alone == pytest.approx((0.8, 0.75, 0.82))
    assert together == pytest.approx(one)
    mixed = differences.mean({"a": [(0.9, 0.8, 1.0)] * 2, "b": [(0.6, 0.6, 0.6)]})
    assert mixed == pytest.approx((0.8, 0.8 - 0.2 / 3, 0.8 + 0.2 / 3))


def test_an_entry_of_results_is_an_estimate():
    """There and back."""
    entry = {"mean": 0.8, "low": 0.7, "high": 0.9}
    assert differences.entry(differences.of(entry | {"n": 3})) == entry


def test_of_nothing_there_is_no_mean():
    """An error instead of a number."""
    with pytest.raises(ZeroDivisionError):
        differences.mean({})
