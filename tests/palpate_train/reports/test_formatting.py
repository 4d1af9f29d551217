"""Numbers as people read them."""

from typing import Any

import pytest

from palpate_train.reports import formatting as f


@pytest.mark.parametrize(
    ("made", "shown"),
    [
        (f.percent(0.973), "97.3 %"),
        (f.percent(1, 0), "100 %"),
        (f.exact_percent(0.86), "86 %"),
        (f.exact_percent(0.923), "92.3 %"),
        (f.estimate([0.864, 0.81, 0.9031]), "86.4 % [81.0, 90.3]"),
        (f.interval((0.81, 0.903), 0), "81 – 90 %"),
        (f.points(-0.0041), "−0.4"),
        (f.points(0.023, sign=True), "+2.3"),
        (f.points(-0.0001), "0.0"),
        (f.amount(0.4009, "ms"), "0.401 ms"),
        (f.amount(104.17, "ms"), "104 ms"),
        (f.amount(15918.3, "KB"), "15.9 MB"),
        (f.amount(1234567.0), "1,230,000"),
        (f.seconds(0.2468), "0.25 s"),
        (f.seconds(720), "12 min"),
    ],
)
def test_numbers_are_written_for_people(made: Any, shown: str):
    """Percentages have a sign, differences are in points, durations have a suitable unit."""
    assert made == shown
