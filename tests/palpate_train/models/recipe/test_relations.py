"""How taxels move together as features: log deviations and correlations over several lags."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.core.clock import SystemClock
from palpate.core.types import SweepFormat
from palpate.inference.classifier import Classifier
from palpate.sim import skin
from palpate_train.cli.main import main
from palpate_train.data import sets
from palpate_train.metrics import bundle_score
from palpate_train.models.methods import Log
from palpate_train.models.recipe import choice, relations
from palpate_train.models.recipe.architectures import PREFIXES
from palpate_train.models.recipe.choice import Candidates, HeldOutScores, ScoredPlan
from tests.factories.trunk import view

SCALE = 0.05
SLOW = replace(skin.FORMAT, window=128, rows=16, cols=1, dtype="int16")


def features(format: SweepFormat, samples: np.ndarray, used: int, prefixes: bool) -> np.ndarray:
    """The relations of raw counts."""

    def nodes(*given: Any) -> str:
        return relations.nodes(*given, format, SCALE, used, prefixes)

    return view(format, nodes, used * relations.each(format), samples, prefixes)


def expected(x: np.ndarray, used: int, end: int, hop: int) -> np.ndarray:
    """The same by numpy's own covariance, of the first `end` frames of one sweep [T, M]."""
    newer, rows = np.arange(hop - 1, end, hop), []
    for lag in (len(x), *relations.LAGS)[:used]:
        changes = x[newer] - x[np.maximum(newer - lag, 0)]
        covariance = np.cov(changes.T, bias=True)
        deviation = np.sqrt(np.diag(covariance) + relations.QUIET)
        pairs = np.triu_indices(x.shape[1], 1)
        share = (covariance / np.outer(deviation, deviation))[pairs]
        most = relations.NEARLY_ONE
        rows += [np.log(deviation), np.arctanh(share.clip(-most, most))]
    return np.concatenate(rows)


def woven(format: SweepFormat, rng: np.random.Generator, n: int = 2) -> np.ndarray:
    """Sweeps whose taxels share a part of their movement, with a drift."""
    shape = n, format.window, *format.shape
    own = rng.normal(size=shape) * 9
    shared = rng.normal(size=(n, format.window, *(1,) * len(format.shape))) * 9
    drift = np.linspace(0, 30, format.window).reshape(-1, *(1,) * len(format.shape))
    return np.rint(100 + own + shared + drift).clip(0, 250).astype(format.numpy_type)


@pytest.mark.parametrize(
    "format",
    [
        skin.FORMAT,
        skin.SHEAR_FORMAT,
        SLOW,
        replace(skin.FORMAT, window=83, rows=2, cols=1, dtype="uint16"),
    ],
    ids=str,
)
def test_they_are_the_deviations_and_correlations_of_the_window(format: SweepFormat) -> None:
    """Also of each prefix, which depends on no frame after it."""
    samples, used = woven(format, np.random.default_rng(0)), relations.scales(format)
    assert used == 1 + sum(lag <= format.window // 4 for lag in relations.LAGS) > 1
    x, tenth = samples * SCALE, format.window // PREFIXES
    if format.axes > 1:  # 48 channels: two rows of taxels are one of cells
        x = x.reshape(2, format.window, 2, 2, 4, 3).mean(axis=3)
    x = x.reshape(2, format.window, -1)
    hop = 2 if format.window > relations.MOST_FRAMES else 1
    tenths = features(format, samples, used, True)
    for found, sweep in zip(tenths, x, strict=True):
        for number in range(PREFIXES):
            wanted = expected(sweep, used, (number + 1) * tenth, hop)
            np.testing.assert_allclose(found[number], wanted, atol=2e-3)
    whole = features(format, samples, used, False)
    np.testing.assert_allclose(whole, tenths[:, -1], atol=2e-3)
    later = samples.copy()
    later[:, format.window // 2 :] = 0
    np.testing.assert_array_equal(features(format, later, used, True)[:, :5], tenths[:, :5])


def test_few_scales_are_the_first_and_silence_is_finite():
    """A dead taxel has the least deviation, no correlation; equal ones the largest."""
    samples, size = woven(SLOW, np.random.default_rng(1)), relations.each(SLOW)
    every = features(SLOW, samples, relations.scales(SLOW), False)
    few = features(SLOW, samples, relations.SHORT, False)
    np.testing.assert_allclose(few, every[:, : relations.SHORT * size], atol=1e-5)
    samples = woven(SLOW, np.random.default_rng(2))
    samples[:, :, 3], samples[:, :, 5] = 100, samples[:, :, 4]
    found = features(SLOW, samples, 1, False)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:, 3], np.log(np.sqrt(relations.QUIET)), atol=1e-5)
    of = {pair: 16 + n for n, pair in enumerate(zip(*np.triu_indices(16, 1), strict=True))}
    np.testing.assert_allclose(found[:, of[3, 4]], 0, atol=1e-3)
    np.testing.assert_allclose(found[:, of[4, 5]], np.arctanh(relations.NEARLY_ONE), atol=1e-2)


def test_a_large_skin_is_divided_into_cells():
    """Sixteen by 32 taxels have three by eight cells: the mean of a cell's taxels is a channel."""
    large = replace(skin.FORMAT, window=40, rows=16, cols=32)
    samples = woven(large, np.random.default_rng(3))
    assert relations.each(large) == 24 + 24 * 23 // 2
    row, col = np.arange(16) * 3 // 16, np.arange(32) * 8 // 32
    cell = row[:, None] * 8 + col
    for sweep, found in zip(samples, features(large, samples, 2, False), strict=True):
        means = np.stack([sweep[:, cell == n].mean(axis=1) for n in range(24)], axis=1) * SCALE
        np.testing.assert_allclose(found, expected(means, 2, 40, 1), atol=2e-3)


@pytest.mark.parametrize("change", [{"rows": 1, "cols": 1}, {"window": 8}], ids=str)
def test_one_channel_or_a_short_window_has_none(change: dict[str, int]) -> None:
    """There is no pair of taxels, or no frame for each tenth."""
    assert relations.scales(replace(skin.FORMAT, **change)) == 0


@pytest.mark.slow
def test_the_box_opens_a_bundle_with_relations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where they are chosen, the exported graph passes the box's check and names unseen sweeps."""

    def related(scores: HeldOutScores, candidates: Candidates, log: Log) -> ScoredPlan:
        heads = candidates.related(candidates.by_kind(shares=False))
        return scores.score(heads["relations beside filters"])

    monkeypatch.setattr(choice, "choose", related)
    known, fit, out = "sim:T-REAL/level-blind:1:2", str(tmp_path / "fit.npz"), tmp_path / "bundle"
    assert main(["fit", "--set", known, "--seed", "1", "--out", fit]) == 0
    assert main(["export", fit, "--out", str(out), "--name", "woven", "--version", "1"]) == 0
    unseen = sets.load("sim:T-REAL/level-blind:2:1")
    box = Classifier(bundle.load(out), SystemClock())
    answers, _ = bundle_score.labels_of(box, unseen)
    assert (answers == unseen.labels).mean() > 0.5  # by chance a sixth
