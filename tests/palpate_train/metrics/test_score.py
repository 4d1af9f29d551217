"""Counting: intervals and fused windows."""

import numpy as np
import pytest

from palpate.answer.objects import softmax
from palpate_train.metrics.score import fuse, interval, score_entry


def test_a_score_counts_with_the_papers_interval():
    """Plain numbers; 55 of 60 is [.819, .964], the paper's T-HARD."""
    assert score_entry(np.array([True, False, True])) == {"right": 2, "total": 3}
    assert interval(np.arange(60) < 55) == pytest.approx((0.819, 0.964), abs=5e-4)


def test_intervals_widen_with_groups_and_cover_the_truth():
    """Two of ten positions wrong; of 200 experiments about 19 in 20."""
    position = np.repeat(np.arange(10), 50)
    right = position >= 2
    low, high = interval(right, position)
    pool_low, pool_high = interval(right)
    assert low < pool_low - 0.1
    assert high > pool_high + 0.05
    assert interval(np.ones(90, bool), np.repeat(np.arange(9), 10)) == interval(np.ones(90, bool))
    rng, held = np.random.default_rng(1), 0
    for _ in range(200):
        p = rng.beta(8, 2, 12)
        right = rng.random((12, 30)) < p[:, None]
        low, high = interval(right.ravel(), np.repeat(np.arange(12), 30))
        held += low <= 0.8 <= high
    assert 176 <= held <= 200


def test_windows_of_a_recording_are_fused_as_a_product():
    """In the order of numbers; a probability of 0 in float does not outweigh the others."""
    logits = np.array([[1.0, 0.0], [0.0, 3.0], [2.0, 0.0]], np.float32)
    scores, first = fuse(logits, np.array([7, 3, 7]))
    assert first.tolist() == [1, 0]
    assert scores[1] == pytest.approx(np.log(softmax(logits[0])) + np.log(softmax(logits[2])))
    assert scores.argmax(1).tolist() == [1, 0]
    scores, _ = fuse(np.array([[1e4, 0.0]] + [[0.0, 9.0]] * 5, np.float32), np.zeros(6, int))
    assert np.isfinite(scores).all()
    assert scores.argmax() == 1
