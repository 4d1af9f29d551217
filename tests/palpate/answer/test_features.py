"""Features against the paper's formulas written out as loops, and against scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.answer import features
from palpate.core.errors import FormatError
from tests.factories.any_counts import any_counts
from tests.factories.later import Later

signal = Later("scipy.signal")

RATE, FRAMES = 750.0, 1500


def taxel_weights(taxels):
    """The weights of equation 4 for raw counts."""
    return features.taxel_weights(features.series_of(taxels), features.axes(taxels))


def _sweep(frames: int = FRAMES, rows: int = 2, cols: int = 3, seed: int = 1) -> np.ndarray:
    """Raw counts uint8 [frames, rows, cols]: drift, a tone and noise, a mean for each taxel."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None, None] / RATE
    level = rng.uniform(20, 120, (1, rows, cols))
    x = level + 8 * t + 15 * np.sin(2 * np.pi * 63 * t) + rng.normal(0, 6, (frames, rows, cols))
    return np.clip(x, 0, 255).astype(np.uint8)


def test_weights_and_h_features_are_equations_4_and_5():
    """Sums over sums, 1 / M without activation; all 760 H-features by the paper's sum."""

    def h_by_the_formula(x: np.ndarray) -> np.ndarray:
        """Eq. 5 for 1500 frames at 750 Hz, in whole 1/1500 s, so that no edge hangs on rounding."""
        n = np.arange(FRAMES)
        weights = x.reshape(FRAMES, -1).mean(axis=0) / x.reshape(FRAMES, -1).mean(axis=0).sum()
        p = np.zeros((40, 19))
        for window in range(40):
            inside = (2 * n >= 75 * window) & (2 * n < 75 * window + 150)
            for m, s in enumerate(x.reshape(FRAMES, -1).T.astype(float)):
                less_mean = s[inside] - s[inside].mean()
                for k in range(1, 38):
                    turn = np.exp(-2j * np.pi * 10 * k * n[inside] / RATE)
                    p[window, k // 2] += (
                        weights[m] * abs(np.sum(turn * less_mean) / math.sqrt(FRAMES)) ** 2
                    )
        return p / p.sum(axis=1, keepdims=True)

    x = _sweep()
    sums = x.sum(axis=0, dtype=float).ravel()
    np.testing.assert_allclose(taxel_weights(x), sums / sums.sum(), rtol=1e-12)
    pulled = np.array([[[30, 10, -39]]], np.int16)
    np.testing.assert_allclose(taxel_weights(pulled), [0.75, 0.25, 0])
    for level in (0, -7):
        none = taxel_weights(np.full((5, 2, 2), level, np.int16))
        np.testing.assert_array_equal(none, [0.25] * 4)
    x = _sweep()
    assert features.h_shape(FRAMES, RATE) == (40, 19)
    np.testing.assert_allclose(
        features.h_features(x, RATE).reshape(40, 19), h_by_the_formula(x), atol=1e-12
    )


def test_each_axis_is_a_series_weighted_by_the_load_of_its_taxel():
    """With three equal axes all features are those of one; shear alone changes no weight."""
    x = _sweep()
    three = np.stack([x, x, x], axis=-1)
    np.testing.assert_allclose(taxel_weights(three).reshape(-1, 3).sum(axis=1), taxel_weights(x))
    np.testing.assert_allclose(
        features.h_features(three, RATE), features.h_features(x, RATE), atol=1e-12
    )
    roughness, *centroids = features.l_features(three, RATE)
    np.testing.assert_allclose(centroids, features.l_features(x, RATE)[1:])
    assert roughness == pytest.approx(features.l_features(x, RATE)[0] + math.log(3))
    three[..., :2] = _sweep(seed=5)[..., None]
    np.testing.assert_allclose(taxel_weights(three)[2::3], taxel_weights(x) / 3)


@pytest.mark.parametrize(
    ("x", "rate_hz", "first", "split"),
    [
        (_sweep(), RATE, 4, 40),
        (np.random.default_rng(2).integers(-200, 3000, (300, 3, 3), np.int16), 100.0, 6, 60),
    ],
)
def test_l_features_are_equations_1_to_3(x, rate_hz, first, split):
    """The same numbers from scipy's periodogram, also where a band ends at Nyquist."""
    frames, last = len(x), len(x) // 2
    series = x.reshape(frames, -1).T.astype(float)
    hz, power = signal.periodogram(
        series, rate_hz, detrend="linear", return_onesided=False, scaling="spectrum"
    )
    hz, power = np.abs(hz[: last + 1]), power[:, : last + 1] * frames
    want = [math.log(power[:, split:].sum() / (last - split))]
    for band in (slice(split, last + 1), slice(first, split + 1)):
        centroids = (power[:, band] @ hz[band]) / power[:, band].sum(axis=1)
        want.append(float(taxel_weights(x) @ centroids))
    np.testing.assert_allclose(features.l_features(x, rate_hz), want, rtol=1e-9)


