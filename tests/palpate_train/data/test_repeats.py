"""Sweeps that a set holds twice: copies, windows that share frames, and quiet skins."""

import numpy as np
import pytest

from palpate_train.data import repeats
from palpate_train.data.sets import Dataset


def a_set(samples: np.ndarray, recording: np.ndarray | None = None) -> Dataset:
    """Sweeps of two materials, which take turns."""
    n = len(samples)
    groups = {} if recording is None else {"recording": recording}
    return Dataset(samples, np.arange(n) % 2, ("a", "b"), 100.0, groups, "made up")


def noise(n: int, dtype: str = "int16", frames: int = 64) -> np.ndarray:
    return np.random.default_rng(1).normal(100, 5, (n, frames, 2, 2)).astype(dtype)


def windows(hop: int, dtype: str) -> np.ndarray:
    """Windows of one long recording, one each `hop` frames."""
    (long,) = noise(1, dtype, 640)
    return np.stack([long[start : start + 64] for start in range(0, 577, hop)])


@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32"])
@pytest.mark.parametrize("hop", [16, 32, 50])
def test_windows_that_share_frames_are_found(hop: int, dtype: str):
    """All of them with the number of common frames; not within one recording."""
    sweeps = a_set(windows(hop, dtype))
    found = repeats.pairs(sweeps)
    assert set(found.frames) == {64 - by for by in range(hop, 57, hop)}
    assert set(found.first) | set(found.second) == set(range(len(sweeps)))
    (line,) = repeats.warnings_of(sweeps, found)
    assert f"{len(sweeps)} of {len(sweeps)} sweeps share" in line
    one = a_set(windows(hop, dtype), np.zeros(len(sweeps), int))
    assert not len(repeats.pairs(one).first)
    assert not len(repeats.pairs(a_set(windows(64, dtype))).first)


def test_copies_are_counted_once_a_fold():
    """Under one material and two; three copies are three; test sweeps count once."""
    samples = noise(20)
    samples[7], samples[9] = samples[5], samples[5]
    found = repeats.pairs(a_set(samples))
    (line,) = repeats.warnings_of(a_set(samples), found)
    assert "3 of 20 sweeps" in line
    assert "(sweep 5, b, and " in line
    samples[12] = samples[5]
    (line,) = repeats.warnings_of(a_set(samples), repeats.pairs(a_set(samples)))
    assert "4 of 20" in line
    found = repeats.pairs(a_set(windows(32, "int16")))
    assert found.across(np.arange(0, 10), np.arange(10, 19)).tolist() == [10]
    assert found.across(np.arange(0, 19, 2), np.arange(1, 19, 2)).tolist() == [*range(1, 19, 2)]


@pytest.mark.parametrize("frames", [1, 2, 3, 9, 64])
def test_quiet_skins_do_not_count(frames: int):
    """Sweeps that begin, end or stay at rest differ elsewhere, and short windows give no error."""
    rng = np.random.default_rng(2)
    samples = np.zeros((30, frames, 1, 1), np.uint8)
    samples[:, frames // 2 :] = rng.integers(0, 200, (30, frames - frames // 2, 1, 1))
    found = repeats.pairs(a_set(samples, np.arange(30)))
    assert not (found.frames < frames).any()


def test_a_sketch_knows_its_sweeps():
    """All sweeps of a small set, a random part of a large one; none of another set."""
    small, large = a_set(noise(40)), a_set(noise(repeats.MOST_KEPT * 3, frames=4))
    other = a_set(noise(repeats.MOST_KEPT * 3, "int16", 4)[::-1] + np.int16(1))
    kept = repeats.sketch(small)
    assert repeats.seen(small.take(np.arange(7)), kept) == (7, 7)
    assert repeats.seen(other, repeats.sketch(large))[0] == 0
    known, possible = repeats.seen(large, repeats.sketch(large))
    assert known == possible == repeats.MOST_KEPT
    with pytest.raises(ValueError, match="base64"):
        repeats.seen(small, "***")
