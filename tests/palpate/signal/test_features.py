"""Features against the paper's formulas written out as loops, and against scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from palpate.core.errors import FormatError
from palpate.signal import features

RATE, FRAMES = 750.0, 1500


def _sweep(frames: int = FRAMES, rows: int = 2, cols: int = 3, seed: int = 1) -> np.ndarray:
    """Raw counts uint8 [frames, rows, cols]: drift, a tone and noise, another mean on each
    taxel."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None, None] / RATE
    level = rng.uniform(20, 120, (1, rows, cols))
    x = level + 8 * t + 15 * np.sin(2 * np.pi * 63 * t) + rng.normal(0, 6, (frames, rows, cols))
    return np.clip(x, 0, 255).astype(np.uint8)


def _tone(hz: float, rate_hz: float, frames: int, amplitude: float = 50.0) -> np.ndarray:
    """One taxel that oscillates around 100 counts."""
    t = np.arange(frames) / rate_hz
    return (100 + amplitude * np.sin(2 * np.pi * hz * t)).astype(np.float32).reshape(-1, 1, 1)


def test_weights_are_equation_4() -> None:
    """Each weight is the taxel's sum of counts over the sum of all counts, row by row."""
    x = _sweep()
    total = sum(int(v) for v in x.ravel())
    want = [sum(int(v) for v in x[:, r, c]) / total for r in range(2) for c in range(3)]
    np.testing.assert_allclose(features.taxel_weights(x), want, rtol=1e-12)


@pytest.mark.parametrize(
    "counts", [np.zeros((5, 2, 2), np.uint8), np.full((5, 2, 2), -7, np.int16)]
)
def test_weights_without_contact_are_uniform(counts: np.ndarray) -> None:
    """Without activation, or with a negative one, all weights are 1 / M."""
    np.testing.assert_array_equal(features.taxel_weights(counts), [0.25] * 4)


def test_a_negative_taxel_weighs_nothing() -> None:
    """Means of 30, 10 and -39 would give weights of 30 and -39 if they were summed; the negative
    taxel is left out."""
    x = np.array([[[30, 10, -39]]], np.int16)
    np.testing.assert_allclose(features.taxel_weights(x), [0.75, 0.25, 0])


def test_each_axis_is_a_series_weighted_by_the_load_of_its_taxel() -> None:
    """With three equal axes all features are those of one; shear alone changes no weight."""
    x = _sweep()
    three = np.stack([x, x, x], axis=-1)
    np.testing.assert_allclose(
        features.taxel_weights(three).reshape(-1, 3).sum(axis=1), features.taxel_weights(x)
    )
    np.testing.assert_allclose(
        features.h_features(three, RATE), features.h_features(x, RATE), atol=1e-12
    )
    roughness, *centroids = features.l_features(three, RATE)
    np.testing.assert_allclose(centroids, features.l_features(x, RATE)[1:])
    assert roughness == pytest.approx(features.l_features(x, RATE)[0] + math.log(3))
    three[..., :2] = _sweep(seed=5)[..., None]
    np.testing.assert_allclose(features.taxel_weights(three)[2::3], features.taxel_weights(x) / 3)


def _l_by_the_formula(x: np.ndarray) -> list[float]:
    """Eq. 1 to 3 written out: one complex sum a bin and taxel, after scipy's removal of the
    trend."""
    n = np.arange(len(x))
    series = scipy.signal.detrend(x.reshape(len(x), -1).astype(float), axis=0, type="linear").T
    means = x.reshape(len(x), -1).mean(axis=0)

    def power(s: np.ndarray, q: int) -> float:
        return abs(np.sum(np.exp(-1j * q * 2 * np.pi / FRAMES * n) * s) / math.sqrt(FRAMES)) ** 2

    spectra = [{q: power(s, q) for q in range(4, 751)} for s in series]
    roughness = math.log(sum(sum(p[q] for q in range(40, 751)) / (750 - 40) for p in spectra))
    centroids = []
    for first, last in ((40, 750), (4, 40)):
        bins = range(first, last + 1)
        each = [sum(p[q] * q * 0.5 for q in bins) / sum(p[q] for q in bins) for p in spectra]
        centroids.append(float(np.dot(each, means) / means.sum()))
    return [roughness, *centroids]


def test_l_features_are_equations_1_to_3() -> None:
    """All three numbers equal the sums of the paper, bins 40 to 750 and 4 to 40 of 0.5 Hz."""
    x = _sweep()
    np.testing.assert_allclose(features.l_features(x, RATE), _l_by_the_formula(x), rtol=1e-9)


