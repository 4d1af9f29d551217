"""The unloaded skin in the stream: certain only after a touch, and never guessed."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.answer.unloaded import UnloadedSkin, UnloadedTracker
from palpate.core.types import SweepFormat

FORMAT = SweepFormat(4, 4, 100.0, 200, "uint16")


def skin(
    level: float, noise: float, n: int = 200, seed: int = 0, shape: tuple[int, ...] = (4, 4)
) -> np.ndarray:
    """Counts of a skin at one level [n, R, C]."""
    return np.rint(np.random.default_rng(seed).normal(level, noise, (n, *shape))).astype(np.uint16)


def tracked(*parts: np.ndarray, format: SweepFormat = FORMAT, packet: int = 7) -> UnloadedTracker:
    """A tracker that has seen these frames, packet by packet."""
    tracker = UnloadedTracker(format)
    frames = np.concatenate(parts)
    for at in range(0, len(frames), packet):
        tracker.put(frames[at : at + packet])
    return tracker


@pytest.mark.parametrize("first", ["lifted", "touched"])
def test_it_is_the_skin_that_nothing_touches(first):
    """Whether the finger is there at first or not; it is certain once both were seen."""
    lifted, touched = skin(500, 3), skin(800, 40, seed=1)
    found = tracked(
        *((lifted, touched, lifted) if first == "lifted" else (touched, lifted, touched))
    )
    assert found.certain
    assert found.skin.level == pytest.approx(np.full((4, 4), 500), abs=6)
    assert 5 < found.skin.contact < 40


def test_rest_and_shear_are_not_taken_for_a_change():
    """A finger at rest is as quiet, but higher; shear without a load is not a touch."""
    rest, lifted, slide = skin(700, 3), skin(500, 3, seed=2), skin(750, 30, seed=3)
    assert tracked(rest, slide, lifted, rest).skin.level.mean() == pytest.approx(500, abs=3)
    assert tracked(lifted, rest, slide).skin.level.mean() == pytest.approx(500, abs=3)
    frames = skin(500, 3, 400, shape=(4, 4, 3))
    frames[200:, ..., :2] += 400
    format = SweepFormat(4, 4, 100.0, 200, "uint16", 3)
    assert not tracked(frames, format=format).certain
    frames[200:, ..., 2] += 400
    assert tracked(frames, format=format).certain


@pytest.mark.parametrize("noise", [3, 40])
def test_without_a_change_nothing_is_certain(noise):
    """A skin that was never touched, and one that was never let go, look alike."""
    assert not tracked(skin(500, noise, 2000)).certain


def test_a_tare_is_certain_and_stays():
    """A person's tare counts from then on, until another skin comes."""
    tracker = tracked(skin(800, 3))
    tracker.set(skin(600, 3))
    tracker.put(skin(300, 1))
    assert tracker.certain
    assert tracker.skin.level.mean() == pytest.approx(600, abs=2)
    tracker.restart()
    assert (tracker.skin, tracker.certain) == (None, False)


def test_the_threshold_is_above_the_noise_of_sound_taxels():
    """Two whole counts at least; taxels without a number or too noisy do not count."""
    still = np.full((50, 4, 4), 7, np.uint8)
    assert UnloadedSkin.measured(still).contact == 2
    assert UnloadedSkin.measured(still.astype(np.float32)).contact == 0
    frames = skin(500, 3).astype(np.float32)
    whole = UnloadedSkin.measured(frames).contact
    frames[:, 0, 0] = np.nan
    frames[:, 1, 1] *= np.linspace(0, 2, len(frames))
    assert UnloadedSkin.measured(frames).contact == pytest.approx(whole, rel=0.1)
    tracker = tracked(
        frames, skin(800, 40).astype(np.float32), format=SweepFormat(4, 4, 100.0, 200, "float32")
    )
    assert tracker.certain