@pytest.mark.parametrize(("window", "scipys"), [("rect", "boxcar"), ("hann", "hann")])
def test_h_features_agree_with_a_spectrogram(window, scipys):
    """Where steps are whole frames all windows equal scipy's, but the cut-off one."""
    x = _sweep(2000)
    taxels = x.reshape(2000, -1).T.astype(float)
    _, _, spectrum = signal.spectrogram(
        taxels, 1000.0, scipys, nperseg=100, noverlap=50, detrend="constant", mode="complex"
    )
    power = np.tensordot(taxel_weights(x), np.abs(spectrum) ** 2, 1)[1:38]
    bands = np.vstack([power[0], power[1:].reshape(18, 2, -1).sum(axis=1)])
    want = (bands / bands.sum(axis=0)).T
    assert features.h_shape(2000, 1000.0) == (40, 19)
    got = features.h_features(x, 1000.0, window).reshape(40, 19)
    np.testing.assert_allclose(got[:39], want, atol=1e-12)


@pytest.mark.parametrize("level", [0, 255])
def test_a_silent_or_saturated_skin_has_finite_features(level):
    """Constant counts: the floor's logarithm, the middle of each band, and H-features of zero."""
    x = np.full((FRAMES, 4, 4), level, np.uint8)
    want = [math.log(16 * features.FLOOR * 711 / 710), (20 + 375) / 2, (2 + 20) / 2]
    np.testing.assert_allclose(features.l_features(x, RATE), want)
    assert not features.h_features(x, RATE).any()


def test_few_frames_give_l_features_and_odd_ones_are_refused():
    """A band keeps the bin above its edge; NaN and an unknown window function are refused."""
    x = _sweep(10)
    assert features.l_features(x, RATE)[2] == pytest.approx(75)
    assert features.l_features(x, 30.0)[1] == pytest.approx(15)
    assert np.isfinite(features.l_features(x[:1], RATE)).all()
    with pytest.raises(FormatError, match=r"1 .* 75"):
        features.h_features(x[:1], RATE)
    x = np.ones((80, 2, 2), np.float32)
    with pytest.raises(FormatError, match="'hamming'"):
        features.h_features(x, RATE, "hamming")
    x[3, 1, 1] = math.nan
    with pytest.raises(FormatError, match="number"):
        taxel_weights(x)


@settings(max_examples=60)
@given(any_counts(30, 90), st.floats(20, 300))
def test_results_are_finite_for_any_counts(taxels, rate_hz):
    """Weights sum to 1, centroids are below Nyquist, H-features as `h_shape` says."""
    weights = taxel_weights(taxels)
    assert weights.sum() == pytest.approx(1)
    assert weights.min() >= 0
    low, high = (features.compute(kind, taxels, rate_hz) for kind in "LH")
    assert low.shape == (3,)
    assert high.shape == (math.prod(features.h_shape(len(taxels), rate_hz)),)
    assert low.dtype == high.dtype == np.float32
    assert np.isfinite(low).all()
    assert 0 <= low[1:].min() <= low[1:].max() <= rate_hz / 2 * (1 + 1e-6)
    assert 0 <= high.min() <= high.max() <= 1 + 1e-6


@pytest.mark.parametrize(
    ("kind", "shape", "rate_hz", "message"),
    [
        ("MFCC", (80, 4, 4), 750.0, "'MFCC' is unknown"),
        ("L", (80, 16), 750.0, r"shape \(80, 16\)"),
        ("L", (0, 4, 4), 750.0, r"shape \(0, 4, 4\)"),
        ("L", (80, 4, 4), 0.0, r"0\.0 Hz"),
        ("H", (80, 4, 4), math.nan, "nan Hz"),
        ("H", (80, 4, 4), 12.0, r"12 Hz .* 20 Hz"),
    ],
)
def test_what_cannot_be_computed_is_named(kind, shape, rate_hz, message):
    """Each refusal is a FormatError with the value that was wrong."""
    with pytest.raises(FormatError, match=message):
        features.compute(kind, np.ones(shape, np.uint8), rate_hz)