def test_l_features_agree_with_a_periodogram_of_another_skin() -> None:
    """3x3 taxels at 100 Hz in int16: the same numbers from scipy's periodogram, the upper band
    ending at 50 Hz."""
    x = np.random.default_rng(2).integers(-200, 3000, (300, 3, 3)).astype(np.int16)
    hz, power = scipy.signal.periodogram(
        x.reshape(300, 9).T.astype(float),
        100.0,
        detrend="linear",
        return_onesided=False,
        scaling="spectrum",
    )
    hz, power = np.abs(hz[:151]), power[:, :151] * 300
    weights = features.taxel_weights(x)
    want = [math.log(power[:, 60:].sum() / (150 - 60))]
    for first, last in ((60, 150), (6, 60)):
        band = slice(first, last + 1)
        want.append(float(weights @ ((power[:, band] @ hz[band]) / power[:, band].sum(axis=1))))
    np.testing.assert_allclose(features.l_features(x, 100.0), want, rtol=1e-9)


def _h_by_the_formula(x: np.ndarray) -> np.ndarray:
    """Eq. 5 written out for 1500 frames at 750 Hz, in whole 1/1500 s, so that no window edge hangs
    on rounding."""
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


def test_h_features_are_equation_5() -> None:
    """All 760 numbers equal the paper's sum, with the mean subtracted and two neighbouring bins in
    a band."""
    x = _sweep()
    assert features.h_shape(FRAMES, RATE) == (40, 19)
    np.testing.assert_allclose(
        features.h_features(x, RATE).reshape(40, 19), _h_by_the_formula(x), atol=1e-12
    )


@pytest.mark.parametrize(("window", "scipys"), [("rect", "boxcar"), ("hann", "hann")])
def test_h_features_agree_with_a_spectrogram(window: str, scipys: str) -> None:
    """At 1000 Hz steps are whole frames: all windows but the cut-off one equal scipy's; the bins
    end at 370 Hz."""
    x = _sweep(2000)
    taxels = x.reshape(2000, -1).T.astype(float)
    _, _, spectrum = scipy.signal.spectrogram(
        taxels, 1000.0, scipys, nperseg=100, noverlap=50, detrend="constant", mode="complex"
    )
    power = np.tensordot(features.taxel_weights(x), np.abs(spectrum) ** 2, 1)[1:38]
    bands = np.vstack([power[0], power[1:].reshape(18, 2, -1).sum(axis=1)])
    want = (bands / bands.sum(axis=0)).T
    assert features.h_shape(2000, 1000.0) == (40, 19)
    got = features.h_features(x, 1000.0, window).reshape(40, 19)
    np.testing.assert_allclose(got[:39], want, atol=1e-12)


