"""The features of prior work against scipy and formulas, and exploration."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.answer import features
from palpate.core.errors import FormatError
from palpate_studies.peers.prior_features import correlation, spectrogram, static
from tests.factories.any_counts import any_counts
from tests.factories.later import Later

stats = Later("scipy.stats")

prior_work = Later("palpate_studies.peers.prior_work")

FEATURES = (static, spectrogram, correlation)
RATE = 750.0


def noise(frames: int = 300, rows: int = 2, cols: int = 3) -> np.ndarray:
    """Taxels that share a part of their noise, float32, each with another mean."""
    rng = np.random.default_rng(4)
    x = rng.normal(0, 5, (frames, rows, cols)) + rng.normal(0, 4, (frames, 1, 1))
    x += rng.uniform(20, 90, (rows, cols))
    return x.astype(np.float32)


def test_static_features_are_what_they_say():
    """Two frames of 1x2 taxels by hand: means, deviations, pressure, centre and area."""
    x = np.array([[[10, 0]], [[30, 2]]], np.uint8)
    centre = (-0.5 * 20 + 0.5 * 1) / 21
    want = [20, 1, 10, 1, 10.5, 5.5, 5, 16, 0, centre, 0.5]
    np.testing.assert_allclose(static(x, RATE), want)


def test_a_spectrogram_is_its_formula():
    """One part: Hann window, Fourier sum without DC, band mean, taxels by eq. 4, logarithm."""
    x = noise(1500)
    part = x.reshape(1500, -1).T.astype(float)[:, 300:600]
    n = np.arange(300)
    shaped = (part - part.mean(1, keepdims=True)) * np.sin(np.pi * (n + 0.5) / 300) ** 2
    bins = np.array(
        [np.abs(shaped @ np.exp(-2j * np.pi * q * n / 300)) ** 2 / 300 for q in range(1, 151)]
    )
    want = np.log(
        bins.reshape(25, 6, 6).mean(axis=1) @ features.taxel_weights(features.series_of(x))
    )
    np.testing.assert_allclose(spectrogram(x, RATE).reshape(5, 25)[1], want)


@pytest.mark.parametrize(("frames", "band"), [(1500, 7), (128, 3), (100, 20)])
def test_a_tone_lands_in_its_part_and_band(frames: int, band: int):
    """A burst in the fourth fifth is the maximum there, also where zeros are appended."""
    t = np.arange(frames)
    at = t * 5 // frames == 3
    tone = 100 + 50 * at * np.sin(2 * np.pi * (band + 0.5) / 50 * t)
    power = spectrogram(tone.reshape(-1, 1, 1).astype(np.float32), RATE).reshape(5, 25)
    part, strongest = np.unravel_index(power.argmax(), power.shape)
    assert part == 3
    assert abs(int(strongest) - band) <= 1


def test_hjorth_parameters_of_a_sine():
    """Activity log(A^2 / 2), mobility 2 pi f, complexity 1."""
    t = np.arange(1500) / RATE
    x = (100 + 20 * np.sin(2 * np.pi * 12 * t)).reshape(-1, 1, 1).astype(np.float32)
    np.testing.assert_allclose(
        correlation(x, RATE)[:3], [math.log(200), 2 * math.pi * 12, 1], rtol=2e-3
    )


@pytest.mark.parametrize("frames", [300, 4])
def test_correlations_are_those_of_scipy(frames: int):
    """Mean and spread of Pearson's and Spearman's r over all pairs, with ties."""
    x = np.round(noise(frames)).astype(np.uint8)
    flat = x.reshape(frames, -1).T.astype(float)
    want = []
    for r in (stats.pearsonr, stats.spearmanr):
        each = [r(a, b).statistic for a, b in combinations(flat, 2)]
        want += [np.mean(each), np.std(each)]
    got = correlation(x, RATE)
    np.testing.assert_allclose(got[3:7], want, atol=1e-9)
    np.testing.assert_allclose(
        got[7:], [math.log(np.linalg.norm(np.cov(flat, ddof=0))), flat.mean()]
    )


def test_still_taxels_and_rounded_means_are_none():
    """A dead taxel changes no correlation; without means weights are equal."""
    x = noise()
    for level in (0, 3.3e30):
        dead = np.concatenate([x, np.full((len(x), 2, 1), level, np.float32)], axis=2)
        np.testing.assert_allclose(
            correlation(dead, RATE)[3:7], correlation(x, RATE)[3:7], atol=1e-12
        )
    assert correlation(x[:, :1, :1], RATE)[3:7].tolist() == [0, 0, 0, 0]
    x = noise()
    centred = (x - x.mean(axis=0, dtype=np.float64)).astype(np.float32)
    assert centred.mean(axis=0, dtype=np.float64).any()
    np.testing.assert_array_equal(
        features.taxel_weights(features.series_of(centred)), np.full(6, 1 / 6)
    )
    assert not static(centred, RATE)[:6].any()
    assert correlation(centred, RATE)[8] == 0


@pytest.mark.parametrize("level", [0, 255])
def test_a_silent_or_saturated_skin_has_plain_answers(level: int):
    """Constant counts: floors, rates and levels, nothing else."""
    x = np.full((100, 2, 2), level, np.uint8)
    low = math.log(features.FLOOR)
    np.testing.assert_allclose(spectrogram(x, RATE), np.full(125, low))
    np.testing.assert_allclose(correlation(x, RATE), [low, RATE, 1, 0, 0, 0, 0, low, level])
    whole = [level, 0, level, level, 0, 0, float(level > 0)]
    np.testing.assert_allclose(static(x, RATE), [level] * 4 + [0] * 4 + whole)


@pytest.mark.parametrize(("rows", "cols"), [(1, 1), (3, 3), (16, 1), (20, 30)])
def test_the_number_of_features_hangs_on_the_grid_alone(rows: int, cols: int):
    """2 M + 7, 125 and 9, whatever the length of the sweep."""
    for frames in (20, 61):
        x = np.random.default_rng(0).integers(0, 99, (frames, rows, cols)).astype(np.int16)
        assert [len(of(x, 50.0)) for of in FEATURES] == [2 * rows * cols + 7, 125, 9]


@settings(max_examples=60)
@given(any_counts(20, 60), st.floats(1, 5000), st.sampled_from(FEATURES))
def test_results_are_finite_for_any_digits(taxels: np.ndarray, rate_hz: float, of):
    """Finite numbers for any counts."""
    assert np.isfinite(of(taxels, rate_hz)).all()


@pytest.mark.parametrize(
    ("of", "shape", "rate_hz", "value"),
    [
        (static, (0, 2, 2), RATE, r"\(0, 2, 2\)"),
        (spectrogram, (19, 2, 2), RATE, "19 frames"),
        (correlation, (2, 2, 2), RATE, "2 frames"),
        (correlation, (20, 2, 2), 0.0, "0.0 Hz"),
    ],
)
def test_what_cannot_be_computed_is_refused(of, shape: tuple[int, ...], rate_hz: float, value: str):
    """Each refusal is a FormatError with the wrong value."""
    with pytest.raises(FormatError, match=value):
        of(np.ones(shape, np.uint8), rate_hz)


def test_exploring_stops_when_the_posterior_is_sure():
    """Two sweeps for .65, three for .7; later ones outweigh a certain wrong first one."""
    log_p = np.log(np.array([[0.6, 0.4]] * 3))
    found = [prior_work.explore(log_p, sure) for sure in (0.55, 0.65, 0.7, 0.99)]
    assert found == [(0, 1), (0, 2), (0, 3), (0, 3)]
    log_p = np.log(np.array([[0.6, 0.4], [0.1, 0.9], [0.1, 0.9]]))
    assert prior_work.explore(log_p, 0.95) == (1, 3)
    assert prior_work.explore(np.array([[0.0, -1e9]] + [[-12.0, 0.0]] * 4), 1)[0] == 1


@pytest.mark.parametrize(
    ("log_p", "sure", "hint"), [(np.zeros((0, 3)), 0.9, "one of"), (np.zeros((2, 3)), 1.5, "1.5")]
)
def test_what_cannot_be_explored_is_named(log_p: np.ndarray, sure: float, hint: str):
    """No sweep, and a certainty that is not a probability."""
    with pytest.raises(FormatError, match=hint):
        prior_work.explore(log_p, sure)
