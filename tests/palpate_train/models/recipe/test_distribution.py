"""The distribution of counts: its graph by definition, offsets, number of features."""

from dataclasses import replace

import numpy as np
import onnx
import pytest

from palpate.core.types import SweepFormat
from palpate_train.data.augment import texture_scale
from palpate_train.models.recipe import distribution, graph
from palpate_train.models.recipe.distribution import Levels
from palpate_train.models.recipe.recipe import FIXED
from palpate_train.onnx_tools.graph_builder import run

FORMATS = [
    SweepFormat(2, 2, 100.0, 64, "uint8"),
    SweepFormat(3, 3, 50.0, 40, "int16"),
    SweepFormat(1, 1, 10.0, 16, "uint16"),
    SweepFormat(4, 4, 750.0, 600, "uint8"),
    SweepFormat(4, 2, 750.0, 601, "float32"),
    SweepFormat(2, 2, 750.0, 600, "int16", 3),
    SweepFormat(8, 8, 100.0, 64, "uint16"),
]
forms = pytest.mark.parametrize("format", FORMATS, ids=str)
ALONE = replace(FIXED, distribution=True)


def counts(format: SweepFormat, n: int = 3) -> np.ndarray:
    """White noise [n, T, R, C], equal on all taxels, so that none is attenuated."""
    noise = np.random.default_rng(7).normal(100, 12, (n, format.window, *format.shape)).clip(0, 255)
    return noise.round().astype(format.dtype)


def levels(format: SweepFormat) -> Levels:
    """Levels fitted to twelve sweeps."""
    given = counts(format, 12)
    return distribution.fitted(given, texture_scale(given), np.random.default_rng(0))


def trunk(format: SweepFormat, some: Levels, int8: bool, prefixes: bool = False) -> onnx.ModelProto:
    """The trunk of the distribution alone."""
    given = counts(format, 12)
    ranges = graph.Ranges(graph.count_range(given, ALONE), ()) if int8 else None
    return graph.trunk_graph(format, texture_scale(given), some.weights(), ALONE, ranges, prefixes)


def defined(format: SweepFormat, some: Levels, given: np.ndarray) -> np.ndarray:
    """Shares of frames above the levels, of counts minus their mean and of differences."""
    x = given.reshape(len(given), format.window, -1)[:, :, some.taxels] * texture_scale(
        counts(format, 12)
    )
    hop = max(format.window // distribution.MOST_FRAMES, 1)
    older = x[:, : format.window - 1 : hop]
    signals = older - older.mean(axis=1, keepdims=True), np.diff(x, axis=1)[:, ::hop]
    pairs = zip(signals, some.levels, strict=True)
    return np.hstack(
        [(y[..., None] > level).mean(axis=1).reshape(len(x), -1) for y, level in pairs]
    )


@forms
def test_the_graph_is_the_definition(format: SweepFormat):
    """Both precisions agree except for frames near a level, which are rounded again."""
    some, given = levels(format), counts(format)
    wanted = defined(format, some, given)
    for int8 in (False, True):
        have = run(trunk(format, some, int8), given)
        assert have.shape == (len(given), len(some))
        assert np.abs(have - wanted).max() < 8.5 / min(format.window, distribution.MOST_FRAMES)
        assert np.abs(have - wanted).mean() < (2e-2 if int8 else 1e-3)


@forms
def test_the_last_tenth_is_the_whole_window(format: SweepFormat):
    """The first tenth depends on no later frame, if later frames repeat the newest."""
    some, given = levels(format), counts(format)
    for int8 in (False, True):
        prefixes = run(trunk(format, some, int8, prefixes=True), given)
        assert prefixes.shape == (len(given), 10, len(some))
        np.testing.assert_allclose(
            prefixes[:, -1], run(trunk(format, some, int8), given), atol=2e-2
        )
        assert np.abs(prefixes[:, -1] - run(trunk(format, some, int8), given)).mean() < 1e-3


def test_shares_are_evenly_spaced_and_free_of_offsets():
    """Levels are quantiles of their sweeps; an offset changes no bit of bytes."""
    format = FORMATS[3]
    some = levels(format)
    number = some.levels.shape[2]
    shares = defined(format, some, counts(format, 12)).mean(axis=0).reshape(2, 16, number)
    wanted = 1 - (np.arange(number) + 0.5) / number
    assert np.abs(shares - wanted).max() < 0.1
    assert np.abs(shares.mean(axis=1) - wanted).max() < 0.05
    given = counts(format).clip(0, 200)
    model = trunk(format, levels(format), True)
    np.testing.assert_allclose(run(model, given + np.uint8(40)), run(model, given), atol=1e-2)


@forms
def test_the_features_have_a_limit(format: SweepFormat):
    """More taxels have fewer levels each; if there are still too many, random taxels are used."""
    some = levels(format)
    assert len(some) <= distribution.MOST_FEATURES
    assert distribution.FEWEST_LEVELS <= some.levels.shape[2] <= distribution.MOST_LEVELS
    assert (np.diff(some.taxels) > 0).all()
    assert len(some.taxels) == min(format.channels, 32)


@pytest.mark.parametrize("value", [7, 9])
def test_a_silent_taxel_is_above_no_level(value: int):
    """This holds for any constant count, and although its mean is rounded."""
    format = FORMATS[0]
    given = counts(format, 12)
    given[:, :, 0, 0] = 7
    some = distribution.fitted(given, texture_scale(given), np.random.default_rng(0))
    given[:, :, 0, 0] = value
    have = run(trunk(format, some, False), given)
    assert np.isfinite(have).all()
    assert not have.reshape(12, 2, format.channels, -1)[:, :, 0].any()
