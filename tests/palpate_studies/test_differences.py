"""Means and differences of estimates, compared with known intervals."""

import numpy as np
import pytest

from palpate.core.statistics import wilson
from palpate_studies import differences


def test_a_difference_of_two_shares_is_newcombes():
    """His table II: 56 of 70 minus 48 of 80 is .2; method 10 gives .0524 to .3339."""
    one, other = ((right / n, *wilson(right, n)) for right, n in ((56, 70), (48, 80)))
    assert differences.difference(one, other) == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)


def test_the_interval_of_a_difference_holds_what_it_says():
    """At least 93 % of 2,000 random intervals hold the true difference, and not all."""
    rng, inside = np.random.default_rng(0), []
    for one, other in zip(
        rng.binomial(80, 0.9, 2000) / 80, rng.binomial(80, 0.7, 2000) / 80, strict=True
    ):
        estimates = [(float(share), *wilson(80 * share, 80)) for share in (one, other)]
        _, low, high = differences.difference(*estimates)
        inside.append(low <= 0.2 <= high)
    assert 0.93 < np.mean(inside) < 0.97


def test_groups_of_a_mean_err_independently():
    """Four independent intervals halve that of their mean, one group does not."""
    one = (0.8, 0.7, 0.84)
    alone = differences.mean({str(i): [one] for i in range(4)})
    together = differences.mean({"a": [one] * 4})
    assert alone == pytest.approx((0.8, 0.75, 0.82))
    assert together == pytest.approx(one)
    mixed = differences.mean({"a": [(0.9, 0.8, 1.0)] * 2, "b": [(0.6, 0.6, 0.6)]})
    assert mixed == pytest.approx((0.8, 0.8 - 0.2 / 3, 0.8 + 0.2 / 3))


@pytest.mark.parametrize(
    ("gap", "words"),
    [
        ((0.05, 0.01, 0.09), "ahead"),
        ((0.05, -0.01, 0.1), "ahead, not certain"),
        ((0.0, -0.1, 0.1), "level"),
        ((-0.01, -0.1, 0.05), "within a point"),
        ((-0.0101, -0.1, 0.05), "falls short, not certain"),
        ((-0.05, -0.09, -0.01), "falls short"),
    ],
)
def test_a_difference_in_words(gap: tuple[float, float, float], words: str):
    """A difference is not certain if its interval contains 0. A point below is still near."""
    assert differences.verdict(gap) == words
