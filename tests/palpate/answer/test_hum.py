"""The hum of the mains is found and removed, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.answer.hum import HumFilter
from palpate.core.types import SweepFormat

FORMAT = SweepFormat(4, 4, 750.0, 1500, "uint8")
LIMIT = 4.0


def sweep(format: SweepFormat = FORMAT, seed: int = 0) -> NDArray[np.float64]:
    """Vibrations around a load, not yet rounded; taxels of different strength."""
    rng = np.random.default_rng(seed)
    strength = rng.uniform(0.5, 8, format.shape)
    return 100 + strength * rng.standard_normal((format.window, *format.shape))


def hum(format: SweepFormat = FORMAT, hz: float = 50.0, counts: float = 3.0) -> NDArray[np.float64]:
    """A sine, the same on all taxels, [T, 1, ...]."""
    times = np.arange(format.window) / format.rate_hz
    sine = counts * np.sin(2 * np.pi * hz * times + 1)
    return sine.reshape(-1, *(1,) * len(format.shape))


def counts(x: NDArray[np.float64], format: SweepFormat = FORMAT) -> NDArray[np.uint8]:
    return np.rint(x).clip(0, 255).astype(format.numpy_type)


@pytest.mark.parametrize("hz", [50.0, 60.0, 49.85, 60.2])
def test_hum_is_removed(hz):
    """At the frequencies of mains and somewhat beside them; the sweep remains."""
    filter, clean = HumFilter(FORMAT), sweep()
    found, amplitude = filter(counts(clean + hum(hz=hz)), LIMIT)
    assert amplitude == pytest.approx(3, rel=0.05)
    assert found.dtype == np.uint8
    assert np.sqrt(((found - clean) ** 2).mean()) < 0.6
    assert filter(found, LIMIT)[1] < 0.6  # what rounding leaves, and loud taxels have


COMBS = {
    "odd harmonics of 50 Hz": {50: 1.0, 150: 0.5, 250: 0.3},
    "a rectifier on 50 Hz": {100: 1.0, 200: 0.5, 300: 0.25},
    "a rectifier on 60 Hz, off by 0.1 %": {120.12: 1.0, 240.24: 0.4},
    "many harmonics": {60.0 * k: 1 / k for k in range(1, 6)},
}


@pytest.mark.parametrize("share", [1.0, 0.4, 0.3])
@pytest.mark.parametrize("comb", COMBS.values(), ids=COMBS.keys())
def test_a_comb_is_removed(comb, share):
    """All lines of the mains, from whole and unfinished windows; the sweep nearly remains."""
    frames = int(share * FORMAT.window)
    clean = sweep()[:frames]
    lines = sum(hum(hz=hz, counts=4 * size) for hz, size in comb.items())
    found, amplitude = HumFilter(FORMAT)(counts(clean + lines[:frames]), LIMIT)
    assert amplitude == pytest.approx(4 * np.linalg.norm(list(comb.values())), rel=0.15)
    assert np.sqrt(((found - clean) ** 2).mean()) < (0.7 if share == 1 else 1.0)


@pytest.mark.parametrize("hz", [45.0, 75.0, 110.0])
def test_other_frequencies_stay(hz):
    """A sine that is not of the mains is part of the material."""
    given = counts(sweep() + hum(hz=hz))
    found, amplitude = HumFilter(FORMAT)(given, LIMIT)
    assert amplitude == 0
    assert found is given


def test_hum_has_one_phase_on_all_taxels():
    """Twelve of sixteen may be far louder; a ridge with another phase on each row stays."""
    given = sweep()
    given[:, 1:] = 100 + 8 * (given[:, 1:] - 100)
    assert HumFilter(FORMAT).ratio(counts(given + hum(counts=2))) > LIMIT
    rows = np.exp(1j * np.arange(4))[:, None]
    times = np.arange(FORMAT.window)[:, None, None] / FORMAT.rate_hz
    ridge = 5 * (np.exp(2j * np.pi * 50 * times) * rows).real
    assert HumFilter(FORMAT)(counts(sweep() + ridge), LIMIT)[1] == 0


def test_each_axis_is_cleaned():
    """Shear axes have the hum as well; the normal axis says how much it is."""
    format = replace(FORMAT, axes=3)
    clean = np.stack([sweep(seed=axis) for axis in range(3)], axis=-1)
    found, amplitude = HumFilter(format)(counts(clean + hum(format), format), LIMIT)
    assert amplitude == pytest.approx(3, rel=0.05)
    assert np.sqrt(((found - clean) ** 2).mean()) < 0.6


@pytest.mark.parametrize("changes", [{"window": 30}, {"rate_hz": 100.0, "window": 200}])
def test_a_window_that_cannot_show_it_stays(changes):
    """Too short for 120 Hz among other frequencies, or with a rate that 50 Hz folds into."""
    format = replace(FORMAT, **changes)
    filter, given = HumFilter(format), counts(sweep(format), format)
    assert filter.hz == ()
    assert filter(given, LIMIT) == (given, 0.0)
    assert filter.ratio(given) == 0


@pytest.mark.filterwarnings("error")
def test_counts_that_are_not_finite_are_left_alone():
    """float32 counts can be infinite or not a number; constant ones have no hum."""
    format = SweepFormat(4, 4, 750.0, 1500, "float32")
    given = sweep().astype(np.float32)
    given[3, 0, 0], given[5, 1, 1] = np.inf, np.nan
    found, amplitude = HumFilter(format)(given, LIMIT)
    assert np.array_equal(found, given, equal_nan=True)
    assert amplitude == 0
    assert HumFilter(format).ratio(np.ones_like(given)) == 0
