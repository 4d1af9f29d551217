"""Broken taxels are found by what their neighbours do, named, and bridged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.answer.taxels import (
    LEAST_FRAMES,
    REACH,
    Bridging,
    BrokenTaxels,
    Comparison,
    bridged,
    find,
    places,
)
from palpate.answer.window import TRIPLES, Window, WindowLimits
from palpate.core.types import SweepFormat

ROWS, COLS, FRAMES = 6, 5, 600
LIMITS = WindowLimits(contact=10, full_scale=255)
RULE = Bridging(taxels=3, row=True, column=True, noise=4.0, quietest=1.0, still=False)


def slide(axes: int = 1, seed: int = 0) -> np.ndarray:
    """Raw counts uint8 [T, 6, 5] or [T, 6, 5, A]: load and noise fall off to the contact's edge."""
    rng = np.random.default_rng(seed)
    r, c = np.indices((ROWS, COLS))
    load = 1 - 0.5 * np.hypot(r - 2.5, c - 2) / 4
    noise = rng.standard_normal((FRAMES, ROWS, COLS, axes)) * 3
    counts = load[..., None] * (100 + noise)
    return np.rint(counts).astype(np.uint8).reshape(FRAMES, *(ROWS, COLS, axes)[: 2 + (axes > 1)])


def found(taxels: np.ndarray, rule: Bridging = RULE, limits: WindowLimits = LIMITS) -> str:
    """The broken taxels of a window in words; "" for none."""
    measured = Window(taxels)
    compared = Comparison.of(measured, (ROWS, COLS))
    broken = find(measured, compared, np.zeros(taxels.shape[1:]), limits, rule)
    return broken.text if broken else ""


@pytest.mark.parametrize(
    ("place", "count", "named"),
    [
        (np.s_[:, 2, 3], 0, "silent taxel 3.4"),
        (np.s_[:, 2, 3], 90, "silent taxel 3.4"),
        (np.s_[:, 2, 3], 255, "silent taxel 3.4"),  # while its neighbours are below
        (np.s_[:, 2, 2:4], 255, ""),  # the load is too high
        (np.s_[:, 2], 0, "silent row 3"),
        (np.s_[:, 0], 0, "silent row 1"),
        (np.s_[:, :, 4], 0, "silent column 5"),
        (np.s_[:, 2:4, 1:3], 0, "silent taxel 3.2 3.3 4.2 4.3"),
        (np.s_[:, 0, 0], 0, "silent taxel 1.1"),
        (np.s_[17, 1, 1], np.nan, "silent taxel 2.2"),
        (np.s_[17, 1, 1], np.inf, "silent taxel 2.2"),
        (np.s_[17, 1, 1], -np.inf, "silent taxel 2.2"),
    ],
)
def test_a_constant_taxel_is_silent(place, count, named):
    """Dead, stuck, without a number, or a silent row or column; a sound skin has none."""
    taxels = slide() if np.isfinite(count) else slide().astype(np.float32)
    assert found(taxels) == ""
    taxels[place] = count
    assert found(taxels) == named
    if count in (0, 255):  # the skin may send more than full scale
        assert found(taxels, limits=replace(LIMITS, full_scale=250)) == named


def test_a_taxel_is_broken_by_one_axis_in_enough_frames_of_a_moving_skin():
    """Constant shear suffices; LEAST_FRAMES show noise; at rest all may be constant."""
    taxels = slide(axes=3)
    assert found(taxels) == ""
    taxels[:, 1, 1, 0] = 7
    assert found(taxels) == "silent taxel 2.2"
    taxels = slide()
    taxels[::2, 1, 1] = 200
    assert found(taxels[:LEAST_FRAMES]) == "noisy taxel 2.2"
    assert found(taxels[: LEAST_FRAMES - 1]) == ""
    assert found(np.full((FRAMES, ROWS, COLS), 90, np.uint8)) == ""
    nearly = np.full((FRAMES, ROWS, COLS), 90, np.uint8)
    nearly[::300, 0, 0] += 1  # one that changes now and then shows no slide
    assert found(nearly) == ""


def test_a_noisy_taxel_is_noisier_than_its_neighbours():
    """Two side by side; not where all are noisy, and at rest not below the quietest sweep."""
    rng = np.random.default_rng(1)
    taxels, more = slide(), np.zeros((FRAMES, ROWS, COLS))
    more[:, [1, 1, 4], [1, 2, 4]] = 30 * rng.standard_normal((FRAMES, 3))
    assert found(np.clip(taxels + more, 0, 255).astype(np.uint8)) == "noisy taxel 2.2 2.3 5.5"
    everywhere = 20 * rng.standard_normal(taxels.shape)
    assert found(np.clip(taxels + everywhere, 0, 255).astype(np.uint8)) == ""
    rng = np.random.default_rng(1)
    taxels = 100 + 0.01 * rng.standard_normal((FRAMES, ROWS, COLS)).astype(np.float32)
    taxels[:, 1, 1] += rng.standard_normal(FRAMES).astype(np.float32)
    assert found(taxels) == ""
    taxels[:, 1, 1] *= 10
    assert found(taxels) == "noisy taxel 2.2"


