"""The campaign that compares the printed accuracy with the answers of the box."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_train.data.sets import Dataset
from tests.campaigns import promises
from tests.factories.sweep_sets import easy


@pytest.mark.slow
def test_easy_sweeps_keep_the_promise():
    """Materials that no condition changes: word, label and answers agree, for each value."""
    found = list(promises.promises(easy(24), "speed", 0, 1))
    assert len(found) == 4
    for one in found:
        assert sum(one.outcomes.values()) == pytest.approx(100)
        assert one.network > 95
        assert one.of_this == pytest.approx(one.rightly, abs=12)
        assert one.expected == pytest.approx(one.rightly, abs=12)
    assert promises.summary(found).startswith("as the box answers ")


def test_values_at_even_distances_are_tried(monkeypatch: pytest.MonkeyPatch):
    """Of four speeds the first and the last where two are asked for, all where more are."""
    left_out: list[set[int]] = []

    def noted(train: Dataset, test: Dataset, *_: object) -> None:
        left_out.append({*test.group("speed").tolist()})
        assert left_out[-1].isdisjoint(train.group("speed").tolist())

    monkeypatch.setattr(promises, "promise", noted)
    sweeps = easy(24)
    speeds = np.unique(sweeps.group("speed")).tolist()
    assert len([*promises.promises(sweeps, "speed", 0, 1, 2)]) == 2
    assert left_out == [{speeds[0]}, {speeds[-1]}]
    assert len([*promises.promises(sweeps, "speed", 0, 1, 9)]) == len(speeds)


def test_a_condition_of_two_values_has_no_figure_of_its_own():
    """Then only the mean of the other conditions is compared."""
    one = promises.Promise(90.0, np.nan, 85.0, {"right": 80.0})
    assert promises.summary([one]) == (
        "as the box answers 80.0 %, label alone 85.0 %; "
        "mean of conditions said 90.0 %: +10.0 on the mean, +10.0 at most"
    )


def test_without_real_sweeps_a_case_is_left_out(monkeypatch: pytest.MonkeyPatch):
    """The simulated ones run everywhere."""
    monkeypatch.delenv("PALPATE_DATA", raising=False)
    assert promises.load("7 fabrics") is None