@pytest.mark.parametrize(
    ("rate_hz", "frames", "hz"), [(750.0, 1500, 133.0), (750.0, 1500, 361.5), (100.0, 200, 31.0)]
)
def test_a_tone_lands_in_its_band_and_centroid(rate_hz: float, frames: int, hz: float) -> None:
    """c1 is the tone's frequency, and in every short window the band of the tone is the
    strongest."""
    x = _tone(hz, rate_hz, frames)
    assert features.l_features(x, rate_hz)[1] == pytest.approx(hz, abs=0.5)
    for window in ("rect", "hann"):
        h = features.h_features(x, rate_hz, window).reshape(features.h_shape(frames, rate_hz))
        assert set(h.argmax(axis=1)) == {int(hz // 20)}


def test_a_slow_tone_moves_the_low_centroid() -> None:
    """A ripple of 7 Hz sets c2 and leaves c1's band alone."""
    assert features.l_features(_tone(7.0, RATE, FRAMES), RATE)[2] == pytest.approx(7.0, abs=0.05)


def test_drift_does_not_leak_into_the_low_band() -> None:
    """A ramp of 60 counts changes none of the three features by more than rounding."""
    tone = _tone(11.0, RATE, FRAMES) + 10 * _tone(90.0, RATE, FRAMES, 1.0)
    ramp = np.linspace(-30, 30, FRAMES, dtype=np.float32).reshape(-1, 1, 1)
    np.testing.assert_allclose(
        features.l_features(tone + ramp, RATE), features.l_features(tone, RATE), rtol=1e-5
    )


def test_a_gain_adds_to_the_roughness_only() -> None:
    """Counts three times as large: roughness + 2 log 3, centroids and H-features as before."""
    x = _sweep().astype(np.int16)
    small, large = features.l_features(x, RATE), features.l_features(3 * x, RATE)
    np.testing.assert_allclose(large - small, [2 * math.log(3), 0, 0], atol=1e-6)
    np.testing.assert_allclose(
        features.h_features(3 * x, RATE), features.h_features(x, RATE), atol=1e-12
    )


def test_the_order_of_taxels_does_not_matter() -> None:
    """Taxels in another order give the same features, as the paper's sums over taxels do."""
    x = _sweep()
    other = x[:, ::-1, ::-1].transpose(0, 2, 1)
    for kind in ("L", "H"):
        np.testing.assert_allclose(
            features.compute(kind, other, RATE), features.compute(kind, x, RATE), rtol=1e-5
        )


@pytest.mark.parametrize("level", [0, 255])
def test_a_silent_or_saturated_skin_has_finite_features(level: int) -> None:
    """Constant counts: the floor's logarithm, the middle of each band, and H-features of zero."""
    x = np.full((FRAMES, 4, 4), level, np.uint8)
    want = [math.log(16 * features.FLOOR * 711 / 710), (20 + 375) / 2, (2 + 20) / 2]
    np.testing.assert_allclose(features.l_features(x, RATE), want)
    assert not features.h_features(x, RATE).any()


def test_a_band_without_a_bin_keeps_the_one_above_its_lower_edge() -> None:
    """Ten frames at 750 Hz have bins 75 Hz apart, none of them from 2 to 20 Hz; at 30 Hz none lies
    above 15 Hz."""
    x = _sweep(10)
    assert features.l_features(x, RATE)[2] == pytest.approx(75)
    assert features.l_features(x, 30.0)[1] == pytest.approx(15)


def test_one_frame_gives_l_features_but_no_h_features() -> None:
    """L-features of a single frame are finite; H-features name the least number of frames."""
    x = np.full((1, 4, 4), 9, np.uint8)
    assert np.isfinite(features.l_features(x, RATE)).all()
    with pytest.raises(FormatError, match=r"1 frames are too few .* use at least 75"):
        features.h_features(x, RATE)


_DIGITS = st.sampled_from(["uint8", "int16", "uint16", "float32"]).flatmap(
    lambda dtype: hnp.arrays(
        dtype,
        st.tuples(st.integers(30, 90), st.integers(1, 3), st.integers(1, 3)),
        elements={"allow_nan": False, "allow_infinity": False} if dtype == "float32" else None,
    )
)


@settings(max_examples=60)
@given(_DIGITS, st.floats(20, 300))
def test_results_are_finite_for_any_counts(taxels: np.ndarray, rate_hz: float) -> None:
    """Weights sum to 1, centroids stay below Nyquist, H-features are as many as `h_shape` says, 0
    to 1."""
    weights = features.taxel_weights(taxels)
    assert weights.sum() == pytest.approx(1)
    assert weights.min() >= 0
    low = features.compute("L", taxels, rate_hz)
    assert low.shape == (3,)
    assert np.isfinite(low).all()
    assert 0 <= low[1:].min() <= low[1:].max() <= rate_hz / 2 * (1 + 1e-6)
    high = features.compute("H", taxels, rate_hz)
    assert high.shape == (math.prod(features.h_shape(len(taxels), rate_hz)),)
    assert np.isfinite(high).all()
    assert 0 <= high.min() <= high.max() <= 1 + 1e-6


@pytest.mark.parametrize(
    ("frames", "rate_hz", "shape"),
    [
        (1500, 750.0, (40, 19)),
        (1499, 750.0, (39, 19)),
        (75, 750.0, (2, 19)),
        (200, 100.0, (40, 3)),
        (3000, 1500.0, (40, 19)),
    ],
)
def test_the_number_of_h_features_follows_from_frames_and_rate(
    frames: int, rate_hz: float, shape: tuple[int, int]
) -> None:
    """Whole steps of 0.05 s times bands of 20 Hz up to 375 Hz or Nyquist, as many as `h_features`
    gives."""
    assert features.h_shape(frames, rate_hz) == shape
    assert len(features.h_features(np.ones((frames, 1, 1), np.uint8), rate_hz)) == math.prod(shape)


def test_dimensions_and_type_are_those_of_the_paper() -> None:
    """3 and 760 float32 values for the paper's 1500 x 4 x 4 counts at 750 Hz."""
    x = _sweep(rows=4, cols=4)
    low, high = features.compute("L", x, RATE), features.compute("H", x, RATE)
    assert (low.shape, high.shape) == ((3,), (760,))
    assert (low.dtype, high.dtype) == (np.float32, np.float32)


@pytest.mark.parametrize(
    ("kind", "shape", "rate_hz", "message"),
    [
        ("MFCC", (80, 4, 4), 750.0, "'MFCC' is unknown; use one of L, H"),
        ("L", (80, 16), 750.0, r"shape \(80, 16\) is not a sweep"),
        ("L", (0, 4, 4), 750.0, r"shape \(0, 4, 4\) is not a sweep"),
        ("L", (80, 4, 4), 0.0, r"rate of 0.0 Hz"),
        ("H", (80, 4, 4), math.nan, r"rate of nan Hz"),
        ("H", (80, 4, 4), 12.0, "12 Hz is too slow for H-features; use at least 20 Hz"),
    ],
)
def test_what_cannot_be_computed_is_named(
    kind: str, shape: tuple[int, ...], rate_hz: float, message: str
) -> None:
    """Each refusal is a FormatError with the value that was wrong."""
    with pytest.raises(FormatError, match=message):
        features.compute(kind, np.ones(shape, np.uint8), rate_hz)


def test_counts_that_are_no_numbers_and_unknown_windows_are_refused() -> None:
    """NaN among float32 counts, and an unknown window function."""
    x = np.ones((80, 2, 2), np.float32)
    with pytest.raises(FormatError, match="'hamming' is unknown; use rect or hann"):
        features.h_features(x, RATE, "hamming")
    x[3, 1, 1] = math.nan
    with pytest.raises(FormatError, match="not a number or infinite"):
        features.taxel_weights(x)