def test_a_skin_whose_sound_taxels_may_be_constant():
    """Silent is one that is loaded, or whose direct neighbours all are."""
    rule, taxels = replace(RULE, still=True), slide()
    taxels[:, 0] = 0  # beside the contact
    assert found(taxels, rule) == ""
    taxels[:, 3, 2] = 0
    taxels[:, 4, 4] = 60
    assert found(taxels, rule) == "silent taxel 4.3 5.5"
    unlimited = replace(LIMITS, contact=None)  # every taxel counts as loaded
    assert (
        found(taxels, rule, unlimited)
        == found(taxels)
        == ("silent taxel 1.1 1.2 1.3 1.4 1.5 4.3 5.5")
    )


def test_noise_of_triples_is_compared_with_the_median_around():
    """sqrt(6 * 2 / pi), none of a ramp; up to REACH taxels away without constant ones."""
    noise = np.random.default_rng(2).standard_normal((FRAMES, 1, 7)) * np.arange(1, 8)
    noise[:, 0, 6] = 5
    measured = Window(noise.astype(np.float32))
    around = Comparison.of(measured, (1, 7)).around[:, 0]
    for k in range(7):
        near = [*range(max(0, k - REACH), k), *range(k + 1, min(6, k + REACH + 1))]
        assert around[k] == sorted(measured.noise[near])[(len(near) - 1) // 2]
    assert np.isinf(Comparison.of(Window(np.ones((FRAMES, 1, 2), np.float32)), (1, 2)).around).all()
    rng = np.random.default_rng(0)
    white = rng.standard_normal((30 * TRIPLES, 1, 1)).astype(np.float32)
    assert Window(white).noise[0] == pytest.approx(np.sqrt(12 / np.pi), rel=0.2)
    ramp = np.arange(300, dtype=np.int16).reshape(-1, 1, 1)
    assert Window(ramp).noise.tolist() == [0]
    assert Window(ramp[:2]).noise.tolist() == [0]


def test_broken_taxels_are_bridged_by_their_neighbours():
    """Their mean, or a line between the rows beside two; given counts and the range stay."""
    taxels = np.arange(9, dtype=np.uint8).reshape(1, 3, 3).repeat(4, axis=0)
    middle = np.zeros((3, 3), bool)
    middle[1, 1] = True
    broken = taxels.copy()
    broken[:, 1, 1] = 200
    assert (bridged(broken, middle, np.zeros((3, 3))) == taxels).all()
    assert (broken[:, 1, 1] == 200).all()
    corner = np.zeros((3, 3), bool)
    corner[0, 0] = True
    assert (bridged(taxels, corner, np.zeros((3, 3)))[:, 0, 0] == 2).all()
    level = np.array([10, 20, 30, 40], float)[:, None] * np.ones((4, 3))
    taxels = np.tile(level, (2, 1, 1)).astype(np.int16)
    mask = np.zeros((4, 3), bool)
    mask[1:3] = True
    broken = taxels.copy()
    broken[:, 1:3] = -5
    assert (bridged(broken, mask, np.zeros((4, 3))) == taxels).all()
    taxels = np.full((3, 1, 3), 250, np.uint8)
    mask, unloaded = np.array([[True, False, False]]), np.array([[40.0, 0, 0]])
    assert (bridged(taxels, mask, unloaded)[:, 0, 0] == 255).all()


def test_the_level_of_an_unloaded_taxel_is_kept():
    """The load is bridged, on each axis; the unloaded levels of the taxels differ."""
    unloaded = np.arange(4 * 3 * 2, dtype=float).reshape(4, 3, 2) * 10
    taxels = (unloaded + 7 + np.arange(5).reshape(5, 1, 1, 1)).astype(np.float32)
    mask = np.zeros((4, 3), bool)
    mask[[0, 2], [1, 2]] = True
    broken = taxels.copy()
    broken[:, mask] = np.nan
    assert bridged(broken, mask, unloaded) == pytest.approx(taxels, rel=1e-6)


@pytest.mark.parametrize(
    ("place", "allowed"),
    [
        (np.s_[0, :3], True),
        (np.s_[2], True),
        (np.s_[:, 4], True),
        (np.s_[2:4], False),
        (np.s_[:2, :2], False),
    ],
)
def test_the_number_that_may_be_bridged(place, allowed):
    """Up to three anywhere, or any number in one row or one column."""
    mask = np.zeros((ROWS, COLS), bool)
    mask[place] = True
    assert RULE.allows(mask) == allowed
    few = replace(RULE, taxels=2, row=False, column=False)
    assert not few.allows(mask)
    for only in (np.ones((1, COLS), bool), np.ones((ROWS, 1), bool)):
        assert not RULE.allows(only)  # nothing would be left to bridge it with


def test_broken_taxels_in_words_and_in_a_file():
    """Both kinds, a silent one not noisy, too; lists of another shape are refused."""
    kinds = np.zeros((2, ROWS, COLS), bool)
    kinds[0, 1, 2] = kinds[1, 3] = True
    broken = BrokenTaxels.of(kinds)
    assert broken
    assert broken.text == "silent taxel 2.3 and noisy row 4"
    format = SweepFormat(ROWS, COLS, 100.0, 20, "uint8")
    again = BrokenTaxels.read(kinds.tolist(), format)
    assert again
    assert (again.kinds == kinds).all()
    assert BrokenTaxels.read(None, format) is None
    assert BrokenTaxels.of(kinds & False) is None
    with pytest.raises(ValueError, match=r"\(2, 6, 5\) .* 4x5"):
        BrokenTaxels.read(kinds.tolist(), replace(format, rows=4))
    assert places(np.ones((1, 1), bool)) == "taxel 1.1"
