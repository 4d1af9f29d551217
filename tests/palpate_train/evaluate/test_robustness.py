"""Counts under corruptions: joined over seeds, with intervals over attachments."""

import json

import numpy as np
import pytest

from palpate_train.data import corruptions
from palpate_train.data.evaluation_sweeps import EvaluationSweeps
from palpate_train.data.sets import Dataset
from palpate_train.evaluate import robustness


@pytest.mark.parametrize(
    ("accuracy", "fall"),
    [
        ((0.9, 0.9, 0.8, 0.1), 1.5),
        ((0.95, 0.9, 0.95, 0.95), 1.0),  # in floats .95 - .05 is less than .9
        ((0.9, 0.88, 0.88, 0.78), 2.6),
        ((0.9, 0.95, 0.93, 0.86), None),
    ],
)
def test_the_fall_is_between_two_severities(accuracy: tuple[float, ...], fall: float | None):
    """It is interpolated; exactly five points are enough; without a fall it is None."""
    found = robustness.falls({"severities": [0.0, 1.0, 2.0, 4.0], "accuracy": list(accuracy)})
    assert found == (None if fall is None else pytest.approx(fall))


def test_merged_by_hand():
    """Sums, band, fall and loss of two seeds, in any order of completion; a refusal stays."""

    def task(method: str, seed: int, right: list[int]) -> dict:
        """A task written by hand: 20 sweeps under one corruption."""
        curve = {
            "title": "dead taxels",
            "unit": "taxels",
            "about": "",
            "severities": [0.0, 1.0, 2.0],
            "right": right,
            "low": [n / 20 - 0.1 for n in right],
            "high": [n / 20 + 0.05 for n in right],
        }
        about = {"method": method, "seed": seed, "set": "x", "refused": "", "total": 20}
        return about | {"curves": {"dead": curve}, "pairs": {}}

    no = {"method": "c", "seed": 0, "set": "x", "refused": "too short"}
    tasks = [task("a", 0, [18, 16, 10]), task("a", 1, [20, 18, 2]), task("b", 0, [10] * 3), no]
    result = robustness.merge(tasks)
    assert json.dumps(result) == json.dumps(robustness.merge(tasks[::-1]))
    curve = result["methods"]["a"]["curves"]["dead"]
    assert (curve["right"], curve["total"]) == ([38, 34, 12], 40)
    assert curve["accuracy"] == [0.95, 0.85, 0.3]
    assert curve["low"] == [0.85, 0.75, 0.1], "the mean of both intervals, or the worse seed"
    assert curve["high"] == [1.0, 0.9, 0.5], "the mean of both intervals, or the better seed"
    assert curve["falls"] == pytest.approx(0.5)
    assert curve["lost"] == pytest.approx((0.1 + 0.65) / 2)
    assert result["methods"]["b"]["curves"]["dead"]["falls"] is None
    assert (result["methods"]["c"]["refused"], result["methods"]["c"]["curves"]) == (
        "too short",
        {},
    )


def test_what_breaks_first_comes_first_with_its_interval():
    """By the share of its range, then the loss; sweeps of one attachment fail together."""
    found = {
        name: {"lost": lost, "falls": fall, "severities": [0, most]}
        for name, lost, fall, most in (
            ("a", 0.1, 1.0, 4),
            ("b", 0.3, 0.1, 0.2),
            ("c", 0.2, None, 1),
            ("d", 0.2, 0.25, 1),
        )
    }
    assert robustness.breaks_first(found) == ["d", "a", "b"]
    right = np.repeat([True, True, False], 4)
    widths = []
    for groups in ({}, {"position": np.repeat([0, 1, 2], 4)}):
        samples, labels = np.ones((12, 9, 1, 1), np.uint8), np.arange(12) % 2
        sweeps = Dataset(samples, labels, ("smooth", "rough"), 100.0, groups, "small")
        trials = robustness.CorruptionCounts(EvaluationSweeps(sweeps))
        trials.add(corruptions.find(["dead"])[0], [right])
        widths.append(trials.curves["dead"]["high"][0] - trials.curves["dead"]["low"][0])
    assert widths[1] > widths[0] + 0.2
