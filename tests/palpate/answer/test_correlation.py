"""What moves like noise is told from a slide."""

import numpy as np
import pytest

from palpate.answer.correlation import Correlations, correlations

TIME = np.arange(200)[:, None, None]


def slide(shift: float = 0.0) -> np.ndarray:
    """Counts [200, 2, 2] of a wave that all taxels have, each a little later."""
    return 50 * np.sin(TIME / 7 + 0.1 * np.arange(4).reshape(2, 2) + shift) + 200


def test_frames_and_taxels_of_a_slide_are_alike_and_those_of_noise_are_not():
    """In each half, whatever the gain, the offset, a trend, and taxels that stand still."""
    noise = np.random.default_rng(0).normal(200, 50, (200, 2, 2))
    apart = slide()
    apart.reshape(200, 4)[:, :] = np.sin(TIME[:, 0] / np.array([3.0, 5.0, 7.0, 11.0]))
    stops, still = slide(), slide()
    stops[100:] = noise[100:]
    still[:, 0, 0] = 7
    for window, frames, taxels in (
        (slide(), 0.98, 0.95),
        (1000 * slide() + 5e6, 0.98, 0.95),
        (still, 0.98, 0.95),
        (noise, 0.0, 0.0),
        (noise + 10 * TIME, 0.0, 1.0),
        (stops, 0.0, 0.35),
        (apart, 0.97, 0.0),
        (slide()[:14], 1, 1),
        (slide()[:, :1, :1], 0.98, 1),
        (np.full((200, 2, 2), 9), 1, 1),
    ):
        assert correlations(window) == pytest.approx((frames, taxels), abs=0.12)
    sheared = np.stack([noise, slide()], axis=-1)  # the normal axis is the last
    assert correlations(sheared) == correlations(slide())


def test_each_limit_refuses_alone():
    """A limit of -1 refuses nothing."""
    assert Correlations().within((-1.0, -1.0))
    assert Correlations(0.1, 0.2).within((0.1, 0.2))
    assert not Correlations(0.1, 0.2).within((0.05, 1.0))
    assert not Correlations(0.1, 0.2).within((1.0, 0.1))
