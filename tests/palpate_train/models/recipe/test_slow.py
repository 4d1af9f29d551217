"""Slow waves of each taxel as features: low lines of the window, low bands of its tenths."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from palpate.core.types import SweepFormat
from palpate.sim import skin
from palpate_train.models.recipe import slow, spectrum
from palpate_train.models.recipe.architectures import MAINS_HZ, PREFIXES
from tests.factories.trunk import view

SCALE = 0.05
FORMATS = [
    replace(skin.FORMAT, window=600),
    replace(skin.FORMAT, window=128, rows=16, cols=1, dtype="int16"),
    replace(skin.FORMAT, window=47, rows=1, cols=1, dtype="float32", rate_hz=15.0),
]
forms = pytest.mark.parametrize("format", FORMATS, ids=str)


def features(format: SweepFormat, samples: np.ndarray, prefixes: bool = False) -> np.ndarray:
    """The slow waves of raw counts."""

    def nodes(*given: Any) -> str:
        return slow.nodes(*given, format, SCALE, MAINS_HZ, prefixes)

    return view(format, nodes, slow.count(format), samples, prefixes)


def walks(format: SweepFormat) -> np.ndarray:
    """Random walks [3, T, ...] of raw counts."""
    steps = np.random.default_rng(5).normal(size=(3, format.window, *format.shape))
    return np.rint(120 + steps.cumsum(axis=1).clip(-100, 100)).astype(format.numpy_type)


@forms
def test_the_lines_are_those_of_the_transform(format: SweepFormat):
    """numpy's, without the mean; prefixes as far as they go."""
    samples = walks(format)
    frames = format.window // PREFIXES * PREFIXES
    x = samples[:, :frames].reshape(3, frames, -1) * SCALE
    edges = np.unique(np.rint(np.geomspace(1, slow.LINES + 1, slow.BANDS + 1)).astype(int))
    tenths = features(format, samples, True)
    for sweep, found in zip(x, tenths, strict=True):
        for number in range(PREFIXES):
            known = (number + 1) * frames // PREFIXES
            padded = np.zeros_like(sweep)
            padded[:known] = sweep[:known] - sweep[:known].mean(axis=0)
            power = np.abs(np.fft.rfft(padded, axis=0)) ** 2 / known
            bands = [power[a:b].mean(axis=0) for a, b in pairwise(edges)]
            wanted = np.log(np.stack(bands, axis=1) + spectrum.QUIET).ravel()
            np.testing.assert_allclose(found[number, : wanted.size], wanted, atol=2e-2)
    np.testing.assert_allclose(features(format, samples), tenths[:, -1], atol=2e-2)


@forms
def test_a_prefix_depends_on_no_later_frame(format: SweepFormat):
    """An early answer sees the frames up to its tenth alone."""
    samples = walks(format)
    later = samples.copy()
    later[:, format.window // 2 + 1 :] = 0
    found = features(format, later, True)[:, : PREFIXES // 2]
    np.testing.assert_array_equal(found, features(format, samples, True)[:, : PREFIXES // 2])


def test_each_taxel_or_cell_has_its_own_waves():
    """A slow wave, or a tenth's, moves its features alone; at most 24 cells."""
    format = FORMATS[1]
    quiet = np.full((1, format.window, *format.shape), 100, format.numpy_type)
    for periods, tenth in ((3, False), (30, True)):
        moved = quiet.copy()
        wave = 40 * np.sin(2 * np.pi * periods * np.arange(format.window) / 120)
        moved[0, :, 5, 0] += np.rint(wave).astype(moved.dtype)
        change = features(format, moved)[0] - features(format, quiet)[0]
        lines = slow.count(format) - 16 * (len(slow._tenth_edges(12)) - 1)
        parts = change[:lines].reshape(16, -1), change[lines:].reshape(16, -1)
        strongest = parts[tenth].max(axis=1)
        assert strongest.argmax() == 5
        assert np.delete(strongest, 5).max() < 0.1 < strongest[5]
    large = replace(skin.FORMAT, window=128, rows=16, cols=32)
    assert slow.count(large) == 24 * slow.count(FORMATS[1]) // 16


@pytest.mark.parametrize("window", [8, 39])
def test_a_short_window_has_none(window: int):
    """A tenth has too few frames."""
    assert slow.count(replace(skin.FORMAT, window=window)) == 0
