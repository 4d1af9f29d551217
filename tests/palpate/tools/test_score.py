"""Answers are counted against the true materials."""

from __future__ import annotations

import re

import numpy as np

from palpate.client.answers import Answer
from palpate.core.types import Status, Verdict
from palpate.io.robot_link import result
from palpate.sim.rig import Act
from palpate.tools.demo import AnswerScore


def answer(number: int, label: str, status: Status = Status.OK, share: float = 1.0) -> Answer:
    """One that went through its sentence."""
    scores = np.array([0.9, 0.1])
    told = (status, label, 0.9, 0.8, scores, 1, 0, 1_500_000, "9f3c2a1b")
    read = Answer.read(result(Verdict(number, 10**9, *told, share=share), "sim").decode().strip())
    assert read
    return read


def act(label: str) -> Act:
    """A slide of 1500 frames over a tube of this material."""
    return Act(np.zeros((1, 4, 4), np.uint8), 0, 1500, label)


def test_only_ok_with_the_right_label_counts():
    """Unsure is wrong; percentages have intervals."""
    score = AnswerScore(frozenset({"wood", "paper"}))
    right = [
        score.add(act("wood"), answer(1, "wood")),
        score.add(act("paper"), answer(2, "wood")),
        score.add(act("wood"), answer(3, "wood", Status.UNSURE)),
        score.add(act("wood"), answer(4, "wood", share=0.5)),
    ]
    assert right == [True, False, False, True]
    table = "".join(score.table()[1:])
    assert re.findall(r"\d+ / \d+", table) == ["0 / 1", "2 / 3", "2 / 4"]
    assert "[15.0, 85.0]" in table
    assert re.match(r"2\.00 s .*1 of 4", score.touch(750.0))
    assert score.latency().count("1.50 ms") == 2


def test_a_material_that_the_bundle_does_not_know_is_unknown_at_best():
    """Sweeps of such a material are counted apart."""
    score = AnswerScore(frozenset({"wood"}))
    right = [
        score.add(act("cork"), answer(1, "wood")),
        score.add(act("cork"), answer(2, "", Status.UNKNOWN)),
        score.add(act("felt"), answer(3, "", Status.UNSURE)),
        score.add(act("wood"), answer(4, "wood")),
    ]
    assert right == [False, True, False, True]
    assert score.answers == 4
    *counted, apart = score.table()[1:]
    assert re.findall(r"\d+ / \d+", "".join(counted)) == ["1 / 1", "1 / 1"]
    assert "1 of 3" in apart
    assert "cork" in apart
