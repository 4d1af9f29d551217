"""Augmentation: the effect of each parameter, and everything that it must not change."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from palpate_train.data.augment import SLOW, Augmentation, augment, default_augmentation
from tests.factories.later import Later

OFF = Augmentation(**{f.name: 0.0 for f in fields(Augmentation)})
NAMES = tuple(f.name for f in fields(Augmentation) if f.name not in ("shift", "displaced"))


def sweeps(n: int = 16, taxels: int = 16, frames: int = 300, seed: int = 1) -> np.ndarray:
    """White sweeps [n, taxels, frames] of deviation 1, without the mean of each taxel."""
    x = np.random.default_rng(seed).standard_normal((n, taxels, frames), np.float32)
    return x - x.mean(axis=2, keepdims=True)


def varied(x: np.ndarray, rows: int = 4, seed: int = 2, **settings: float) -> np.ndarray:
    """`x` with these settings and no others."""
    return augment(x, rows, replace(OFF, **settings), np.random.default_rng(seed))


def test_nothing_varies_at_zero_and_little_without_vibrations():
    """At 0 nothing is drawn; without kernels of sum zero no damping and less noise."""
    x, rng = sweeps(), np.random.default_rng(3)
    np.testing.assert_array_equal(augment(x, 4, OFF, rng), x)
    assert rng.bit_generator.state == np.random.default_rng(3).bit_generator.state
    assert default_augmentation(zero_sum=True) == Augmentation()
    assert default_augmentation(zero_sum=False) == SLOW != Augmentation()


@pytest.mark.parametrize(
    "settings",
    [
        Augmentation(),
        replace(OFF, shift=1.0, displaced=0.5),
        *(replace(OFF, **{k: 0.5}) for k in NAMES),
    ],
)
def test_every_parameter_changes_sweeps_each_otherwise_and_leaves_its_input(settings: Augmentation):
    """The same generator gives the same bits, another gives others; the input stays."""
    x = np.repeat(sweeps(1), 12, axis=0)
    before = x.copy()
    once, again, other = (
        augment(x, 4, settings, np.random.default_rng(seed)) for seed in (4, 4, 5)
    )
    assert once.shape == x.shape
    assert once.dtype == np.float32
    assert np.isfinite(once).all()
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once, other)
    np.testing.assert_array_equal(x, before)
    assert len({sweep.tobytes() for sweep in once}) > 1


@pytest.mark.slow
def test_a_shift_reads_between_rows_and_fills_the_edge():
    """Each row is a mixture of two neighbours, with the same shares in all rows."""
    x = sweeps(200, frames=50)
    now = varied(x, shift=1.0, displaced=0.5).reshape(200, 4, 200)
    mixtures = now @ np.linalg.pinv(x.reshape(200, 4, 200))
    by = (mixtures[:, 1] * np.arange(4)).sum(axis=1) - 1  # how far the second row was moved
    assert 0.4 < (np.abs(by) < 1e-4).mean() < 0.6
    assert -1 <= by.min() < -0.8
    assert 0.8 < by.max() <= 1
    for mixture, d in zip(mixtures, by, strict=True):
        whole = [np.maximum(1 - np.abs(np.arange(4) - i - d), 0) for i in range(4)]
        seen = [i for i in range(4) if -1e-4 <= i + d <= 3 + 1e-4]
        assert all(np.allclose(mixture[i], whole[i], atol=1e-3) for i in seen)
        for i in set(range(4)) - set(seen):
            edge = 0 if d < 0 else 3
            assert 0 <= mixture[i, edge] <= 1
            assert np.abs(mixture[i]).sum() - mixture[i, edge] < 1e-3


@pytest.mark.parametrize("rows", [1, 16])
def test_a_line_of_taxels_is_not_moved(rows: int):
    """With one row, or one taxel a row, the distance along the slide is unknown."""
    x = sweeps()
    np.testing.assert_array_equal(varied(x, rows, shift=1.0, displaced=1.0), x)


def test_gains_spread_as_much_as_asked():
    """`gain` of all taxels, `gains` of each."""
    x = sweeps(400, frames=20)
    for name, taxels in (("gain", 1), ("gains", 16)):
        ratio = varied(x, **{name: 0.3}) / x
        np.testing.assert_allclose(ratio, np.broadcast_to(ratio[..., :1], ratio.shape), rtol=1e-3)
        assert (ratio > 0).all()
        log = np.log(ratio[..., 0])
        assert log.std() == pytest.approx(0.3, rel=0.15)
        assert abs(log.mean()) < 0.05
        assert (log.std(axis=1).max() < 1e-3) == (taxels == 1)


def test_a_share_of_the_taxels_is_silent_or_noisy():
    """About the wanted one; up to four deviations of noise, the others as they were."""
    x = sweeps(200, frames=20)
    now = varied(x, silent=0.2)
    dead = (now == 0).all(axis=2)
    assert 0.17 < dead.mean() < 0.23
    np.testing.assert_array_equal(now[~dead], x[~dead])
    level = varied(np.zeros((200, 16, 300), np.float32), noisy=0.1).std(axis=2)
    assert 0.07 < (level > 0).mean() < 0.13
    assert 3 < level.max() < 4.5
    assert not (level > 0).all(axis=1).any()


@pytest.mark.slow
def test_damping_takes_high_rates_and_colour_any():
    """Damping lowers the highest rates, never the lowest; colour raises some bands."""

    def band(x: np.ndarray, low: float, high: float) -> np.ndarray:
        """Mean power [B] between two shares of half the sampling rate."""
        power = (np.abs(np.fft.rfft(x)) ** 2).mean(axis=1)
        return power[:, int(low * power.shape[1]) : int(high * power.shape[1])].mean(axis=1)

    x = sweeps(200, frames=512)
    damped = varied(x, damped=0.5)
    high, low = (band(damped, *edges) / band(x, *edges) for edges in ((0.8, 1), (0.002, 0.008)))
    assert 0.4 < (high < 0.9).mean() < 0.6
    assert high.max() < 1.001
    assert low.min() > 0.9
    assert high.min() < 0.01
    coloured = varied(x, colour=0.3)
    log_high, log_low = (
        0.5 * np.log(band(coloured, *e) / band(x, *e)) for e in ((0.9, 1), (0.1, 0.15))
    )
    assert 0.2 < log_high.std() < 0.35
    assert (log_high > 0.1).any()
    assert np.corrcoef(log_high, log_low)[0, 1] < 0.3


def test_noise_is_white_and_of_another_level_in_every_sweep():
    """Its level, equal for all taxels, lies between almost nothing and the maximum."""
    stats = Later("scipy.stats")
    added = varied(np.zeros((100, 16, 2000), np.float32), noise=0.5)
    level = added.std(axis=2)
    assert level.max() < 0.53
    assert level.mean(axis=1).min() < 0.02
    assert level.mean(axis=1).max() > 0.4
    assert np.median(level) < 0.2  # drawn squared: of even draws half would lie above .25
    assert (level.std(axis=1) < 0.05 * level.mean(axis=1)).all()
    loud = added[level.mean(axis=1).argmax()]
    assert np.abs(np.corrcoef(loud) - np.eye(16)).max() < 0.15
    assert abs((loud[:, 1:] * loud[:, :-1]).mean()) < 0.05 * (loud**2).mean()
    assert stats.kurtosis(loud, axis=None) == pytest.approx(0, abs=0.15)


def test_drift_is_a_line():
    """Its ends have the wanted spread."""
    line = varied(np.zeros((100, 16, 301), np.float32), drift=0.5)
    assert line[..., -1].std() == pytest.approx(0.5, rel=0.1)
    assert np.abs(np.diff(line, n=2)).max() < 1e-5
    assert np.abs(line[..., 150]).max() < 1e-5


def test_hum_is_one_sine_on_all_taxels():
    """A quarter of the sweeps have it, with any frequency and an amplitude up to the maximum."""
    hum = varied(np.zeros((400, 4, 500), np.float32), 2, hum=2.0)
    np.testing.assert_array_equal(hum, np.broadcast_to(hum[:, :1], hum.shape))
    assert np.abs(hum).max() <= 2
    loud = np.abs(hum).max(axis=(1, 2)) > 0
    assert 0.18 < loud.mean() < 0.32
    spectrum = np.abs(np.fft.rfft(hum[loud, 0] * np.hanning(500))) ** 2
    peak = spectrum.argmax(axis=1)
    assert peak.min() < 30
    assert peak.max() > 220
    assert all(
        s[max(p - 3, 0) : p + 4].sum() > 0.99 * s.sum() for s, p in zip(spectrum, peak, strict=True)
    )


@pytest.mark.parametrize(
    ("rows", "taxels", "frames"),
    [(1, 1, 1), (1, 1, 2), (3, 9, 20), (16, 16, 128), (1, 5, 33), (2, 6, 3000), (6, 12, 21)],
)
def test_any_grid_and_length_of_silence_is_finite(rows: int, taxels: int, frames: int):
    """One taxel, one frame, odd lengths, every parameter on: finite, and of the same shape."""
    everything = replace(Augmentation(), **dict.fromkeys(NAMES, 0.5))
    x = np.zeros((5, taxels, frames), np.float32)
    now = augment(x, rows, everything, np.random.default_rng(7))
    assert now.shape == x.shape
    assert now.dtype == np.float32
    assert np.isfinite(now).all()


def test_copies_that_judge_are_moved_and_nothing_else():
    """Position, contact and gains of the skin change; noise and failures of the sensor are off."""
    usual = Augmentation(noisy=0.1, drift=0.2, hum=0.3)
    judging = usual.without_faults()
    for name in ("noise", "noisy", "silent", "drift", "hum"):
        assert getattr(judging, name) == 0
    for name in ("shift", "damped", "gains"):
        assert getattr(judging, name) == getattr(usual, name)
