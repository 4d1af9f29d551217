"""Speed and direction of a slide, and windows in which nothing can be measured."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.answer.slide import DIRECTIONS, LEAST_HEIGHT, NO_PATTERN, SlideMeter
from palpate.core.types import SweepFormat
from palpate.sim import skin

FORMAT = SweepFormat(4, 4, 750.0, 1500, "float32")
PITCH_MM = 4.0
FINE_MM = 0.02
Array = NDArray[Any]


def passed(
    format: SweepFormat, speed: float, *, wave_mm: tuple[float, float] = (3.0, 30.0), seed: int = 1
) -> Array:
    """Counts [T, R, C] of a finger that slides towards higher rows at `speed` mm/s. The track of
    each column is noise with these wavelengths; a row passes a spot after the next row."""
    rng = np.random.default_rng(seed)
    at_mm = np.arange(format.window)[:, None] / format.rate_hz * speed
    at_mm = at_mm + PITCH_MM * np.arange(format.rows)
    points = int(at_mm.max() / FINE_MM) + 2
    per_mm = np.fft.rfftfreq(points, FINE_MM)
    kept = (per_mm >= 1 / wave_mm[1]) & (per_mm <= 1 / wave_mm[0])
    bins = rng.standard_normal((format.cols, len(per_mm), 2)).view(complex)[..., 0] * kept
    tracks = np.fft.irfft(bins, points)
    tracks *= 20 / tracks.std(axis=1, keepdims=True)
    return (100 + tracks[:, (at_mm / FINE_MM).astype(int)].transpose(1, 2, 0)).astype(np.float32)


def turned(taxels: Array, direction: str) -> Array:
    """A slide towards higher rows as a slide in another direction."""
    backwards = taxels[:, ::-1] if direction.endswith("-") else taxels
    return backwards.swapaxes(1, 2) if direction.startswith("cols") else backwards


def expect_measured(
    meter: SlideMeter,
    taxels: Array,
    speed: float = 30.0,
    direction: str = "rows+",
    within: float = 0.03,
) -> None:
    """Assert that this slide is measured, within a share of its speed."""
    found = meter(taxels)
    assert (found.direction, found.why) == (direction, None)
    assert found.speed_mm_s == pytest.approx(speed, rel=within)
    assert found.height >= LEAST_HEIGHT


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("speed", [15.0, 30.0, 61.0, 150.0, 300.0])
def test_speed_and_direction_are_those_of_the_pattern(speed, direction):
    """Within 3 %, in each direction, between the limits of the meter."""
    meter = SlideMeter(FORMAT, PITCH_MM)
    expect_measured(meter, turned(passed(FORMAT, speed), direction), speed, direction)
    assert (meter.slowest_mm_s, meter.fastest_mm_s) == (8.0, 400.0)


def test_the_pattern_alone_gives_the_speed():
    """Scaled by the pitch, without vibrations in phase; a wave of one length is ambiguous."""
    expect_measured(SlideMeter(FORMAT, PITCH_MM / 2), passed(FORMAT, 30.0), 15.0)
    hum = 63 * np.sin(2 * np.pi * 9.3 * np.arange(1500) / 750)[:, None, None]
    expect_measured(SlideMeter(FORMAT, PITCH_MM), passed(FORMAT, 30.0) + hum, within=0.05)
    found = SlideMeter(FORMAT, PITCH_MM)(passed(FORMAT, 30.0, wave_mm=(2.5, 3.2)))
    assert found.speed_mm_s is None
    assert "several" in found.why


@pytest.mark.parametrize("shear", [False, True])
def test_the_simulators_texture_travels(shear):
    """Towards row 4, which leads, at 30 mm/s; the same with shear."""
    world = replace(skin.WORLD, shear=shear)
    window = skin.window("plastic rough", skin.Placement(), np.random.default_rng(1), world)
    expect_measured(SlideMeter(world.format, skin.PITCH_MM), window, within=0.05)


BREAKS = {
    "silent": lambda taxel, rng: np.full_like(taxel, 7),
    "not a number": lambda taxel, rng: np.full_like(taxel, np.nan),
    "once infinite": lambda taxel, rng: np.where(np.arange(len(taxel)) == 9, np.inf, taxel),
    "huge": lambda taxel, rng: np.where(np.arange(len(taxel)) == 9, 3e38, taxel),
    "noise at full scale": lambda taxel, rng: rng.integers(0, 255, len(taxel)),
    "drifts": lambda taxel, rng: 100 + 50 * np.cumsum(rng.standard_normal(len(taxel))),
    "spikes": lambda taxel, rng: taxel + 4000 * (rng.random(len(taxel)) < 0.01),
}


@pytest.mark.parametrize("broken", BREAKS)
def test_two_broken_taxels_change_little(broken):
    """A taxel of the middle and one of the edge that are silent, loud or give no number."""
    rng, taxels = np.random.default_rng(2), passed(FORMAT, 30.0)
    for r, c in ((1, 2), (3, 0)):
        taxels[:, r, c] = BREAKS[broken](taxels[:, r, c], rng)
    expect_measured(SlideMeter(FORMAT, PITCH_MM), taxels, within=0.05)


@pytest.mark.parametrize(
    ("format", "pitch", "why"),
    [
        (FORMAT, None, "--pitch-mm"),
        (replace(FORMAT, rows=1, cols=1), 4.0, "fewer than 3 taxels"),
        (replace(FORMAT, rows=2, cols=1), 4.0, "fewer than 3 taxels"),
        (replace(FORMAT, window=30), 4.0, "0.04 s at 750 Hz"),
        (replace(FORMAT, rate_hz=3.0, window=6), 4.0, "a frame longer than the time"),
        (replace(FORMAT, window=1), 4.0, "too short"),
    ],
)
def test_a_skin_that_cannot_be_measured_says_why(format, pitch, why):
    """No pitch, too few taxels, too few frames: the reason, also as the result."""
    meter = SlideMeter(format, pitch)
    found = meter(np.zeros((format.window, *format.shape), np.float32))
    assert why in meter.why
    assert (found.speed_mm_s, found.direction, found.why) == (None, None, meter.why)
    assert meter.slowest_mm_s == meter.fastest_mm_s == 0


def test_windows_without_a_slide_say_why():
    """Nothing moves, two taxels move, noise, a finger that rests, an untouched skin."""
    meter, rng = SlideMeter(FORMAT, PITCH_MM), np.random.default_rng(3)
    still = np.full((1500, 4, 4), 9, np.uint8)
    two = still.copy()
    two[:, 0, :2] = rng.integers(0, 99, (1500, 2))
    assert all("fewer than 3 taxels" in meter(taxels).why for taxels in (still, two))
    resting = skin.sweep("foam", skin.Placement(), rng, rest_s=2.0, slide_s=0.1)[:1500]
    for taxels in (rng.integers(0, 255, (1500, 4, 4)), resting, skin.idle(1500, rng)):
        found = meter(taxels)
        assert found.why == NO_PATTERN
        assert found.speed_mm_s is None
        assert 0 < found.height < LEAST_HEIGHT


def test_speeds_beyond_the_limits_are_not_guessed():
    """Too few taxels pass in a window, or more than 100 a second."""
    slow, larger = {"wave_mm": (2.0, 8.0)}, replace(FORMAT, rows=6, cols=6)
    meter, wide = (SlideMeter(format, PITCH_MM) for format in (FORMAT, larger))
    found = [
        meter(passed(FORMAT, 7.4, **slow)),
        wide(passed(larger, 7.4, **slow)),
        meter(passed(FORMAT, 460.0, wave_mm=(14.0, 60.0))),
    ]
    assert [slide.speed_mm_s for slide in found] == [None] * 3
    assert [slide.why for slide in found] == [
        NO_PATTERN,
        "slower than 8 mm/s",
        "faster than 400 mm/s",
    ]


def test_slow_frames_are_enough_where_the_lag_is_longer():
    """At 36 Hz a slide at 30 mm/s has a lag of 4.8 frames; the fastest speed has one frame."""
    format = SweepFormat(4, 4, 36.0, 128, "float32")
    meter = SlideMeter(format, PITCH_MM)
    assert meter(passed(format, 30.0)).speed_mm_s == pytest.approx(30.0, rel=0.03)
    assert meter.fastest_mm_s == 144.0
    assert meter(passed(format, 200.0, wave_mm=(30.0, 200.0))).speed_mm_s is None


@pytest.mark.parametrize(("rows", "cols", "direction"), [(8, 1, "rows+"), (1, 8, "cols+")])
def test_a_single_line_of_taxels_is_enough(rows, cols, direction):
    """A slide along the line."""
    taxels = turned(passed(replace(FORMAT, rows=8, cols=1), 30.0), direction)
    meter = SlideMeter(replace(FORMAT, rows=rows, cols=cols), PITCH_MM)
    expect_measured(meter, taxels, direction=direction)


def test_a_large_skin_is_measured_where_it_is_touched():
    """A loud taxel elsewhere attracts nothing, and tables stay below 2 MB."""
    format = SweepFormat(16, 32, 1000.0, 10_000, "float32")
    rng = np.random.default_rng(4)
    taxels = 0.5 * rng.standard_normal((10_000, 16, 32))
    taxels[:, 9:15, 20:26] += passed(replace(format, rows=6, cols=6), 30.0)
    taxels[:, 2, 3] = 4000 * rng.random(10_000)
    meter = SlideMeter(format, PITCH_MM)
    expect_measured(meter, taxels)
    tables = [table for table in vars(meter).values() if isinstance(table, np.ndarray)]
    assert sum(table.nbytes for table in tables) < 2 << 20
